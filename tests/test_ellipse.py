"""Ellipse fits against analytic truth, OpenCV, scikit-image and Monte-Carlo."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh
from scipy.stats import chi2
from skimage.measure import EllipseModel

from scripts import arc_statistics
from torchpose import ellipse
from torchpose.geometry import conics

no_deadline = settings(deadline=None)


def random_ellipses(count: int, generator: torch.Generator, least_ratio: float = 0.2) -> torch.Tensor:
    u = torch.rand(count, 5, generator=generator, dtype=torch.float64)
    a = 5 + 200 * u[:, 2]
    return torch.stack(
        [4000 * u[:, 0], 3000 * u[:, 1], a, a * (least_ratio + (1 - least_ratio) * u[:, 3]), math.pi * u[:, 4]], -1
    )


def sample(
    truth: torch.Tensor, points: int, generator: torch.Generator, arc: float = 2 * math.pi, noise: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Flat points on an arc of each ellipse, with normal noise in u and v, and their index."""
    count = truth.shape[0]
    start = 2 * math.pi * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    angle = start + arc * torch.arange(points, dtype=torch.float64) / points
    xy = conics.points_on(truth[:, None].expand(-1, points, -1), angle).reshape(-1, 2)
    xy = xy + noise * torch.randn(xy.shape, generator=generator, dtype=torch.float64)
    return xy, torch.arange(count).repeat_interleave(points)


def assert_same_ellipses(actual: torch.Tensor, expected: torch.Tensor, atol: float, rtol: float = 0.0) -> None:
    """Compares centre and shape matrix, which are smooth where theta is not."""
    torch.testing.assert_close(actual[:, :2], expected[:, :2], rtol=rtol, atol=atol)
    torch.testing.assert_close(conics.shape_matrix(actual), conics.shape_matrix(expected), rtol=rtol, atol=atol)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


@pytest.mark.parametrize(("arc", "atol"), [(2 * math.pi, 1e-9), (math.pi, 1e-8), (math.pi / 2, 1e-5)])
def test_exact_points(generator: torch.Generator, arc: float, atol: float) -> None:
    truth = random_ellipses(500, generator)
    xy, index = sample(truth, 60, generator, arc)
    order = torch.randperm(index.numel(), generator=generator)
    found = ellipse.fit(xy[order], index[order], 500)
    assert_same_ellipses(found, truth, atol)
    assert (found[:, 2] >= found[:, 3]).all()
    assert ((found[:, 4] >= 0) & (found[:, 4] < math.pi)).all()


@pytest.mark.parametrize("arc", [2 * math.pi, math.pi, 2.0])
def test_equals_halir_flusser(generator: torch.Generator, arc: float) -> None:
    """The textbook algorithm in NumPy: normalised points, eigenvectors of C^-1 (S1 - S2 S3^-1 S2^T)."""
    truth = random_ellipses(60, generator)
    xy, index = sample(truth, 80, generator, arc, noise=0.3)
    found = ellipse.fit(xy, index, 60)
    for k in range(60):
        p = xy[index == k].numpy()
        shift, scale = p.mean(0), p.std()
        x, y = ((p - shift) / scale).T
        d1, d2 = np.stack([x * x, x * y, y * y], 1), np.stack([x, y, np.ones_like(x)], 1)
        t = -np.linalg.solve(d2.T @ d2, d2.T @ d1)
        m = np.linalg.solve([[0, 0, 2], [0, -1, 0], [2, 0, 0]], d1.T @ d1 + d1.T @ d2 @ t)
        vectors = np.linalg.eig(m)[1].real
        a1 = vectors[:, 4 * vectors[0] * vectors[2] - vectors[1] ** 2 > 0][:, 0]
        expected = conics.ellipse_from_conic(torch.from_numpy(np.concatenate([a1, t @ a1])))
        expected[:4] *= scale
        expected[:2] += torch.from_numpy(shift)
        assert_same_ellipses(found[k, None], expected[None], atol=1e-6)


