"""One pose from several cameras: rendered moments of known poses, beside the joint bound."""

import pytest
import torch

import torchpose as tp
from tests.moments.rig_scenes import BLUR, NOISE, RIG, TARGET, errors, estimator, hidden, pictures, poses, rig
from torchpose.analysis import rig_crlb

F64 = torch.float64
COUNT = 6
# of the mean NEES of 6 poses, with 99.99 %
NEES = (1.8, 13.0)


def test_poses_are_as_good_as_the_joint_bound_and_say_so() -> None:
    R, t = poses(COUNT)
    found = estimator()(pictures(RIG, R, t))
    assert found.ok.tolist() == [True] * COUNT
    error, nees = errors(found, R, t)
    bound = rig_crlb(RIG, TARGET, R, t, psf_sigma=BLUR, noise_sigma=NOISE)
    least = bound.diagonal(dim1=1, dim2=2)
    # one row in ten or so is widened, since its cameras agree less than most
    torch.testing.assert_close(found.std.square().median(0).values, least.median(0).values, rtol=0.2, atol=0)
    assert bool((error.square().mean(0) < 3.5 * least.mean(0)).all())  # chi-squared of 6, 99.9 %
    assert NEES[0] < float(nees.mean()) < NEES[1]
    alone = tp.PoseEstimator(RIG.cameras[0], TARGET)(pictures(RIG, R, t)[0])
    assert float(alone.std[:, 2].mean()) > 3 * float(found.std[:, 2].mean())  # depth is what the others tell
    # what every row says of its cameras
    assert found.cameras.tolist() == [3] * COUNT
    assert found.share is not None
    assert found.consistency is not None
    torch.testing.assert_close(found.share.sum(1), torch.ones(COUNT, dtype=F64), rtol=0, atol=1e-6)
    assert found.consistency[:, 1].tolist() == [12.0] * COUNT
    assert float(found.consistency[:, 0].sum()) < 12 * COUNT + 4 * (24 * COUNT) ** 0.5
    assert sorted(set(found.detections.camera.tolist())) == [0, 1, 2]


def test_pictures_that_are_missing_contribute_nothing() -> None:
    R, t = poses(4, 1)
    frames = pictures(RIG, R, t)
    whole = estimator()(frames)
    seen = torch.ones(3, 4, dtype=torch.bool)
    seen[0, 0] = seen[1, 1] = seen[1:, 2] = seen[:, 3] = False
    frames[0][0] = 255 - frames[0][0]  # what stands there is not looked at
    frames[0][3] = 0
    found = estimator()(frames, seen)
    assert [tp.Status(s).name for s in found.status.tolist()] == ["OK", "OK", "OK", "NO_TARGET"]
    assert found.cameras.tolist() == [2, 2, 1, 0]
    _, nees = errors(found[:3], R[:3], t[:3])
    assert float(nees.max()) < 30
    assert found.share is not None
    assert found.share[0, 0] == 0
    # the one that the first camera has alone is that camera's own
    single = tp.PoseEstimator(RIG.cameras[0], TARGET)(frames[0][2:3])
    torch.testing.assert_close(found.t[2], single.t[0], rtol=0, atol=1e-8)
    torch.testing.assert_close(found.covariance[2], single.covariance[0], rtol=1e-6, atol=1e-14)
    # batches do not change what is found
    assert float((whole.t[0] - estimator()([f[:1] for f in pictures(RIG, R, t)]).t[0]).abs().max()) < 1e-6


def test_two_markers_in_every_camera_are_enough() -> None:
    R, t = poses(3, 2)
    frames = pictures(RIG, R, t)
    for number, markers in enumerate(([0, 1], [2, 3], [0, 2])):
        frames[number] = hidden(frames[number], RIG.cameras[number], RIG.seen_by(number, R, t), markers)
    alone = tp.PoseEstimator(RIG.cameras[0], TARGET)(frames[0])
    assert not bool(alone.ok.any())
    found = estimator()(frames)
    assert bool(found.ok.all())
    assert found.markers.tolist() == [4] * 3
    error, nees = errors(found, R, t)
    assert float(nees.max()) < 30
    assert float(error[:, :3].abs().max()) < 0.005


