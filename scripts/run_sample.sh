#!/usr/bin/env bash
# Estimates the sample frames, compares the poses with the truth and draws what was found.
# Makes .venv first where there is none; PYTHON=... chooses the interpreter.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup_venv.sh"
setup_venv

out=out/sample
mkdir -p "$out"
# JSON lines hold the whole covariance, which the comparison needs; .csv and .parquet are written the same way
.venv/bin/python -m torchpose estimate data/sample/frames \
    --camera data/sample/camera.yaml --target data/sample/target.yaml \
    --out "$out/poses.jsonl" --detections "$out/detections.csv" --overlay "$out/overlays"
met=0
.venv/bin/python scripts/sample_report.py --poses "$out/poses.jsonl" --truth data/sample/truth.csv || met=$?
echo "Poses: $out/poses.jsonl   markers: $out/detections.csv   pictures of what was found: $out/overlays/"
exit "$met"