@pytest.mark.parametrize("arc", [2 * math.pi, math.pi])
def test_equals_opencv_direct(generator: torch.Generator, arc: float) -> None:
    truth = random_ellipses(100, generator, least_ratio=0.4)
    # OpenCV takes float32 points: near the origin they lose nothing that matters here
    truth[:, :2] = 0
    xy, index = sample(truth, 100, generator, arc, noise=0.2)
    found = ellipse.fit(xy, index, 100)
    for k in range(100):
        (cx, cy), (d1, d2), degrees = cv2.fitEllipseDirect(xy[index == k].float().numpy())
        expected = torch.tensor([[cx, cy, d1 / 2, d2 / 2, math.radians(degrees)]], dtype=torch.float64)
        assert_same_ellipses(found[k, None], expected, atol=5e-3)


def test_equals_scikit_image(generator: torch.Generator) -> None:
    truth = random_ellipses(25, generator)
    xy, index = sample(truth, 60, generator, noise=0.1)
    found = ellipse.fit(xy, index, 25)
    for k in range(25):
        model = EllipseModel.from_estimate(xy[index == k].numpy())
        expected = torch.tensor([[*model.center, *model.axis_lengths, model.theta]], dtype=torch.float64)
        # scikit-image minimises the orthogonal distance: a fraction of the fit's own scatter apart
        assert_same_ellipses(found[k, None], expected, atol=0.03)


