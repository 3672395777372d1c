"""PoseEstimator on rendered frames: accuracy, honesty of the covariance, and the shape of a batched pipeline."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal, get_args

import cv2
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import torchpose as tp
from tests.exact import F64, pinhole, random_poses
from torchpose.geometry import rotations
from torchpose.io.truth import read_truth
from torchpose.pipeline import Method
from torchpose.sim import add_noise, render

SAMPLE = Path(__file__).parent.parent / "data" / "sample"
QUAD = tp.Target.load("quad40")
MOST_OPERATIONS, MOST_NEAR = 7_420, 6_520  # of a clean frame, and of one whose last pose is known


@pytest.fixture(scope="module")
def sample() -> tuple[tp.PoseEstimator, Tensor]:
    """Estimator and the 12 frames of the sample."""
    camera = tp.Camera.load(SAMPLE / "camera.yaml")
    files = sorted((SAMPLE / "frames").glob("*.png"))
    frames = torch.stack([torch.from_numpy(cv2.imread(str(f), cv2.IMREAD_UNCHANGED)) for f in files])
    return tp.PoseEstimator(camera, tp.Target.load(SAMPLE / "target.yaml")), frames


@pytest.fixture(scope="module")
def poses(sample: tuple[tp.PoseEstimator, Tensor]) -> tp.Poses:
    estimator, frames = sample
    return estimator(frames)


def errors(poses: tp.Poses, r: Tensor, t: Tensor) -> Tensor:
    return torch.cat([poses.t - t, rotations.log(poses.R @ r.mT)], -1)


def test_sample_is_accurate(poses: tp.Poses) -> None:
    """RMS over the frames within 2 um lateral, 6 um depth, 0.01 degrees."""
    truth = read_truth(SAMPLE / "truth.csv")
    assert poses.ok.all()
    assert (poses.markers == 4).all()
    rms = errors(poses, truth.R, truth.t).square().mean(0).sqrt()
    assert rms[:2].max() < 2e-3
    assert rms[2] < 6e-3
    assert rms[3:].norm() < math.radians(0.01)


def test_each_frame_is_the_same_alone(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    estimator, frames = sample
    for i in range(len(frames)):
        alone = estimator(frames[i : i + 1])
        # mm: float32 sums of pixels depend on how a matrix product is cut up, to a hundred-thousandth of the noise
        assert (alone.t[0] - poses.t[i]).abs().max() < 5e-8
        assert (alone.R[0] - poses.R[i]).abs().max() < 1e-9
        assert alone.status[0] == poses.status[i]


class OpCount(TorchDispatchMode):
    """Counts dispatched tensor operations."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # of torch
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        with self:  # in inference mode compound operations arrive whole
            parts = func.decompose(*args, **(kwargs or {}))
        if parts is not NotImplemented:
            return parts
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_no_loop_over_frames(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    """Thirty-two frames cost as many tensor operations as one; only the solvers' iterations vary with the data."""
    estimator, frames = sample
    counts = {}
    for batch in (1, 32):
        some = frames[(torch.arange(batch) + 5) % len(frames)].contiguous()
        estimator(some)
        with OpCount() as ops:
            estimator(some)
        counts[batch] = ops.count
    assert counts[32] < 1.4 * counts[1]


def test_one_frame_takes_few_operations(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    """Every operation costs microseconds of dispatch on a CPU, and starves a GPU (docs/decisions/0114)."""
    estimator, frames = sample
    estimator(frames[:1])
    with OpCount() as ops:
        estimator(frames[:1])
    assert ops.count <= MOST_OPERATIONS


def test_one_tracked_frame_takes_fewer(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """No search, no hypotheses, no starts but the last pose, which is 12 px and half a degree off."""
    estimator, frames = sample
    move = torch.tensor([0.8, -0.6, 0.0], dtype=F64) * 12 * poses.t[0, 2] / estimator.camera.matrix[0, 0]
    turn = rotations.exp(torch.tensor([0.005, -0.005, 0.01], dtype=F64))
    near = (turn @ poses.R[0])[None, None], (poses.t[0] + move)[None, None]
    with OpCount() as ops:
        found = estimator(frames[:1], near=near)
    assert ops.count <= MOST_NEAR
    assert (errors(found, poses.R[:1], poses.t[:1]).abs() < 0.1 * poses.noise_std[:1]).all()


def test_autograd_takes_poses(poses: tp.Poses) -> None:
    """The pipeline runs in inference mode, whose own tensors autograd refuses to save."""
    scale = torch.ones((), dtype=F64, requires_grad=True)
    (scale * poses.t).square().sum().backward()
    assert scale.grad is not None
    assert torch.allclose(scale.grad, 2 * poses.t.square().sum())


@pytest.mark.parametrize("hidden", range(4))
def test_three_markers(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses, hidden: int) -> None:
    estimator, frames = sample
    frames = frames.clone()
    seen = poses.detections[poses.detections.marker == hidden]
    for f, (u, v), a in zip(seen.frame, seen.center.round().int(), seen.outer[:, 2], strict=True):
        reach = int(a) + 6
        frames[f, v - reach : v + reach, u - reach : u + reach] = 200
    result = estimator(frames)
    assert result.ok.all()
    assert (result.markers == 3).all()
    distance = errors(result, poses.R, poses.t)
    assert (distance.abs() < 6 * result.std).all()


def test_frames_without_a_target(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    estimator, frames = sample
    g = torch.Generator().manual_seed(0)
    blank = torch.zeros(4, *frames.shape[1:], dtype=torch.uint8)
    blank[1] = 255
    blank[2] = torch.randint(0, 256, frames.shape[1:], generator=g, dtype=torch.uint8)
    blank[3] = (128 + 8 * torch.randn(frames.shape[1:], generator=g)).clamp(0, 255).byte()
    result = estimator(blank)
    assert (result.status == tp.Status.NO_TARGET).all()
    assert result.R.isnan().all()
    assert len(result.detections) == 0


def test_same_poses_in_every_type(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """uint8, 16-bit and floating-point frames, with or without the channel of Kornia's convention.

    The coarse search rounds grey differently, so a few edge pixels differ, and with them a fraction of the deviation.
    """
    estimator, frames = sample
    few = frames[:3]
    unit = few.float() / 255
    scaled = tp.PoseEstimator(estimator.camera, QUAD, float_range=255.0)
    for result in (
        estimator((few.int() * 257).to(torch.uint16)),
        estimator(unit),
        estimator(unit[:, None].double()),
        scaled(few.float()),
    ):
        assert result.ok.all()
        assert ((result.t - poses.t[:3]).abs() < poses.std[:3, :3]).all()


def test_colour_frames_count_by_their_luma(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """As OpenCV reduces colour files, bit for bit."""
    estimator, frames = sample
    g = torch.Generator().manual_seed(0)
    tint = torch.tensor([0, -9, 14], dtype=torch.int16)[:, None, None]
    colour = (frames[:1, None].short() + tint + torch.randint(0, 3, (1, 3, *frames.shape[1:]), generator=g)).clamp(
        0, 255
    )
    colour = colour.to(torch.uint8)
    grey = torch.from_numpy(cv2.cvtColor(colour[0].permute(1, 2, 0).contiguous().numpy(), cv2.COLOR_RGB2GRAY))
    assert torch.equal(estimator(colour).t, estimator(grey[None]).t)


def test_wrong_frames_are_refused(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    estimator, _ = sample
    with pytest.raises(tp.FrameError, match="640 x 480"):
        estimator(torch.zeros(1, 480, 640, dtype=torch.uint8))
    with pytest.raises(tp.FrameError, match="shape"):
        estimator(torch.zeros(1, 2, 1216, 1824, dtype=torch.uint8))
    with pytest.raises(tp.FrameError, match="dtype"):
        estimator(torch.zeros(1, 1216, 1824, dtype=torch.int64))


def test_dead_pixels_are_ignored(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """NaN in one pixel of five hundred, also on the rings, costs nothing but these pixels."""
    estimator, frames = sample
    spoilt = frames[:2].float() / 255
    g = torch.Generator().manual_seed(0)
    spoilt[torch.rand(spoilt.shape, generator=g) < 0.002] = torch.nan
    result = estimator(spoilt)
    assert result.ok.all()
    assert ((result.t - poses.t[:2]).abs() < 5 * poses.std[:2, :3]).all()


def test_empty_batch(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    estimator, frames = sample
    assert len(estimator(frames[:0])) == 0


def test_covariance_is_honest() -> None:
    """NEES of 64 rendered frames, tilt to 50 degrees, noise 1 to 5, blur 0.6 to 1.2 px: mean 6, deviation 0.43."""
    camera = pinhole()
    estimator = tp.PoseEstimator(camera, QUAD)
    r, t = random_poses(64, 50, (140, 190), seed=3)
    g = torch.Generator().manual_seed(4)
    blur = 0.6 + 0.6 * torch.rand(64, generator=g, dtype=F64)
    noise = 1 + 4 * torch.rand(64, generator=g, dtype=F64)
    nees = []
    for i in range(0, 64, 16):
        s = slice(i, i + 16)
        frames = render(camera, QUAD, r[s], t[s], psf_sigma=blur[s], plate=(70.0, 70.0))
        result = estimator(add_noise(frames, noise[s], seed=i))
        assert result.ok.all()
        e = errors(result, r[s], t[s])
        nees.append((e[:, None] @ torch.linalg.inv(result.covariance) @ e[..., None]).flatten())
    assert 4.5 < torch.cat(nees).mean() < 7.5


def test_uncertain_intrinsics_widen_the_covariance(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """A focal length known to 0.25 % leaves the depth known to 0.25 %: the paper's eq. (5)."""
    estimator, frames = sample
    focal = estimator.camera.matrix[0, 0]
    spread = (0.0025 * focal) ** 2
    covariance = torch.zeros(4, 4, dtype=F64)
    covariance[:2, :2] = spread  # fx and fy err together
    camera = dataclasses.replace(estimator.camera, covariance=covariance)
    result = tp.PoseEstimator(camera, QUAD)(frames[:1])
    assert result.std[0, 2] == pytest.approx(0.0025 * result.t[0, 2].item(), rel=0.02)
    assert result.std[0, 0] < 3 * poses.std[0, 0]


def test_several_targets_in_one_frame(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """A target that is not there gets no pose from another one's rings, though it has some of their codes."""
    estimator, frames = sample
    both = tp.PoseEstimator(estimator.camera, [tp.Target.load("hexa50"), QUAD])(frames[:3])
    assert both.target.tolist() == [0, 1] * 3
    assert (both.status[0::2] == tp.Status.NO_TARGET).all()
    # where a target is missing rings are looked for at all scales: the same pose to a fraction of its deviations
    torch.testing.assert_close(both.t[1::2], poses.t[:3], rtol=0, atol=2e-5)


def test_two_targets_both_there() -> None:
    """A dark and a light target side by side, joined in one frame by the darker and the lighter half."""
    camera = pinhole()
    dark = tp.Target.load("quad40_dark")
    r = rotations.exp(torch.tensor([[0.1, 0.2, 0.3]], dtype=F64))
    left, right = torch.tensor([[-45.0, 0.0, 200.0]], dtype=F64), torch.tensor([[45.0, 5.0, 200.0]], dtype=F64)
    a = render(camera, QUAD, r, left, plate=(70.0, 70.0))
    b = render(camera, dark, r, right, plate=(70.0, 70.0), dark=30.0, light=220.0)
    half = camera.width // 2
    frame = torch.cat([a[..., :half], b[..., half:]], -1)
    result = tp.PoseEstimator(camera, [QUAD, dark])(add_noise(frame, 1.0))
    assert result.ok.all()
    assert (result.t - torch.cat([left, right])).abs().max() < 0.02


def test_names_must_differ(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    with pytest.raises(tp.ConfigError, match="twice"):
        tp.PoseEstimator(sample[0].camera, [QUAD, QUAD])


def test_wrong_target_is_rejected(sample: tuple[tp.PoseEstimator, Tensor]) -> None:
    estimator, frames = sample
    swapped = dataclasses.replace(QUAD, centers=QUAD.centers[[1, 0, 2, 3]])
    stretched = dataclasses.replace(QUAD, centers=QUAD.centers * torch.tensor([1.0, 1.05, 1.0], dtype=F64))
    for target in (swapped, stretched):
        result = tp.PoseEstimator(estimator.camera, target)(frames[:4])
        assert (result.status == tp.Status.REJECTED).all()
        assert (result.reason == tp.Reason.RESIDUAL).all()
        assert result.t.isnan().all()


def test_detections_in_raw_pixels(sample: tuple[tp.PoseEstimator, Tensor], poses: tp.Poses) -> None:
    """The compensated centres are where the distorted camera sees the marker's centre."""
    estimator, _ = sample
    d = poses.detections
    truth = read_truth(SAMPLE / "truth.csv")
    position = QUAD.centers[d.marker]
    uv = estimator.camera.project((truth.R[d.frame] @ position[..., None]).squeeze(-1) + truth.t[d.frame])
    e = d.center - uv
    assert e.square().mean().sqrt() < 0.02
    nees = (e[:, None] @ torch.linalg.inv(d.center_cov) @ e[..., None]).mean()
    assert 1.0 < nees < 3.5


@pytest.mark.parametrize("method", ["photometric", "edges"])
def test_refined_poses_follow_the_intrinsics_as_predicted(method: Literal["photometric", "edges"]) -> None:
    """The gain of uncertain intrinsics, column by column: the whole chain again with fx, fy, cx or cy changed."""
    camera, target = tp.Camera.load(SAMPLE / "camera.yaml"), QUAD
    r = rotations.exp(torch.tensor([[0.4, 0.3, 0.5], [0.6, -0.1, 1.0]], dtype=F64))
    t = torch.tensor([[10.0, -20, 160], [-20, 10, 200]], dtype=F64)
    # with noise, beside which a matrix so little off is none that residuals show
    frames = add_noise(render(camera, target, r, t), 3.0)

    def solved(matrix: Tensor, covariance: Tensor | None = None) -> tp.Poses:
        changed = dataclasses.replace(camera, matrix=matrix, covariance=covariance)
        return tp.PoseEstimator(changed, target, method=method)(frames)

    still = solved(camera.matrix)
    for k, (i, j) in enumerate(((0, 0), (1, 1), (0, 2), (1, 2))):
        shift = torch.zeros_like(camera.matrix)
        shift[i, j] = 0.1
        a, b = solved(camera.matrix + shift), solved(camera.matrix - shift)
        change = torch.cat([a.t - b.t, rotations.log(a.R @ b.R.mT)], 1).abs() / 0.2
        one = torch.zeros(4, 4, dtype=F64)
        one[k, k] = 1
        added = solved(camera.matrix, one).covariance - still.covariance
        predicted = added.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
        scale = predicted.amax(0, keepdim=True)
        assert ((change - predicted).abs() / (0.1 * predicted + 0.2 * scale)).max() < 1


def test_mirrored_frames_are_rejected() -> None:
    """What ReverseX of a camera or a mirror in the path makes of them; a target drawn y-up is one, too, and says so."""
    camera = tp.Camera.ideal(640, 480, 700.0)
    r, t = random_poses(2, 30, (150, 170), seed=4)
    t[:, :2] = 0
    frames = add_noise(render(camera, QUAD, r, t, psf_sigma=0.7), 1.0).flip(-1)
    poses = tp.PoseEstimator(camera, QUAD)(frames)
    assert poses.status.tolist() == [tp.Status.REJECTED] * 2
    assert poses.reason.tolist() == [tp.Reason.MIRRORED] * 2
    up = dataclasses.replace(QUAD, normals=-QUAD.normals)
    assert tp.PoseEstimator(camera, up)(frames).ok.all()


def test_no_row_is_ok_without_a_covariance() -> None:
    """Three of four markers of a camera that is off by up to 1 %, of small rings far away."""
    camera = tp.Camera.ideal(640, 480, 700.0)
    off = dataclasses.replace(camera, matrix=camera.matrix * torch.tensor([[1.01], [0.995], [1.0]], dtype=F64))
    r, t = random_poses(6, 20, (260, 300), seed=6)
    t[:, :2] = 0
    three = dataclasses.replace(QUAD, **{n: getattr(QUAD, n)[1:] for n in ("ids", "centers", "normals", "radii")})
    frames = add_noise(render(camera, three, r, t, psf_sigma=0.7), 1.0)
    for method in get_args(Method):
        poses = tp.PoseEstimator(off, QUAD, method=method)(frames)
        certain = poses[poses.ok]
        assert (torch.linalg.eigvalsh(certain.covariance)[:, 0] > 0).all()
        assert (certain.std > 0).all()
