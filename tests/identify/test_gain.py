"""Prints with dot gain: codes are read up to a gain of the plate, and the layout tells which."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchpose as tp
from tests.exact import F64, exact_ellipses, pinhole, random_poses, rings_of
from torchpose.geometry import rotations
from torchpose.identify import Identified, MarkerTable, Scene, identify
from torchpose.pose import gather_evidence, solve_poses
from torchpose.pose.evidence import predicted_circles
from torchpose.pose.sizes import sizes_beyond
from torchpose.results import Status
from torchpose.rings import Rings
from torchpose.sim import add_noise, render
from torchpose.target import Target

CAMERA = pinhole()
NEAR, FAR = (140.0, 190.0), (320.0, 440.0)  # mm: radii of 30 to 40 and of 13 to 18 px
COUNT = 40


def printed(target: Target, gain: float) -> Target:
    """The target as a printer leaves it that moves every edge of the dark areas outwards by ``gain`` mm."""
    sign = 1.0 if target.background == "light" else -1.0
    return replace(target, radii=target.radii + sign * gain * torch.tensor([1.0, -1.0], dtype=F64))


def stating(target: Target, sigma: float) -> Target:
    covariance = torch.zeros(3 * len(target) + 1, 3 * len(target) + 1, dtype=F64)
    covariance[-1, -1] = sigma**2
    return replace(target, covariance=covariance)


def rings_on(target: Target, gain: float, distance: tuple[float, float] = NEAR) -> tuple[Rings, torch.Tensor]:
    """Exact rings of ``COUNT`` frames of the print, and the rotations."""
    r, t = random_poses(COUNT, 40.0, distance, seed=4)
    ellipses = exact_ellipses(printed(target, gain), CAMERA, r, t).flatten(0, 1)
    polarity = 1.0 if target.background == "light" else -1.0
    return rings_of(ellipses, torch.arange(COUNT).repeat_interleave(len(target)), polarity=polarity), r


def found(rings: Rings, target: Target) -> Identified:
    return identify(rings, MarkerTable.of([target]), CAMERA, COUNT, 1)


def solved(rings: Rings, target: Target) -> tuple[Identified, torch.Tensor]:
    """The markers of every frame, and the status of its pose."""
    table, result = MarkerTable.of([target]), found(rings, target)
    scene = Scene.of(torch.zeros(COUNT, 1, 1), CAMERA, table).of_rows(result.group)
    markers = replace(table[scene.target], radii=scene.printed_radii(scene.stated_gain(result.gain)))
    evidence = gather_evidence(rings, result.ring, markers, CAMERA)
    able = evidence.mask.sum(1) >= 3
    status = torch.full((COUNT,), int(Status.TOO_FEW_MARKERS))
    status[able] = solve_poses(evidence[able], (result.R[able], result.t[able])).status
    return result, status


@pytest.mark.parametrize(
    ("name", "gain"), [("quad40", -0.4), ("quad40", 0.3), ("quad40_dark", 0.4), ("hexa50", -0.4), ("hexa50", 0.2)]
)
@pytest.mark.parametrize("distance", [NEAR, FAR])
def test_all_markers_under_one_gain(name: str, gain: float, distance: tuple[float, float]) -> None:
    target = stating(Target.load(name), 0.2)
    rings, r = rings_on(target, gain, distance)
    result, status = solved(rings, target)
    assert torch.equal(result.ring, torch.arange(len(rings)).view(COUNT, len(target)))
    assert rotations.angle_between(result.R, r).max() < 0.2
    assert (status == Status.OK).all()
    # the codes are exact to 0.005 px, so what is left is the pull of the prior
    assert (result.gain - gain).abs().max() < 0.03 * abs(gain) + 0.01


@pytest.mark.parametrize("gain", [-0.4, 0.3, 0.35])
@pytest.mark.parametrize("distance", [NEAR, FAR])
def test_a_file_that_states_nothing_gives_no_wrong_marker(gain: float, distance: tuple[float, float]) -> None:
    """The codes have moved up or down by one, and three corners fit the target turned by a quarter."""
    target = Target.load("quad40")
    rings, _ = rings_on(target, gain, distance)
    result, status = solved(rings, target)
    wrong = ((result.ring >= 0) & (result.ring != torch.arange(len(rings)).view(COUNT, 4))).any(1)
    assert wrong.any()
    assert (status[wrong] != Status.OK).all()
    assert (status[wrong] != Status.AMBIGUOUS).all()


def test_office_prints_are_read_by_files_that_state_nothing() -> None:
    for name, gain in (("quad40", 0.1), ("quad40", -0.1), ("quad8", 0.06), ("hexa50", 0.1)):
        target = Target.load(name)
        scale = (8 / 40 if name == "quad8" else 1.0) * torch.tensor(NEAR)
        rings, _ = rings_on(target, gain, (float(scale[0]), float(scale[1])))
        assert torch.equal(found(rings, target).ring, torch.arange(len(rings)).view(COUNT, len(target))), name


def test_three_rings_that_fit_the_target_turned_are_right_or_refused() -> None:
    """Without the largest code the others are those of the next three corners, under another gain."""
    target = stating(Target.load("quad40"), 0.2)
    for gain in (-0.3, 0.0, 0.3):
        rings, _ = rings_on(target, gain, FAR)
        rank = target.radii[:, 1].argsort().argsort()
        result, status = solved(rings[rank.repeat(COUNT) < 3], target)
        code = torch.where(rank < 3, torch.cumsum(rank < 3, 0) - 1, -1)
        right = torch.where(rank < 3, code + 3 * torch.arange(COUNT)[:, None], -1)
        good = (result.ring == right).all(1)
        refused = (status == Status.REJECTED) | (status == Status.TOO_FEW_MARKERS)
        assert (refused | good).all()
        assert good.sum() > 0.8 * COUNT


@pytest.mark.parametrize("gain", [-0.3, 0.0, 0.3])
def test_sizes_tell_codes_apart_whatever_the_gain_is(gain: float) -> None:
    target = Target.load("quad40")
    r, t = random_poses(COUNT, 40.0, NEAR, seed=4)
    rings, _ = rings_on(target, gain)
    for step in (-1, 0, 1):
        # the same places with the radii of the neighbours in code
        taken = replace(target, radii=target.radii + torch.tensor([0.0, 0.5 * step], dtype=F64))
        table = MarkerTable.of([taken])
        every = table[torch.zeros(COUNT, dtype=torch.int64)]
        evidence = gather_evidence(rings, torch.arange(4 * COUNT).view(COUNT, 4), every, CAMERA)
        shift, _ = sizes_beyond(evidence, predicted_circles(evidence, r[:, None], t[:, None])[:, 0])
        # less what sizes may err by, 0.1 px of 30 in each of two radii, 0.07 codes here
        assert (shift - 0.93 * abs(step)).abs().max() < 0.05


def test_a_target_file_of_a_printer(tmp_path: Path) -> None:
    """Rendered prints, near and far: found with the right ids and poses where the file states the gain."""
    text = "".join(Path(str(tp.__path__[0]), "targets", "quad40.yaml").read_text().splitlines(keepends=True)[1:])
    (tmp_path / "target.yaml").write_text(text + "edge_gain_sigma: 0.2\n")
    stated, plain = Target.load(tmp_path / "target.yaml"), Target.load("quad40")
    r, t = random_poses(2, 35.0, NEAR, seed=5)
    for gain in (-0.4, 0.3):
        clean = render(CAMERA, printed(plain, gain), r, t, psf_sigma=0.7, dark=30.0, light=220.0)
        frames = add_noise(clean, 2.0, seed=6)
        poses = tp.PoseEstimator(CAMERA, stated)(frames)
        assert poses.ok.all()
        assert (poses.markers == 4).all()
        assert (torch.linalg.vector_norm(poses.t - t, dim=-1) < 0.2).all()
        assert (rotations.angle_between(poses.R, r) < 0.01).all()
        assert not tp.PoseEstimator(CAMERA, plain)(frames).ok.any()
