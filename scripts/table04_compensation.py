"""The paper's Table IV, the centre of a tilted ring: uncompensated, by eq. (7), and as the exact common centre.

    python scripts/table04_compensation.py --seeds 20 --noise 0 2 --out table04.csv

A ring of diameters 10 and 5 mm on the optical axis at 160 mm, focal length 3333.33 px: the paper gives no focal length,
nor says which of its sizes are diameters. ``projected``: from the exact conics, that is the error of the formula alone.
``measured``: from simulated 8-bit frames (point-spread function 0.7 px), each with the axis of tilt and the part of a
pixel at which the ring lies drawn at random; RMS length of the error over seeds, px.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

import torchpose as tp
from torchpose.centers import common_center, compensate
from torchpose.detect import find_candidates
from torchpose.ellipse import EllipseFit
from torchpose.geometry import conics, rotations
from torchpose.io.writers import write_rows
from torchpose.rings import measure_rings
from torchpose.sim import add_noise, render

F64 = torch.float64
FOCAL, DISTANCE, SIZE = 3333.33, 160.0, 301
RADII = torch.tensor([[5.0, 2.5]], dtype=F64)
TILTS = (0, 5, 10, 20, 30, 40, 50, 60, 70)
PUBLISHED = {5: (0.1811, 0.0075), 10: (0.2723, 0.0141)}


def projected(rotation: Tensor) -> tuple[EllipseFit, EllipseFit]:
    """Exact ellipses of both circles, with the optical axis at pixel (0, 0)."""
    center, normal = torch.tensor([0.0, 0, DISTANCE], dtype=F64), torch.tensor([0.0, 0, 1], dtype=F64)
    to_pixels = torch.diag(torch.tensor([1 / FOCAL, 1 / FOCAL, 1], dtype=F64))
    conic = to_pixels @ conics.circle_image(rotation, center, normal, RADII[0]) @ to_pixels
    ellipse = conics.ellipse_from_conic(conics.from_matrix(conic))
    one = torch.ones(1, dtype=F64)
    outer, inner = (EllipseFit(e[None], torch.eye(5, dtype=F64)[None], one, one) for e in ellipse)
    return outer, inner


def measured(rotation: Tensor, shift: Tensor, noise: float, seed: int, correct: bool) -> tuple[EllipseFit, EllipseFit]:
    """Ellipses of both circles in a simulated frame, relative to the image of their centre."""
    principal = (SIZE - 1) / 2 + shift
    matrix = torch.tensor([[FOCAL, 0, principal[0]], [0, FOCAL, principal[1]], [0, 0, 1]], dtype=F64)
    camera = tp.Camera(width=SIZE, height=SIZE, matrix=matrix, distortion=torch.zeros(4, dtype=F64))
    # a target has three markers at least: the others lie outside of the frame
    centers = torch.tensor([[0.0, 0, 0], [60, 0, 0], [0, 60, 0]], dtype=F64)
    radii = torch.cat([RADII, torch.tensor([[5.0, 2.0], [5, 1.5]], dtype=F64)])
    normals = torch.tensor([[0.0, 0, 1]], dtype=F64).expand(3, 3)
    target = tp.Target("table4", "light", torch.arange(3), centers, normals, radii)
    clean = render(camera, target, rotation[None], torch.tensor([[0.0, 0, DISTANCE]], dtype=F64))
    frame = add_noise(clean, noise, seed=seed)
    rings = measure_rings(frame, find_candidates(frame), camera, correct=correct)
    if len(rings) != 1:
        raise RuntimeError(f"{len(rings)} rings found in a frame of one")
    for fit in (rings.outer, rings.inner):
        fit.params[:, :2] -= principal
    return rings.outer, rings.inner


def errors(outer: EllipseFit, inner: EllipseFit) -> list[float]:
    """px from the origin: outer ellipse, eq. (7), exact."""
    centers = (outer.params[:, :2], compensate(outer, inner, RADII)[0], common_center(outer, inner, RADII)[0])
    return [float(c.norm()) for c in centers]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0])
    parser.add_argument("--out", type=Path, help="CSV file of the table")
    options = parser.parse_args()
    names = ("ellipse", "eq7", "exact")
    rows = []
    print("tilt  noise | projected: " + "".join(f"{n:>10}" for n in names) + " | measured, RMS: "
          + "".join(f"{n:>10}" for n in names) + "  paper's eq7 | published raw, eq7")  # fmt: skip
    for tilt in TILTS:
        g = torch.Generator().manual_seed(tilt)
        draws = torch.rand(options.seeds, 3, dtype=F64, generator=g)
        axes = torch.stack([(2 * math.pi * draws[:, 0]).cos(), (2 * math.pi * draws[:, 0]).sin()], -1)
        lean = rotations.exp(torch.nn.functional.pad(axes * math.radians(tilt), (0, 1)))
        formula = errors(*projected(lean[0]))
        for noise in options.noise:
            found = torch.tensor([
                errors(*measured(r, d[1:] - 0.5, noise, seed, True))
                + errors(*measured(r, d[1:] - 0.5, noise, seed, False))[1:2]
                for seed, (r, d) in enumerate(zip(lean, draws, strict=True))
            ])  # fmt: skip
            rms = found.square().mean(0).sqrt().tolist()
            published = PUBLISHED.get(tilt, (math.nan, math.nan))
            print(f"{tilt:4d}  {noise:5g} |            " + "".join(f"{x:10.5f}" for x in formula)
                  + " |                " + "".join(f"{x:10.5f}" for x in rms[:3])
                  + f"   {rms[3]:10.5f} | {published[0]} {published[1]}", flush=True)  # fmt: skip
            row = {"tilt_deg": tilt, "noise": noise, "seeds": options.seeds}
            row |= {f"projected_{n}": x for n, x in zip(names, formula, strict=True)}
            row |= {f"measured_{n}": x for n, x in zip((*names, "paper"), rms, strict=True)}
            rows.append(row)
    if options.out:
        write_rows(options.out, rows, {name: type(value) for name, value in rows[0].items()})


if __name__ == "__main__":
    main()