@no_deadline
@given(
    st.integers(0, 2**31),
    st.floats(-5000, 5000),
    st.floats(-5000, 5000),
    st.floats(0, 2 * math.pi),
    st.floats(0.05, 50),
)
def test_equivariance(seed: int, du: float, dv: float, angle: float, scale: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    truth = random_ellipses(3, generator)
    xy, index = sample(truth, 40, generator, arc=5.0, noise=0.3)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    shift = torch.tensor([du, dv], dtype=torch.float64)
    found, moved = ellipse.fit(xy, index, 3), ellipse.fit(scale * xy @ turn.T + shift, index, 3)
    tolerance = 1e-6 * scale
    torch.testing.assert_close(moved[:, :2], scale * found[:, :2] @ turn.T + shift, rtol=0, atol=tolerance)
    shape = scale * turn @ conics.shape_matrix(found) @ turn.T
    torch.testing.assert_close(conics.shape_matrix(moved), shape, rtol=0, atol=tolerance)


def test_float32_raw_pixels(generator: torch.Generator) -> None:
    truth = random_ellipses(50, generator)
    truth[:, :2] += torch.tensor([4000.0, 3000.0])
    xy, index = sample(truth, 100, generator)
    # the points themselves are rounded to 2.4e-4 px; the fit must add nothing
    assert_same_ellipses(ellipse.fit(xy.float(), index, 50), truth, atol=1e-3)


LINE = torch.linspace(0, 90, 30, dtype=torch.float64)
DEGENERATE = {
    "none": torch.zeros(0, 2),
    "five": torch.tensor([[0.0, 0], [4, 0], [4, 3], [0, 3], [2, 4]]),
    "collinear": torch.stack([100.1 + 3 * LINE, 200.7 - 1.7 * LINE], -1),
    "vertical": torch.stack([100.1 + 0 * LINE, LINE], -1),
    "coincident": torch.full((20, 2), 100.1),
    "two places": torch.tensor([[1.1, 2.3], [5.7, 9.1]]).repeat(10, 1),
    "nan": torch.tensor([[0.0, 0], [4, 0], [4, 3], [0, 3], [2, 4], [2, -1], [math.nan, 2]]),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_points_are_nan_and_leave_the_neighbours_alone(generator: torch.Generator, name: str) -> None:
    truth = random_ellipses(2, generator)
    xy, index = sample(truth, 30, generator, noise=0.1)
    bad = DEGENERATE[name].double()
    points, at = torch.cat([xy, bad]), torch.cat([2 * index, torch.ones(len(bad), dtype=torch.int64)])
    found = ellipse.fit(points, at, 3)
    assert found[1].isnan().all()
    torch.testing.assert_close(found[[0, 2]], ellipse.fit(xy, index, 2), rtol=1e-10, atol=0)
    measured = ellipse.with_covariance(points, at, found)
    assert measured.covariance[1].isnan().all()
    assert measured.covariance[[0, 2]].isfinite().all()


def test_no_ellipses() -> None:
    nothing, index = torch.zeros(0, 2), torch.zeros(0, dtype=torch.int64)
    params = ellipse.fit(nothing, index, 0)
    assert params.shape == (0, 5)
    assert params.dtype == torch.float64
    assert ellipse.fit_robust(nothing, index, 0, start=params)[0].shape == (0, 5)
    assert ellipse.with_covariance(nothing, index, params).covariance.shape == (0, 5, 5)


def test_weights_repeat_points(generator: torch.Generator) -> None:
    truth = random_ellipses(4, generator)
    xy, index = sample(truth, 30, generator, noise=0.5)
    weights = torch.randint(0, 4, index.shape, generator=generator)
    expected = ellipse.fit(xy.repeat_interleave(weights, 0), index.repeat_interleave(weights), 4)
    assert_same_ellipses(ellipse.fit(xy, index, 4, weights), expected, atol=1e-8)
    assert_same_ellipses(ellipse.fit(xy, index, 4, 1e-3 * weights), expected, atol=1e-8)
    xy[weights == 0] = math.nan
    assert_same_ellipses(ellipse.fit(xy, index, 4, weights), expected, atol=1e-8)


def test_gradient(generator: torch.Generator) -> None:
    truth = torch.tensor([[10.0, 20, 9, 6, 0.5], [-5, 3, 12, 4, 2.0]], dtype=torch.float64)
    xy, index = sample(truth, 12, generator, noise=0.2)
    assert torch.autograd.gradcheck(lambda p: ellipse.fit(p, index, 2), xy.requires_grad_())


def test_distance_of_circles(generator: torch.Generator) -> None:
    circle = torch.tensor([[3.0, 4, 10, 10, 0.0]], dtype=torch.float64)
    xy = 30 * torch.randn(50, 2, generator=generator, dtype=torch.float64)
    expected = (xy - circle[0, :2]).norm(dim=-1) - 10
    torch.testing.assert_close(ellipse.distance(xy, torch.zeros(50, dtype=torch.int64), circle), expected)


def test_distance_near_ellipses(generator: torch.Generator) -> None:
    truth = random_ellipses(200, generator, least_ratio=0.3)
    xy, index = sample(truth, 1, generator)
    s = conics.shape_matrix(truth)
    normal = torch.linalg.solve(s @ s, (xy - truth[:, :2])[..., None]).squeeze(-1)
    offset = 0.01 * torch.randn(200, 1, generator=generator, dtype=torch.float64)
    moved = xy + offset * normal / normal.norm(dim=-1, keepdim=True)
    # first order: what is left is the square of the offset times a curvature, up to a / b^2
    bound = offset[:, 0].square() * 4 * truth[:, 2] / truth[:, 3].square()
    error = (ellipse.distance(moved, index, truth) - offset[:, 0]).abs()
    assert (error < bound + 1e-12).all()


def test_curvature(generator: torch.Generator) -> None:
    """Against the parametric formula a b / (a^2 sin^2 + b^2 cos^2)^(3/2), also from points off the ellipse."""
    truth = random_ellipses(100, generator, least_ratio=0.3)
    angle = 2 * math.pi * torch.rand(100, generator=generator, dtype=torch.float64)
    a, b = truth[:, 2], truth[:, 3]
    expected = a * b / ((a * angle.sin()).square() + (b * angle.cos()).square()).pow(1.5)
    index = torch.arange(100)
    xy = conics.points_on(truth, angle)
    torch.testing.assert_close(ellipse.curvature(xy, index, truth), expected)
    away = truth[:, :2] + 1.02 * (xy - truth[:, :2])
    torch.testing.assert_close(ellipse.curvature(away, index, truth), expected)


def test_robust_fit(generator: torch.Generator) -> None:
    """35 % of the points elsewhere: a covering straight edge, or a neighbouring concentric ring."""
    truth = random_ellipses(60, generator, least_ratio=0.4)
    truth[:, 2:4] += 20
    xy, index = sample(truth, 200, generator, noise=0.05)
    position = torch.arange(200).repeat(60)
    stray = position < 70
    near = truth[index].clone()
    near[:, 2:4] -= 4 + 3 * torch.rand(index.numel(), 1, generator=generator, dtype=torch.float64)
    angle = 2 * math.pi * torch.rand(index.numel(), generator=generator, dtype=torch.float64)
    scattered = conics.points_on(near, angle)
    points = torch.where(stray[:, None], scattered, xy)
    start = truth + torch.tensor([1.0, -1, 1, 1, 0.0])
    found, keep = ellipse.fit_robust(points, index, 60, start=start)
    assert (keep & stray).sum() == 0
    assert keep[~stray].double().mean() > 0.99
    clean = ellipse.fit(xy[~stray], index[~stray], 60)
    assert_same_ellipses(found, clean, atol=0.02)


def test_fit_near_is_the_fit_of_what_the_first_one_passes_near(generator: torch.Generator) -> None:
    """By its definition: distances from a first fit, and their weights in a second one."""
    truth = random_ellipses(40, generator)
    xy, index = sample(truth, 100, generator, noise=0.3)
    stray = torch.rand(len(xy), generator=generator) < 0.1
    xy = torch.where(stray[:, None], xy + 2.0, xy)
    weights = 0.5 + torch.rand(len(xy), generator=generator, dtype=torch.float64)
    first = ellipse.fit(xy, index, 40, weights)
    far = (ellipse.distance(xy, index, first) / 3).square()
    wanted = ellipse.fit(xy, index, 40, weights * (1 - far).clamp_min(0).square())
    assert_same_ellipses(ellipse.fit_near(xy, index, 40, weights, 3.0), wanted, atol=1e-9)
    line = torch.linspace(0, 9, 10, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0], dtype=torch.float64)
    assert ellipse.fit_near(line, torch.zeros(10, dtype=torch.int64), 1, None, 3.0).isnan().all()


def test_robust_fit_of_clean_points_is_the_plain_fit(generator: torch.Generator) -> None:
    truth = random_ellipses(20, generator)
    xy, index = sample(truth, 100, generator, noise=0.03)
    found, keep = ellipse.fit_robust(xy, index, 20, start=truth + 0.5)
    plain = ellipse.fit(xy[keep], index[keep], 20)
    assert keep.double().mean() > 0.999
    torch.testing.assert_close(found, plain, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("shape", "arc"), [((60.0, 60.0, 0.0), 2 * math.pi), ((60.0, 25.0, 0.7), 2 * math.pi), ((80.0, 60.0, 2.5), 4.5)]
)
def test_covariance_against_monte_carlo(shape: tuple[float, float, float], arc: float) -> None:
    generator = torch.Generator().manual_seed(11)
    trials, points = 3000, 150
    truth = torch.tensor([200.0, 150.0, *shape], dtype=torch.float64).expand(trials, 5)
    angle = 0.3 + arc * torch.arange(points, dtype=torch.float64) / points
    xy = conics.points_on(truth[:, None].expand(-1, points, -1), angle).reshape(-1, 2)
    xy = xy + 0.1 * torch.randn(xy.shape, generator=generator, dtype=torch.float64)
    index = torch.arange(trials).repeat_interleave(points)
    fitted = ellipse.with_covariance(xy, index, ellipse.fit(xy, index, trials))
    cos, sin = math.cos(shape[2]), math.sin(shape[2])
    axes = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    change = axes.T @ (conics.shape_matrix(fitted.params) - conics.shape_matrix(truth)) @ axes
    error = torch.cat([fitted.params[:, :2] - truth[:, :2], change[:, [0, 0, 1], [0, 1, 1]]], -1)
    # each fit gives E in its own axes; those of a circle are arbitrary, so turn all covariances into the true axes
    covariance = _turned(fitted.covariance, fitted.params[:, 4] - shape[2])
    nees = (error[:, None] @ torch.linalg.solve(covariance, error[..., None])).flatten()
    # sigma^2 has 145 degrees of freedom: the mean of 5 F(5, 145) is 5 * 145 / 143
    assert nees.mean() == pytest.approx(5 * 145 / 143, abs=5 * math.sqrt(10 / trials))
    assert (nees > chi2.ppf(0.99, 5)).double().mean() < 0.02
    assert fitted.sigma.mean() == pytest.approx(0.1, rel=0.02)
    torch.testing.assert_close(fitted.points, torch.full((trials,), float(points), dtype=torch.float64))


def _turned(covariance: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Covariances of (c, e11, e12, e22) with E turned from axes at ``angle`` to axes at 0: E' = T E T^T."""
    c, s = angle.cos(), angle.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = [
        [one, zero, zero, zero, zero],
        [zero, one, zero, zero, zero],
        [zero, zero, c * c, -2 * c * s, s * s],
        [zero, zero, c * s, c * c - s * s, -c * s],
        [zero, zero, s * s, 2 * c * s, c * c],
    ]
    m = torch.stack([torch.stack(r, -1) for r in rows], -2)
    return m @ covariance @ m.mT


def test_correlation_scales_the_covariance(generator: torch.Generator) -> None:
    xy, index = sample(random_ellipses(3, generator), 50, generator, noise=0.1)
    params = ellipse.fit(xy, index, 3)
    one, two = (ellipse.with_covariance(xy, index, params, correlation=c).covariance for c in (1.0, 2.0))
    torch.testing.assert_close(two, 2 * one)


def test_batch_invariance(generator: torch.Generator) -> None:
    truth = random_ellipses(5, generator)
    xy, index = sample(truth, 40, generator, noise=0.2)
    together = ellipse.fit(xy, index, 5)
    for k in range(5):
        alone = ellipse.fit(xy[index == k], torch.zeros(40, dtype=torch.int64), 1)
        torch.testing.assert_close(alone[0], together[k], rtol=1e-12, atol=0)


def test_taubin_on_arcs(generator: torch.Generator) -> None:
    """Bias of the major axis on short arcs: the direct fit shrinks, Taubin's hardly."""
    trials, arc, noise = 600, math.pi / 2, 0.1
    truth = torch.tensor([50.0, 40, 60, 50, 0.3], dtype=torch.float64).expand(trials, 5)
    angle = arc * torch.arange(150, dtype=torch.float64) / 150
    xy = conics.points_on(truth[:, None].expand(-1, 150, -1), angle).reshape(-1, 2)
    xy = xy + noise * torch.randn(xy.shape, generator=generator, dtype=torch.float64)
    index = torch.arange(trials).repeat_interleave(150)
    direct, better = (ellipse.fit(xy, index, trials, method=m).nanmedian(0).values for m in ("halir-flusser", "taubin"))
    assert truth[0, 2] - direct[2] > 1.0
    assert abs(truth[0, 2] - better[2]) < 0.3


def test_taubin_on_whole_ellipses(generator: torch.Generator) -> None:
    truth = random_ellipses(50, generator, least_ratio=0.4)
    xy, index = sample(truth, 200, generator)
    assert_same_ellipses(ellipse.fit(xy, index, 50, method="taubin"), truth, atol=1e-8)
    noisy = xy + 0.05 * torch.randn(xy.shape, generator=generator, dtype=torch.float64)
    both = [ellipse.fit(noisy, index, 50, method=m) for m in ("halir-flusser", "taubin")]
    assert_same_ellipses(both[1], both[0], atol=0.01)


def test_taubin_is_the_generalised_eigenvector(generator: torch.Generator) -> None:
    """Against scipy on the raw coordinates: scatter of (x^2, xy, y^2, x, y, 1) against that of its gradients."""
    truth = torch.tensor([[3.0, -2, 9, 5, 0.7]], dtype=torch.float64)
    xy, index = sample(truth, 60, generator, arc=3.0, noise=0.1)
    x, y = xy.numpy().T
    one, zero = np.ones_like(x), np.zeros_like(x)
    design = np.stack([x * x, x * y, y * y, x, y, one], -1)
    gradient = np.concatenate(
        [np.stack([2 * x, y, zero, one, zero, zero], -1), np.stack([zero, x, 2 * y, zero, one, zero], -1)]
    )
    # N is singular: the largest mu of N a = mu M a is the smallest lambda of M a = lambda N a
    _, vectors = eigh(gradient.T @ gradient, design.T @ design)
    expected = conics.ellipse_from_conic(torch.from_numpy(vectors[:, -1]))
    assert_same_ellipses(ellipse.fit(xy, index, 1, method="taubin"), expected[None], atol=1e-6)


@pytest.mark.parametrize("method", ["halir-flusser", "taubin"])
def test_every_layout_gives_the_same_fit(generator: torch.Generator, method: ellipse.Method) -> None:
    """Equal counts, unequal counts, unsorted points, blocks."""
    truth = random_ellipses(9, generator, least_ratio=0.4)
    xy, index = sample(truth, 40, generator, noise=0.1)
    expected = ellipse.fit(xy, index, 9, method=method)
    assert_same_ellipses(ellipse.fit_blocks(xy.view(9, 40, 2), method=method), expected, atol=1e-9)
    order = torch.randperm(len(index), generator=generator)
    assert_same_ellipses(ellipse.fit(xy[order], index[order], 9, method=method), expected, atol=1e-9)
    more, at = torch.cat([xy[:7], xy]), torch.cat([index[:7], index])
    weights = torch.cat([torch.zeros(7), torch.ones(len(index))])
    assert_same_ellipses(ellipse.fit(more, at, 9, weights, method=method), expected, atol=1e-9)


@pytest.mark.parametrize(("arc_deg", "noise"), [(90, 0.05), (90, 0.1), (60, 0.05)])
def test_taubin_is_nearly_the_geometric_fit(arc_deg: float, noise: float) -> None:
    """Against scipy's least squares of the true distances on short arcs; scripts/arc_statistics.py has more of them."""
    g = torch.Generator().manual_seed(3)
    truth, count = torch.tensor([50.3, 50.7, *arc_statistics.AXES, 0.4], dtype=torch.float64).expand(3, 5), 40
    xy, index = sample(truth, count, g, math.radians(arc_deg), noise)
    found, points = ellipse.fit(xy, index, 3, method="taubin").numpy(), xy.view(3, count, 2).numpy()
    ratios = []
    for k in range(3):
        if np.isfinite(found[k]).all():
            best = arc_statistics.geometric(points[k], truth[k].numpy())
            costs = [np.square(arc_statistics.foot(one, points[k])[0]).sum() for one in (found[k], best)]
            assert costs[1] <= costs[0] * (1 + 1e-4), "the geometric fit is the best one"
            ratios.append(math.sqrt(costs[0] / costs[1]))
    assert len(ratios) >= 2
    assert max(ratios) < 1.01


def test_distances_to_an_ellipse_are_those_of_a_search(generator: torch.Generator) -> None:
    """The reference itself: the nearest of 200,000 points of the ellipse."""
    truth = torch.tensor([[50.3, 50.7, 30, 22, 0.4]], dtype=torch.float64)
    xy, _ = sample(truth, 25, generator, noise=0.5)
    dense = conics.points_on(truth.expand(200_000, 5), torch.linspace(0, 2 * math.pi, 200_000).double())
    nearest = torch.stack([(dense - point).norm(dim=-1).amin() for point in xy])
    found = np.abs(arc_statistics.foot(truth[0].numpy(), xy.numpy())[0])
    np.testing.assert_allclose(found, nearest.numpy(), atol=6e-4)  # half a step of the search, the most
