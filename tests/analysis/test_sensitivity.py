"""Propagation against Monte-Carlo, against the Cramer-Rao bound and against what follows by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import pytest
import torch
from torch import Tensor

from tests.exact import exact_ellipses, pinhole
from torchpose.analysis import (
    Uncertainty,
    edge_noise,
    equations,
    pose_crlb,
    propagate,
    simulate_frames,
    simulate_points,
)
from torchpose.analysis.sensitivity import radius_shift
from torchpose.camera import Camera
from torchpose.ellipse import EllipseFit
from torchpose.geometry import rotations
from torchpose.pipeline import PoseEstimator
from torchpose.pose import centers as stage
from torchpose.results import Status
from torchpose.sim import add_noise, render
from torchpose.target import Target

# torch's forward mode loads a module that warns of torch's own use of torch.jit.script
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")

F64 = torch.float64
EYE = torch.eye(3, dtype=F64)[None]


def distorted() -> Camera:
    return replace(pinhole(), distortion=torch.tensor([-0.08, 0.02, 0.0002, -0.00015], dtype=F64))


def volume(
    distances: tuple[float, ...] = (120.0, 160.0, 300.0), tilts: tuple[float, ...] = (0, 15, 40)
) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses over distance, offset and tilt."""
    rows = [(tilt, x, y, z) for tilt in tilts for z in distances for x, y in ((0.0, 0.0), (18.0, 12.0))]
    tilt, x, y, z = torch.tensor(rows, dtype=F64).T
    zero = torch.zeros_like(tilt)
    axis = torch.stack([torch.full_like(tilt, math.cos(0.4)), torch.full_like(tilt, math.sin(0.4)), zero], -1)
    R = rotations.exp(axis * tilt.deg2rad()[:, None]) @ rotations.exp(torch.tensor([0.0, 0, 0.3], dtype=F64))
    return R, torch.stack([x, y, z], -1)


def spread(errors: Tensor) -> Tensor:
    assert not errors.isnan().any()
    return errors.square().mean(0).sqrt()


EACH = {
    "image": Uncertainty(image=0.05),
    "focal_length": Uncertainty(focal_length=0.0025),
    "principal_point": Uncertainty(principal_point=2.0),
    "distortion": Uncertainty(distortion=(1e-3, 1e-3, 1e-4, 1e-4)),
    "print_centers": Uncertainty(print_centers=0.01),
    "print_flatness": Uncertainty(print_flatness=0.02),
    "print_radii": Uncertainty(print_radii=0.05),
    "print_scale": Uncertainty(print_scale=1e-3),
}
ALL = Uncertainty(0.05, 0.0025, 2.0, (1e-3, 1e-3, 1e-4, 1e-4), 0.01, 0.02, 0.05, 1e-3)


def test_the_whole_budget_equals_monte_carlo_within_3_percent_over_the_working_volume() -> None:
    R, t = volume((120.0, 300.0), (0, 40))
    budget = propagate(distorted(), Target.load("quad40"), R, t, ALL)
    assert set(budget.sources) == set(EACH)
    drawn = simulate_points(distorted(), Target.load("quad40"), R, t, ALL, draws=10000, seed=1)
    ratio = spread(drawn) / budget.std()
    assert (ratio - 1).abs().max() < 0.03
    # with the correlations: 6 in the mean, with a standard deviation of 0.035 for one pose
    nees = (drawn * torch.linalg.solve(budget.total, drawn[..., None]).squeeze(-1)).sum(-1).mean(0)
    assert (nees - 6).abs().max() < 0.18


@pytest.mark.parametrize("source", EACH)
def test_every_source_equals_monte_carlo(source: str) -> None:
    R, t = volume((160.0,), (0, 40))
    camera, target, draws = distorted(), Target.load("quad40"), 3000
    budget = propagate(camera, target, R, t, EACH[source])
    drawn = spread(simulate_points(camera, target, R, t, EACH[source], draws=draws, seed=2))
    # 3.5 standard deviations of the estimate; second-order effects where the first order vanishes
    whole = propagate(camera, target, R, t, ALL).std()
    allowed = max(0.03, 3.5 / math.sqrt(2 * draws)) * budget.std(source) + 1e-3 * whole
    assert ((drawn - budget.std(source)).abs() < allowed).all()
    assert torch.equal(budget.total, budget.sources[source])


def test_centres_of_different_quality_are_weighted() -> None:
    R, t = volume((160.0,), (30,))
    target = Target.load("quad40")
    image = torch.diag_embed(torch.tensor([[0.05, 0.02], [0.02, 0.05], [0.2, 0.1], [0.03, 0.03]], dtype=F64).square())
    budget = propagate(distorted(), target, R, t, Uncertainty(image))
    drawn = spread(simulate_points(distorted(), target, R, t, Uncertainty(image), draws=8000))
    assert (drawn / budget.std() - 1).abs().max() < 0.03


