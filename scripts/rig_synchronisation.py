"""How much motion between the pictures of a moment shows: consistency of the cameras against the way the target went.

    python scripts/rig_synchronisation.py --moments 24 --markdown

Frames of quad40 as in rig_statistics.py (160 mm away, focal length 1111 px, noise 2, blur 0.7 px), three cameras 35
degrees apart. The second camera takes its picture after the target went so far, across the view of the first camera.
Columns: mean chi-squared between the cameras over its freedom, share of moments with a pose, share rejected with
`cameras_disagree`, RMS error of the poses that there are, in the first camera and at the time of the first picture.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from rig_calibration_statistics import print_rows
from rig_statistics import BLUR, CASES, DARK, LIGHT, NOISE, TARGET, poses, rig_of

import torchpose as tp
from torchpose.results import Reason
from torchpose.sim import add_noise, render

F64 = torch.float64
WAYS_UM = (0.0, 0.2, 0.4, 0.8, 1.6, 5.0)
CASE = CASES["three-35"]
MOVED = 1  # the camera whose pictures come late


def row_of(way_um: float, moments: int, seed: int) -> dict[str, Any]:
    """Figures of one way."""
    rig = rig_of(CASE)
    R, t = poses(CASE, moments, torch.Generator().manual_seed(seed))
    frames = []
    for number, camera in enumerate(rig.cameras):
        there = t + (t.new_tensor([way_um / 1000, 0, 0]) if number == MOVED else 0)
        own = rig.seen_by(number, R, there)
        clean = render(camera, TARGET, *own, psf_sigma=BLUR, dark=DARK, light=LIGHT)
        frames.append(add_noise(clean, NOISE, seed=1000 * seed + number))
    found = tp.PoseEstimator(rig, TARGET)(frames)
    assert found.consistency is not None
    chi2, freedom = found.consistency.unbind(1)
    good = found.ok
    error = 1e3 * (found.t - t)[good]
    rejected = found.reason == int(Reason.CAMERAS_DISAGREE)
    return {
        "way um": way_um,
        "consistency": float((chi2 / freedom)[freedom > 0].mean()),
        "ok": float(good.double().mean()),
        "cameras_disagree": float(rejected.double().mean()),
        "RMS x, y um": float(error[:, :2].square().mean().sqrt()),
        "RMS depth um": float(error[:, 2].square().mean().sqrt()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", action="store_true", help="a table for the documentation")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with torch.inference_mode():
        rows = [row_of(way, options.moments, options.seed) for way in WAYS_UM]
    print_rows(rows, markdown=options.markdown)


if __name__ == "__main__":
    main()
