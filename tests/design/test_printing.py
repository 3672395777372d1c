"""Print classes, what a measured print leaves open, and designs that count both."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchpose as tp
from torchpose.design import (
    PRINTS,
    Imaging,
    Need,
    PrintClass,
    WorkingVolume,
    design_target,
    edge_covariance,
    measured,
    print_of,
    scale_deviation,
)
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.sim import add_noise, render

F64 = torch.float64
VOLUME = WorkingVolume((140.0, 160.0), (5.0, 3.0), math.radians(25))
IMAGING = Imaging()


def camera() -> tp.Camera:
    matrix = torch.tensor([[800.0, 0, 319.5], [0, 800.0, 259.5], [0, 0, 1]], dtype=F64)
    return tp.Camera(640, 520, matrix, torch.zeros(0, dtype=F64))


def test_classes_by_name_and_by_numbers(tmp_path: Path) -> None:
    assert print_of("laser") == PRINTS["laser"]
    assert print_of("20,15") == PrintClass(0.02, 0.015)
    assert print_of("20,15,40") == PrintClass(0.02, 0.015, 0.04)
    for text in ("inkjet", "20", "1,2,3,4", "a,b", ""):
        with pytest.raises(ConfigError, match="is none of glass, plotter, laser, nor PLACES,GAIN"):
            print_of(text)
    for text in ("-1,2", "nan,1", "1,inf", "1,1,-1"):
        with pytest.raises(ConfigError, match=r"print: .*give standard deviations from 0"):
            print_of(text)
    for made, line in (("20,15", "center_sigma: 0.02\n"), ("20,15,40", "center_sigma: [0.02, 0.02, 0.04]\n")):
        stated = print_of(made).stated_by(tp.Target.load("quad40"))
        stated.save(tmp_path / "target.yaml")
        text = (tmp_path / "target.yaml").read_text()
        assert line in text
        assert "edge_gain_sigma: 0.015\n" in text
        again = tp.Target.load(tmp_path / "target.yaml").covariance
        assert again is not None
        assert stated.covariance is not None
        assert torch.equal(again, stated.covariance)


def by_brute_force(target: tp.Target, views: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """Covariance of the places from one least-squares problem of all poses, places, turns of rings and the gain, dense.

    Points along both rims, measured across the edge. Heights of 40 um at 28.3 mm bend the plate by 2.8 mrad.
    """
    assert target.covariance is not None
    count, cam, m = 90, camera(), len(target)
    angle = torch.arange(count, dtype=F64) * (2 * math.pi / count)
    circle = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    poses = len(views[0])
    ends = 6 * poses + 3 * m

    def pixels(unknowns: torch.Tensor) -> torch.Tensor:
        pose, places = unknowns[: 6 * poses].view(-1, 6), unknowns[6 * poses : ends].view(m, 3)
        gain, turns = unknowns[ends], torch.nn.functional.pad(unknowns[ends + 1 :].view(m, 2), (0, 1))
        radii = target.radii + gain * torch.tensor([1.0, -1.0], dtype=F64)
        rims = torch.einsum("mij,sj->msi", rotations.exp(turns), circle)
        points = (target.centers + places)[:, None, None] + radii[..., None, None] * rims[:, None]
        turned = rotations.exp(pose[:, 3:]) @ views[0]
        at = torch.einsum("vij,mcsj->vmcsi", turned, points) + (views[1] + pose[:, :3])[:, None, None, None]
        return cam.project(at)

    start = torch.zeros(ends + 1 + 2 * m, dtype=F64)
    jacobian = torch.func.jacfwd(pixels)(start)  # (V, M, 2, S, 2, U)
    seen = pixels(start)
    step = (seen.roll(-1, 3) - seen.roll(1, 3)) / 2
    normal = torch.stack([step[..., 1], -step[..., 0]], -1)  # times the length
    contrast, blur2 = IMAGING.light - IMAGING.dark, IMAGING.psf_sigma**2 + 1 / 12
    weight = contrast**2 / (2 * math.sqrt(math.pi * blur2) * (IMAGING.noise**2 + 1 / 12)) / step.norm(dim=-1)
    rows = (normal[..., None, :] @ jacobian)[..., 0, :].flatten(0, 3) * weight.flatten()[:, None].sqrt()
    matrix = rows.mT @ rows
    matrix[6 * poses : ends + 1, 6 * poses : ends + 1] += torch.linalg.inv(target.covariance)
    matrix.diagonal()[ends + 1 :] += (2 * 0.04 / math.sqrt(800)) ** -2
    return torch.linalg.inv(matrix)[6 * poses : ends + 1, 6 * poses : ends + 1]


def test_what_a_measured_print_leaves_is_that_of_one_dense_adjustment() -> None:
    target = PrintClass(0.02, 0.015, 0.04).stated_by(tp.Target.load("quad40"))
    found = measured(camera(), target, VOLUME, IMAGING).covariance
    assert found is not None
    R, t = VOLUME.poses(distances=[150.0], tilts=[math.radians(30)], azimuths=28)
    dense = by_brute_force(target, (R, t))
    arm = target.centers - target.centers.mean(0)
    frame = torch.cat([torch.eye(3, dtype=F64).expand(4, 3, 3), rotations.skew(arm), arm[..., None]], -1).flatten(0, 1)
    left = torch.eye(12, dtype=F64) - frame @ torch.linalg.pinv(frame)
    expected = left @ dense[:-1, :-1] @ left
    torch.testing.assert_close(found[:-1, :-1], expected, rtol=0.02, atol=1e-3 * float(expected.abs().max()))
    assert float(found[-1, -1] / dense[-1, -1]) == pytest.approx(1, abs=0.02)
    assert float(found.diagonal().max().sqrt()) < 0.001
    assert scale_deviation(target) == pytest.approx(0.02 / math.sqrt(4 * 800))


def test_a_coarse_print_is_designed_to_be_measured() -> None:
    need = Need(2.0, 9.0)
    exact = design_target(camera(), VOLUME, (50.0, 50.0), need, IMAGING)
    made = design_target(camera(), VOLUME, (50.0, 50.0), need, IMAGING, printing=PRINTS["plotter"])
    assert exact.measured is None
    assert made.measured is not None
    assert float(need.excess(made.precision.worst)) > 1
    assert float(need.excess(made.measured.worst)) <= 1
    # four markers: half of the places' deviation, at least
    assert float(made.precision.worst[:2].min()) > 4.9
    assert made.target.covariance is not None
    assert float(made.target.covariance[0, 0].sqrt()) == pytest.approx(0.01)
    assert made.limits.gain == pytest.approx(0.045)
    # a plainer need is met as printed
    coarse = design_target(camera(), VOLUME, (50.0, 50.0), Need(8.0, 30.0), IMAGING, printing=PRINTS["plotter"])
    assert float(Need(8.0, 30.0).excess(coarse.precision.worst)) <= 1
    own = design_target(
        camera(), VOLUME, (50.0, 50.0), Need(8.0, 30.0), IMAGING, printing=PRINTS["plotter"], print_gain=0.03
    )
    assert own.limits.gain == pytest.approx(0.03)
    assert own.target.covariance is not None
    assert float(own.target.covariance[-1, -1].sqrt()) == pytest.approx(0.01)


def test_out_of_reach_even_when_measured_is_said() -> None:
    with pytest.raises(
        ConfigError, match=r"print of places off by 10 um, edges by 15 um, not even once it is measured"
    ):
        design_target(camera(), VOLUME, (50.0, 50.0), Need(0.02, 9.0), IMAGING, printing=PRINTS["plotter"], markers=4)


@pytest.mark.slow
def test_prints_of_a_class_err_as_promised() -> None:
    """Frames of 60 prints at one pose of the volume, each with errors of its own, estimated with the designed file."""
    made = design_target(camera(), VOLUME, (50.0, 50.0), Need(8.0, 30.0), IMAGING, printing=PRINTS["plotter"]).target
    assert made.covariance is not None
    R, t = VOLUME.random(1, torch.Generator().manual_seed(5))
    estimator, generator, errors = tp.PoseEstimator(camera(), made), torch.Generator().manual_seed(6), []
    for k in range(60):
        off = made.covariance.diagonal().sqrt() * torch.randn(13, dtype=F64, generator=generator)
        print_ = replace(made, centers=made.centers + off[:-1].view(4, 3), edge_gain=float(off[-1]), covariance=None)
        found = estimator(add_noise(render(camera(), print_, R, t, psf_sigma=0.7), 2.0, seed=k))
        assert found.status.item() == tp.Status.OK
        errors.append(torch.cat([found.t - t, rotations.log(found.R @ R.mT)], -1))
    spread = torch.cat(errors).square().mean(0).sqrt()
    promised = edge_covariance(camera(), made, R, t, IMAGING)[0].diagonal().sqrt()
    assert ((spread / promised - 1).abs() < 3.5 / math.sqrt(120)).all()