@pytest.mark.parametrize("lens", [False, True])
def test_the_calibration_of_the_camera_file_is_a_source(lens: bool) -> None:
    root = torch.tensor([[2.0, 0, 0, 0], [1.9, 0.3, 0, 0], [0.1, 0.2, 1.5, 0], [0, 0.1, 0.3, 1.2]], dtype=F64)
    if lens:  # the distortion with its own deviations and in step with the focal length
        root = torch.block_diag(0.1 * root, torch.diag(torch.tensor([3e-3, 3e-3, 1e-4, 1e-4], dtype=F64)))
        root[4, 0], root[5, 4] = 1e-3, -2e-3
    camera = replace(distorted(), covariance=root @ root.T)
    R, t = volume((160.0,), (30,))
    budget = propagate(camera, Target.load("quad40"), R, t, Uncertainty())
    assert list(budget.sources) == ["calibration"]
    drawn = spread(simulate_points(camera, Target.load("quad40"), R, t, Uncertainty(), draws=6000))
    assert (drawn / budget.std() - 1).abs().max() < 0.03


def stating(target: Target, places: float | tuple[float, ...], gain: float) -> Target:
    """The target with deviations of its places and its edge gain, mm."""
    each = torch.tensor(places, dtype=F64).expand(len(target), 3).flatten()
    return replace(target, covariance=torch.diag(torch.cat([each, torch.tensor([gain], dtype=F64)]).square()))


def test_what_the_target_file_states_is_a_source() -> None:
    target = stating(Target.load("quad40_dark"), (0.01, 0.02, 0.05), 0.1)
    R, t = volume((160.0,), (0, 40))
    budget = propagate(distorted(), target, R, t, Uncertainty(0.02))
    assert list(budget.sources) == ["image", "target"]
    drawn = spread(simulate_points(distorted(), target, R, t, Uncertainty(0.02), draws=6000, seed=4))
    assert (drawn / budget.std() - 1).abs().max() < 0.03
    same = propagate(distorted(), Target.load("quad40_dark"), R, t, Uncertainty(0.02, print_centers=0.01))
    alike = stating(Target.load("quad40_dark"), (0.01, 0.01, 0.0), 0.0)
    again = propagate(distorted(), alike, R, t, Uncertainty(0.02))
    torch.testing.assert_close(again.sources["target"], same.sources["print_centers"], rtol=1e-6, atol=1e-15)


def test_what_a_target_shares_with_its_camera_counts_once() -> None:
    """Errors of focal length and of the target's size, in step: depth errs by their sum, or by their difference."""
    target, (R, t) = Target.load("quad40"), volume((160.0,), (0, 40))
    places = target.centers.flatten()
    share = 1e-3  # of focal length and of all lengths
    focal = distorted().matrix.diagonal()[:2]
    lens = torch.cat([focal, torch.zeros(6, dtype=F64)]) * share
    camera = replace(distorted(), covariance=torch.outer(lens, lens) + 1e-12 * torch.eye(8, dtype=F64), adjustment="a")
    of_target = torch.cat([share * places, torch.zeros(1, dtype=F64)])
    both = replace(
        target,
        covariance=torch.outer(of_target, of_target),
        adjustment="a",
        cross_covariance=torch.outer(of_target, lens),
    )
    budget = propagate(camera, both, R, t, Uncertainty(0.02))
    drawn = spread(simulate_points(camera, both, R, t, Uncertainty(0.02), draws=6000, seed=3))
    assert (drawn / budget.std() - 1).abs().max() < 0.03
    apart = propagate(camera, replace(both, adjustment="b"), R, t, Uncertainty(0.02))
    # face on both move the depth by 0.16 mm, together by twice that
    assert apart.sources["target"][0, 2, 2].sqrt() == pytest.approx(0.16, rel=0.01)
    assert budget.sources["calibration"][0, 2, 2].sqrt() == pytest.approx(0.32, rel=0.01)
    assert float(budget.sources["target"].diagonal(dim1=1, dim2=2).max()) < 1e-8
    opposite = propagate(camera, replace(both, cross_covariance=-both.cross_covariance), R, t, Uncertainty(0.02))  # type: ignore[operator]
    assert opposite.sources["calibration"][0, 2, 2].sqrt() < 0.002


