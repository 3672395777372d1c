"""Makes the sample set: 12 noisy frames of the target quad40 with their camera, target and truth.

python scripts/make_sample.py --out data/sample
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import torch

from torchpose.analysis import pose_crlb
from torchpose.camera import Camera
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.io.truth import Truth, write_truth
from torchpose.sim import add_noise, render
from torchpose.target import Target

SEED = 20
PLATE = (70.0, 70.0)  # mm
SURROUND = 90.0
# tilt, azimuth of the tilt axis, roll in degrees; position x, y, z in mm; PSF in px; noise, dark, light in grey levels
SCENES = [
    (0, 0, 0, 0, 0, 160, 0.7, 0.5, 30, 220),
    (5, 20, 15, 10, -8, 150, 0.8, 1.0, 35, 210),
    (10, 75, -30, -22, 6, 165, 0.6, 2.0, 25, 225),
    (10, 140, 60, 18, 10, 172, 0.9, 0.3, 40, 190),
    (15, 200, 95, -35, -12, 160, 0.7, 1.0, 30, 200),
    (20, 300, 170, 30, 14, 168, 1.0, 1.0, 45, 180),
    (20, 250, -120, 5, -15, 178, 0.75, 3.0, 30, 215),
    (25, 45, 40, -15, 5, 145, 1.2, 1.0, 20, 230),
    (30, 110, -75, 45, -10, 170, 0.65, 0.5, 50, 170),
    (30, 330, 5, -40, 12, 175, 0.85, 1.0, 35, 205),
    (35, 160, 135, 12, 18, 180, 0.9, 4.0, 30, 220),
    (40, 225, -160, -8, -4, 185, 0.8, 0.0, 60, 160),
]


def sample_camera() -> Camera:
    """A 2 MP camera with 8 mm lens: the paper's 20 MP one at a third, with mild lens distortion."""
    return Camera(
        width=1824,
        height=1216,
        matrix=torch.tensor([[1111.11, 0.0, 911.5], [0.0, 1111.11, 607.5], [0.0, 0.0, 1.0]], dtype=torch.float64),
        distortion=torch.tensor([-0.08, 0.02, 2e-4, -1.5e-4], dtype=torch.float64),
    )


def sample_truth(camera: Camera, target: Target) -> Truth:
    """Poses, imaging conditions and Cramer-Rao bounds of `SCENES`."""
    scene = torch.tensor(SCENES, dtype=torch.float64)
    tilt, azimuth, roll = scene[:, :3].deg2rad().unbind(1)
    zero = torch.zeros_like(tilt)
    axis = torch.stack([azimuth.cos(), azimuth.sin(), zero], 1)
    rotation_vector = rotations.log(
        rotations.exp(tilt[:, None] * axis) @ rotations.exp(torch.stack([zero, zero, roll], 1))
    )
    psf_sigma, noise_sigma, dark, light = scene[:, 6:].unbind(1)
    covariance = pose_crlb(
        camera,
        target,
        rotations.exp(rotation_vector),
        scene[:, 3:6],
        psf_sigma=psf_sigma,
        dark=dark,
        light=light,
        noise_sigma=noise_sigma,
    )
    std = covariance.diagonal(dim1=1, dim2=2).sqrt().unbind(1)
    return Truth(
        frame=[f"{i:03d}.png" for i in range(len(scene))],
        target=[target.name] * len(scene),
        t=scene[:, 3:6],
        rotation_vector=rotation_vector,
        extra={
            "tilt_deg": scene[:, 0],
            "psf_sigma": psf_sigma,
            "noise_sigma": noise_sigma,
            "dark": dark,
            "light": light,
            **dict(zip(("sx", "sy", "sz", "srx", "sry", "srz"), std, strict=True)),
        },
    )


def sample_frames(camera: Camera, target: Target, truth: Truth, rows: slice = slice(None)) -> torch.Tensor:
    """(B, H, W) uint8 frames of the chosen rows of the truth."""
    of = {name: column[rows] for name, column in truth.extra.items()}
    clean = render(
        camera,
        target,
        truth.R[rows],
        truth.t[rows],
        psf_sigma=of["psf_sigma"],
        dark=of["dark"],
        light=of["light"],
        plate=PLATE,
        surround=SURROUND,
    )
    return add_noise(clean, of["noise_sigma"], SEED, index=torch.arange(len(truth))[rows])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sample set")
    out = parser.parse_args().out
    camera, target = sample_camera(), Target.load("quad40")
    truth = sample_truth(camera, target)
    (out / "frames").mkdir(parents=True, exist_ok=True)
    try:
        camera.save(out / "camera.yaml")
        target.save(out / "target.yaml")
        write_truth(out / "truth.csv", truth)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    total = 0
    for name, frame in zip(truth.frame, sample_frames(camera, target, truth), strict=True):
        path = out / "frames" / name
        cv2.imwrite(str(path), frame.numpy(), [cv2.IMWRITE_PNG_COMPRESSION, 9])
        total += path.stat().st_size
    print(f"{len(truth)} frames, {total / 1e6:.2f} MB in {out / 'frames'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
