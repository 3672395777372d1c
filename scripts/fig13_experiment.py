"""The paper's experiment (Algorithm 2, Fig. 13) from a capture manifest and the poses estimated from its frames.

    torchpose capture configs/rig/paper_plan.yaml --rig configs/rig/ur5_20mp.yaml --out run
    torchpose estimate run/manifest.jsonl --camera camera.yaml --target quad40 --out run/poses.jsonl
    python scripts/fig13_experiment.py run/manifest.jsonl run/poses.jsonl --out out/fig13

Tables: repeatability at rest; distance and angle differences against the robot per axis; influence of the focal length
on Z (eq. 5). With --camera and --target the Cramer-Rao bound stands beside them, for the noise and blur given.
Without arguments: the whole experiment on the digital twin.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from torchpose.camera import Camera
from torchpose.errors import TorchposeError
from torchpose.studies import fig13_experiment
from torchpose.studies.script import finish
from torchpose.target import Target


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest", type=Path, nargs="?")
    parser.add_argument("poses", type=Path, nargs="?")
    parser.add_argument("--out", type=Path, help="folder for tables (.csv) and the plot (.png)")
    parser.add_argument("--camera", type=Path, help="for the bound")
    parser.add_argument("--target", help="for the bound")
    parser.add_argument("--noise", type=float, default=1.0, help="grey levels of 0..255")
    parser.add_argument("--psf", type=float, default=0.7, help="standard deviation of the blur, px")
    options = parser.parse_args()
    if (options.manifest is None) != (options.poses is None):
        parser.error("give both MANIFEST and POSES, or neither for the twin")
    try:
        if options.manifest is None:
            result = fig13_experiment.run(full=True)
        else:
            bound = None
            if options.camera is not None and options.target is not None:
                camera, target = Camera.load(options.camera), Target.load(options.target)
                bound = fig13_experiment.crlb(camera, target, options.noise, options.psf)
            result = fig13_experiment.evaluated(options.manifest, options.poses, bound)
        finish(result, options.out)
    except TorchposeError as error:
        print(f"fig13_experiment: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