@pytest.mark.parametrize(("place", "gain"), [(0.001, 0.001), (0.01, 0.015), (0.05, 0.05), ((0.02, 0.02, 0.06), 0.02)])
@pytest.mark.parametrize("name", ["quad40", "hexa50"])
def test_the_budget_of_rings_is_what_estimate_states(name: str, place: float | tuple[float, ...], gain: float) -> None:
    """Of rendered frames: all three sources, each where it counts, and the noise of the frame alone.

    Places that are off in height turn their rings besides.
    """
    square = torch.diag(torch.tensor([0.05, 0.05, 0.03, 0.03], dtype=F64).square())
    square = torch.block_diag(square, torch.diag(torch.tensor([1e-3, 1e-2, 1e-5, 1e-5], dtype=F64).square()))
    camera = replace(pinhole(800.0, 600, 500), distortion=distorted().distortion, covariance=square)
    target = stating(Target.load(name), place, gain)
    R, t = volume((160.0,), (0, 30))
    R, t = R[::2], t[::2]
    found = PoseEstimator(camera, target)(add_noise(render(camera, target, R, t, psf_sigma=0.7), 2.0, bits=8))
    assert (found.status == Status.OK).all()
    image = edge_noise(math.sqrt(2.0**2 + 1 / 12), 190.0, 0.7)
    budget = propagate(camera, target, R, t, Uncertainty(image), features="rings")
    assert list(budget.sources) == ["image", "calibration", "target"]
    stated = found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (stated / budget.std() - 1).abs().max() < 0.08
    noise = found.noise.diagonal(dim1=1, dim2=2).sqrt()
    # where the print decides all but everything, its weights do: a turn of 0.8 mrad by places has 6 or 24 urad of noise
    assert ((noise - budget.std("image")).abs() < 0.12 * budget.std("image") + 0.04 * stated).all()


def test_rings_reach_the_cramer_rao_bound() -> None:
    R, t = volume((160.0,), (0, 25, 40))
    camera, target = distorted(), Target.load("quad40")
    bound = pose_crlb(camera, target, R, t, noise_sigma=2.0, psf_sigma=0.9, bits=16)
    image = Uncertainty(edge_noise(2.0, 190.0, 0.9))
    budget = propagate(camera, target, R, t, image, features="rings")
    ratio = bound.diagonal(dim1=1, dim2=2).sqrt() / budget.std()
    assert (ratio - 1).abs().max() < 0.02


def test_centres_as_good_as_their_edges_allow_come_near_the_bound_and_not_below_it() -> None:
    camera, target = pinhole(), Target.load("quad40")
    t = torch.tensor([[0.0, 0, 160]], dtype=F64)
    length = target.radii.sum(1) * 2 * math.pi * 1111.11 / 160  # px of edge, face on
    one = edge_noise(2.0, 190.0, 0.7)
    # half of the edge lies along each axis
    image = (one**2 / (length / 2))[:, None, None] * torch.eye(2, dtype=F64)
    centers = propagate(camera, target, EYE, t, Uncertainty(image)).total[0]
    bound = pose_crlb(camera, target, EYE, t, noise_sigma=2.0, bits=16)[0]
    scale = bound.diagonal().rsqrt()
    more = torch.linalg.eigvalsh((centers - bound) * scale[:, None] * scale)
    assert more[0] > -0.01
    # what the size of the rings adds
    ratio = (centers.diagonal() / bound.diagonal()).sqrt()
    assert ratio.min() > 0.99
    assert ratio.max() < 1.12


@pytest.mark.parametrize("features", ["centers", "rings"])
def test_face_on_the_budget_is_what_the_papers_equations_say(features: Literal["centers", "rings"]) -> None:
    target, t = Target.load("quad40"), torch.tensor([[0.0, 0, 160]], dtype=F64)
    size = Uncertainty(image=0.2, focal_length=0.0025, principal_point=1.0, print_scale=0.001)
    budget = propagate(pinhole(), target, EYE, t, size, features=features)
    depth = budget.std("focal_length")[0]
    assert depth[2] == pytest.approx(equations.depth_focal_error(160.0, 1.0, 1 / (1 - 0.0025)))
    assert depth[[0, 1, 3, 4, 5]].abs().max() < 1e-9
    assert budget.std("print_scale")[0, 2] == pytest.approx(0.16)
    # eq. (3): one pixel of the principal point, half of it as a turn
    assert budget.std("principal_point")[0, :2].tolist() == pytest.approx([160 / 1111.11] * 2, rel=0.1)
    if features == "centers":
        # eq. (2) for the mean of the distances from the middle, of four markers with two coordinates each
        per_px = equations.depth_per_pixel(20.0, 1.0, 160.0, 1 / 1111.11)
        assert budget.std("image")[0, 2] == pytest.approx(0.2 * abs(per_px) / math.sqrt(8))
        assert budget.std("image")[0, 5] == pytest.approx(0.2 * 160 / 1111.11 / 20 / math.sqrt(8))