def test_a_camera_is_told_where_to_look() -> None:
    """A camera that sees one marker, of which the others tell which one it is."""
    R, t = poses(2, 3)
    frames = pictures(RIG, R, t)
    frames[2] = hidden(frames[2], RIG.cameras[2], RIG.seen_by(2, R, t), [0, 1, 2])
    found = estimator()(frames)
    assert bool(found.ok.all())
    assert found.cameras.tolist() == [3, 3]
    assert found.share is not None
    assert bool((found.share[:, 2] < found.share[:, 1]).all())
    seen = found.detections
    assert seen.camera is not None
    assert seen.marker[seen.camera == 2].tolist() == [3, 3]
    assert float(errors(found, R, t)[1].max()) < 30


def test_cameras_that_contradict_each_other_are_rejected_and_the_odd_one_is_named() -> None:
    R, t = poses(3, 4)
    knocked = torch.zeros(3, 6, dtype=F64)
    knocked[1, 4] = 1e-3  # 0.6 px
    found = estimator()(pictures(RIG, R, t, knocked))
    assert [tp.Reason(r).name for r in found.reason.tolist()] == ["CAMERAS_DISAGREE"] * 3
    assert found.odd is not None
    assert found.odd.tolist() == [1, 1, 1]
    assert not bool(found.t.isfinite().any())  # no average of right and wrong
    knocked[1, 4] = 0.1  # 60 px: its own pose is another one
    far = estimator()(pictures(RIG, R, t, knocked))
    assert [tp.Reason(r).name for r in far.reason.tolist()] == ["CAMERAS_DISAGREE"] * 3
    assert far.odd is not None
    assert far.odd.tolist() == [1, 1, 1]
    # two cameras contradict each other, and nobody knows which of them is right
    two = tp.PoseEstimator(rig(0, 35), TARGET)(pictures(rig(0, 35), R, t, knocked[:2]))
    assert [tp.Reason(r).name for r in two.reason.tolist()] == ["CAMERAS_DISAGREE"] * 3
    assert two.odd is not None
    assert two.odd.tolist() == [-1, -1, -1]


def test_small_knocks_widen_and_places_that_are_stated_are_weighed() -> None:
    R, t = poses(COUNT, 5)
    knocked = torch.zeros(3, 6, dtype=F64)
    knocked[1, 4] = 3e-5  # 0.02 px, several deviations of a ring's centre
    found = estimator()(pictures(RIG, R, t, knocked))
    good = found.ok.nonzero()[:, 0]
    _, nees = errors(found[good], R[good], t[good])
    assert len(good) < COUNT or float(nees.max()) < 30
    covariance = torch.diag(torch.tensor([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4] * 2, dtype=F64).square())
    stated = rig(0, 35, -35, covariance=covariance)
    found = tp.PoseEstimator(stated, TARGET)(pictures(stated, R, t, knocked))
    assert bool(found.ok.all())
    error, nees = errors(found, R, t)
    assert float(nees.max()) < 30
    assert float((error / found.std).abs().max()) < 4
    assert found.systematic.shape[-1] == 12 == found.of_camera
    # what places leave open is the same in all frames: it is no part of how far the pose scatters
    assert bool((found.noise_std < found.std).all())


@pytest.mark.parametrize("method", ["edges", "centers"])
def test_other_methods(method: str) -> None:
    R, t = poses(3, 6)
    found = tp.PoseEstimator(RIG, TARGET, method=method)(pictures(RIG, R, t))  # type: ignore[arg-type]
    assert bool(found.ok.all())
    error, nees = errors(found, R, t)
    assert float(error[:, :3].abs().max()) < 0.01
    assert float(nees.mean()) < 13


def test_what_is_wrong_is_said() -> None:
    cameras = rig(0, 35)
    one = tp.PoseEstimator(cameras, TARGET)
    frames = [torch.zeros(2, 480, 640, dtype=torch.uint8), torch.zeros(2, 440, 600, dtype=torch.uint8)]
    assert one(frames).status.tolist() == [tp.Status.NO_TARGET] * 2
    with pytest.raises(tp.FrameError, match="give a sequence of 2 tensors"):
        one(frames[:1])
    with pytest.raises(tp.FrameError, match="the cameras have 1, 2 frames"):
        one([frames[0], frames[1][:1]])
    with pytest.raises(tp.FrameError, match="size 640 x 480, but the camera has 600 x 440"):
        one([frames[0], frames[0]])
    with pytest.raises(tp.FrameError, match=r"seen: has shape \(1, 2\)"):
        one(frames, torch.ones(1, 2, dtype=torch.bool))
    with pytest.raises(tp.ConfigError, match="instances: 2 given"):
        tp.PoseEstimator(cameras, TARGET, instances=2)
    with pytest.raises(tp.ConfigError, match="method: 'paper' is of one camera"):
        tp.PoseEstimator(cameras, TARGET, method="paper")