def test_wrong_radii_shift_the_centre_as_the_compensation_of_real_ellipses() -> None:
    target, (R, t) = Target.load("quad40"), volume((160.0,), (20, 40))
    printed = target.radii + torch.tensor([[0.02, -0.01], [0.0, 0.03], [-0.02, 0.0], [0.01, 0.01]], dtype=F64)
    camera = pinhole()
    found = []
    for nominal in (target.radii, printed):
        ellipses = exact_ellipses(replace(target, radii=printed), camera, R, t)
        none = torch.zeros(4, dtype=F64)
        for pose in ellipses:
            outer, inner = (EllipseFit(e, torch.zeros(4, 5, 5, dtype=F64), none, none) for e in pose.unbind(1))
            found.append(stage.compensate(outer, inner, nominal)[0])
    shift = torch.stack(found[: len(t)]) - torch.stack(found[len(t) :])
    c, n = target.centers @ R.mT + t[:, None], target.normals @ R.mT
    expected = radius_shift(c, n, printed.expand(len(t), -1, -1), target.radii) * 1111.11
    assert expected.abs().max() > 1e-3
    assert torch.allclose(shift, expected, atol=1e-9)


@pytest.mark.parametrize("source", ["focal_length", "print_scale"])
def test_rendered_frames_move_as_the_rings_say(source: str) -> None:
    R, t = volume((160.0,), (30,))
    camera, target = replace(pinhole(800.0, 600, 500), distortion=distorted().distortion), Target.load("quad40")
    # small enough for the grey values to raise no doubt: rows that they contradict are weighted anew
    size = Uncertainty(**{source: 0.001})  # type: ignore[arg-type]  # either field is a float
    std = propagate(camera, target, R, t, size, features="rings").std(source)
    drawn = simulate_frames(camera, target, R[:1], t[:1], size, draws=3, noise=0.1, bits=16)[:, 0]
    free = simulate_frames(camera, target, R[:1], t[:1], Uncertainty(), draws=3, noise=0.1, bits=16)[:, 0]
    # one number a draw: the same multiple of the standard deviation in all components that it moves; a wrong focal
    # length leaves residuals, so what it moves a little depends on how exactly the pixels are weighted
    moved = (drawn - free) / std[:1]
    lead = moved[:, 2:3].abs()
    strong = std[0] / free.std(0).clamp_min(1e-7) > 30
    assert strong[2]
    assert lead.min() > 0.05
    assert ((moved.abs() / lead - 1).abs()[:, strong] < 0.08).all()


@pytest.mark.slow
def test_wrong_radii_move_rendered_frames_as_the_rings_say() -> None:
    R, t = volume((160.0,), (30,))
    camera, target = pinhole(800.0, 600, 500), Target.load("quad40")
    size = Uncertainty(print_centers=0.02, print_radii=0.02)
    budget = propagate(camera, target, R, t, size, features="rings")
    drawn = simulate_frames(camera, target, R[:1], t[:1], size, draws=40, noise=0.5)[:, 0]
    # 3.5 standard deviations of both estimates
    assert ((spread(drawn) / budget.std()[0] - 1).abs() < 3.5 / math.sqrt(80)).all()
    nees = (drawn * torch.linalg.solve(budget.total[0], drawn[..., None]).squeeze(-1)).sum(-1).mean()
    assert abs(nees - 6) < 3.5 * math.sqrt(12 / 40)


def test_without_three_markers_in_view_there_is_no_pose() -> None:
    t = torch.tensor([[0.0, 0, 160], [130.0, 0, 160], [0, 0, -160]], dtype=F64)
    budget = propagate(pinhole(), Target.load("quad40"), EYE.expand(3, 3, 3), t, Uncertainty(0.1, 0.01))
    assert budget.seen.any(1).tolist() == [True, False, False]
    assert budget.std()[0].isfinite().all()
    assert budget.std()[1:].isnan().all()
    errors = simulate_points(pinhole(), Target.load("quad40"), EYE.expand(3, 3, 3), t, Uncertainty(0.1), draws=5)
    assert errors[:, 0].isfinite().all()
    assert errors[:, 1:].isnan().all()


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="focal_length is -1"):
        Uncertainty(focal_length=-1)
    with pytest.raises(ValueError, match="print_radii is nan"):
        Uncertainty(print_radii=math.nan)
    with pytest.raises(ValueError, match="distortion has 2 entries; the camera has 4"):
        propagate(distorted(), Target.load("quad40"), EYE, torch.ones(1, 3), Uncertainty(distortion=(1.0, 1.0)))
    with pytest.raises(ValueError, match="shapes"):
        propagate(distorted(), Target.load("quad40"), EYE, torch.ones(3), Uncertainty())
