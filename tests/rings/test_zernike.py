"""Zernike moments against quadrature, ideal edges, and the noise of many frames."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad_vec
from scipy.special import ndtr

from tests.exact import F64
from torchpose.geometry.blur import isotropic
from torchpose.rings import zernike
from torchpose.rings.zernike import Edges


def zernike_polynomials(x: float, y: np.ndarray, orders: tuple[tuple[int, int], ...]) -> np.ndarray:
    """R_nm cos(m theta), R_nm sin(m theta) as polynomials in x and y, through z^m = rho^m e^(i m theta)."""
    rho2, z = x * x + y * y, x + 1j * y
    planes = []
    for n, m in orders:
        factor = sum(
            (-1) ** s * math.comb(n - s, s) * math.comb(n - 2 * s, (n - m) // 2 - s) * rho2 ** ((n - m) // 2 - s)
            for s in range((n - m) // 2 + 1)
        )
        planes.append(factor * (z**m).real)
        if m:
            planes.append(factor * (z**m).imag)
    return np.stack(np.broadcast_arrays(*planes))


@pytest.mark.parametrize("size", [3, 5, 7])
def test_kernels_equal_quadrature(size: int) -> None:
    """Exact in y by Gauss-Legendre between the disc and the pixel rows, adaptive in x with the kinks as breakpoints."""
    lines = np.linspace(-1, 1, size + 1)
    node, weight = np.polynomial.legendre.leggauss(4)

    def column(x: float) -> np.ndarray:
        reach = math.sqrt(max(0.0, 1 - x * x))
        low, high = np.clip(lines[:-1], -reach, reach), np.clip(lines[1:], -reach, reach)
        y = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * node
        values = zernike_polynomials(x, y, zernike.ORDERS)
        return (values * weight).sum(-1) * 0.5 * (high - low)

    kinks = sorted({s * math.sqrt(1 - v * v) for v in lines for s in (-1, 1)})
    expected = np.stack(
        [quad_vec(column, a, b, points=[k for k in kinks if a < k < b], epsabs=1e-10)[0] for a, b in pairwise(lines)],
        -1,
    )
    actual = zernike.kernels(size).numpy()
    assert actual.shape == expected.shape
    # the midpoint rule's error on the rim, relative to a full pixel's weight
    assert abs(actual - expected).max() < 1e-3 * (2 / size) ** 2


def test_orthogonality() -> None:
    """The squares integrate to pi / (n + 1), half of it for each wave; the coarse rim takes some of it off."""
    size = 15
    kernels = zernike.kernels(size).flatten(1)
    norm = [math.pi / (n + 1) / (2 if m else 1) for n, m in zernike.ORDERS for _ in range(2 if m else 1)]
    unit = kernels / (2 / size) / torch.tensor(norm, dtype=torch.float64).sqrt()[:, None]
    gram = unit @ unit.T
    assert ((gram.diagonal() > 0.75) & (gram.diagonal() < 1)).all()
    assert (gram - gram.diagonal().diag()).abs().max() < 0.14


@pytest.mark.parametrize("size", [1, 2, 6, -3])
def test_bad_size(size: int) -> None:
    with pytest.raises(ValueError, match="odd and at least 3"):
        zernike.kernels(size)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32, torch.float64])
@pytest.mark.parametrize("size", [3, 7])
def test_layer_equals_gathered_windows(dtype: torch.dtype, size: int) -> None:
    generator = torch.Generator().manual_seed(3)
    frames = torch.randint(0, 256, (2, 23, 31), generator=generator).to(dtype)
    layer = zernike.ZernikeMoments(size, dtype=torch.float64)
    dense = layer(frames[:, None])
    half = size // 2
    assert dense.shape == (2, 15, 23 - 2 * half, 31 - 2 * half)
    frame, v, u = torch.ones_like(dense[:, 0]).nonzero().unbind(-1)
    gathered = zernike.moments_at(frames, frame, torch.stack([u, v], -1) + half, size, zernike.ORDERS)
    torch.testing.assert_close(gathered.double(), dense.permute(0, 2, 3, 1).reshape(-1, 15), rtol=0, atol=1e-3)


def test_layer_is_a_module() -> None:
    layer = zernike.ZernikeMoments()
    assert layer(torch.zeros(1, 1, 9, 12)).dtype == torch.float32
    assert list(layer.state_dict()) == ["weight"]
    assert not list(layer.parameters())


def edge_frames(
    angle: torch.Tensor,
    distance: torch.Tensor,
    size: int = 21,
    sigma: float = 0.0,
    dark: float = 30.0,
    light: float = 200.0,
    sub: int = 24,
) -> torch.Tensor:
    """Frames (B, N, N) of straight edges at ``distance`` (B,) px from the middle along ``angle`` (B,), box pixels.

    By supersampling; without blur, each fine cell is clipped linearly, which is exact to (1 / sub)^2.
    """
    fine = (torch.arange(size * sub, dtype=torch.float64) + 0.5) / sub - size / 2
    out = []
    for a, d in zip(angle.tolist(), distance.tolist(), strict=True):
        r = fine[None, :] * math.cos(a) + fine[:, None] * math.sin(a) - d
        if sigma:
            inside = torch.from_numpy(ndtr((r / sigma).numpy()))
        else:
            inside = (r * sub + 0.5).clamp(0, 1)
        out.append(dark + (light - dark) * inside.unflatten(0, (size, sub)).unflatten(2, (size, sub)).mean((1, 3)))
    return torch.stack(out)


def locate_middle(frames: torch.Tensor, size: int = zernike.MASK) -> Edges:
    count, middle = frames.shape[0], frames.shape[-1] // 2
    return zernike.locate(frames, torch.arange(count), torch.full((count, 2), middle), size)


@pytest.fixture(scope="module")
def edges() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    u = torch.rand(2, 60, generator=generator, dtype=torch.float64)
    return 2 * math.pi * u[0], u[1] - 0.5


def test_ideal_edges(edges: tuple[torch.Tensor, torch.Tensor]) -> None:
    """The areas of the pixels blur edge and kernel: 1 - 2/N^2 of the distance is left, so a large mask is used."""
    angle, distance = edges
    found = locate_middle(edge_frames(angle, distance, size=23), size=21)
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    torch.testing.assert_close(found.offset, distance, rtol=0, atol=0.01)
    assert (found.normal * direction).sum(-1).acos().max() < 2e-3
    torch.testing.assert_close(found.points, 11 + distance[:, None] * direction, rtol=0, atol=0.01)
    torch.testing.assert_close(found.step, torch.full_like(angle, 170.0), rtol=5e-3, atol=0)


def test_mask_of_seven(edges: tuple[torch.Tensor, torch.Tensor]) -> None:
    angle, distance = edges
    found = locate_middle(edge_frames(angle, distance))
    assert (found.offset - distance).abs().max() < 0.05
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    assert (found.normal * direction).sum(-1).acos().max() < 0.02
    torch.testing.assert_close(found.step, torch.full_like(angle, 170.0), rtol=0.05, atol=0)
    shift = distance[:, None] * direction
    clear = ((shift.abs() - 0.5).abs() > 0.03).all(-1)
    assert torch.equal(found.inside[clear], (shift.abs() <= 0.5).all(-1)[clear])


def test_symmetric_edges_are_exact() -> None:
    angle = torch.arange(8, dtype=torch.float64) * (math.pi / 4)
    found = locate_middle(edge_frames(angle, torch.zeros(8), dark=190.0))  # faint on bright: no mean grey may leak in
    torch.testing.assert_close(found.points, torch.full((8, 2), 10.0, dtype=torch.float64), rtol=0, atol=1e-4)
    torch.testing.assert_close(found.normal, torch.stack([angle.cos(), angle.sin()], -1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("sigma", [0.5, 0.8])
def test_deblur_straight_edges(edges: tuple[torch.Tensor, torch.Tensor], sigma: float) -> None:
    angle, distance = edges
    found = locate_middle(edge_frames(angle, distance, sigma=sigma))
    group = torch.zeros(60, dtype=torch.int64)
    blur = zernike.edge_blur(found.offset, distance, found.normal, group, 1)
    # the areas of the frame's and of the kernel's pixels add 1/12 each
    torch.testing.assert_close(blur[0], isotropic(torch.tensor(sigma**2 + 2 / 12, dtype=F64).sqrt()), rtol=0, atol=0.05)
    slope = zernike.slope_across(blur, found.normal)
    before = (found.offset - distance).square().mean().sqrt()
    after = (zernike.deblur(found.offset, slope) - distance).square().mean().sqrt()
    assert after < 0.01
    assert after < 0.3 * before


def test_deblur_inverts_its_law() -> None:
    distance = torch.linspace(-0.7, 0.7, 15, dtype=torch.float64)
    for slope in (1.0, 0.85, 0.7):
        l2 = (distance / 3.5).square()
        measured = distance * (1 - (1 - slope) / (1 - l2))
        back = zernike.deblur(measured, torch.full_like(distance, slope))
        torch.testing.assert_close(back, distance, rtol=0, atol=1e-4)


def test_edge_blur_by_direction_and_group() -> None:
    """Offsets by the law for a blur of 1 x 1.4 px at 30 degrees; a group of one direction tells that one."""
    g = torch.Generator().manual_seed(3)
    angle = 2 * math.pi * torch.rand(400, dtype=F64, generator=g)
    angle[300:] = 0.0
    normal, distance = torch.stack([angle.cos(), angle.sin()], -1), torch.rand(400, dtype=F64, generator=g) - 0.5
    axis = torch.tensor([math.cos(math.pi / 6), math.sin(math.pi / 6)], dtype=F64)
    truth = torch.eye(2, dtype=F64) + (1.4**2 - 1) * torch.outer(axis, axis)
    variance = (normal @ truth * normal).sum(-1)
    offset = distance * (1 - 12 / zernike.MASK**2 * variance)
    group = torch.zeros(400, dtype=torch.int64)
    group[300:] = 1
    blur = zernike.edge_blur(offset, distance, normal, group, 3)
    torch.testing.assert_close(blur[0], truth.flatten()[[0, 1, 3]], rtol=0.03, atol=0.03)
    torch.testing.assert_close(blur[1, 0], truth[0, 0], rtol=0.02, atol=0)
    assert (blur[2] == 0).all()
    torch.testing.assert_close(
        zernike.slope_across(blur[group], normal)[:300], offset[:300] / distance[:300], rtol=0.02, atol=0
    )


def test_edge_correlation() -> None:
    """Variance of the mean offset along an edge against that of a single one, white noise."""
    generator = torch.Generator().manual_seed(9)
    length, trials = 160, 3000
    clean = torch.cat([torch.full((7,), 40.0), torch.tensor([110.0]), torch.full((7,), 180.0)])
    frames = clean + 3 * torch.randn(trials, length + 6, 15, generator=generator)
    frame = torch.arange(trials).repeat_interleave(length)
    row = torch.arange(3, length + 3).repeat(trials)
    offset = zernike.locate(frames, frame, torch.stack([torch.full_like(row, 7), row], -1)).offset.view(trials, length)
    inflation = length * offset.mean(1).var() / offset.var(0).mean()
    # sampling error of a variance: sqrt(2 / trials) = 2.6 %; the ends of the row take off up to 2 % more
    assert float(inflation) == pytest.approx(zernike.edge_correlation(), rel=0.1)
    assert zernike.edge_correlation() > 1.5


def test_flat_and_nan_windows_are_no_edges() -> None:
    frames = torch.full((1, 9, 9), 80.0)
    flat = locate_middle(frames)
    frames[0, 2, 3] = math.nan
    broken = locate_middle(frames)
    assert not flat.inside.any()
    assert not broken.inside.any()


def test_no_edges() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    found = zernike.locate(torch.zeros(1, 3, 3), none, torch.zeros(0, 2, dtype=torch.int64))
    assert found.points.shape == (0, 2)


@pytest.mark.parametrize("sigma", [0.0, 0.4, 0.8, 1.2])
def test_curvature_shift_equals_its_integral(sigma: float) -> None:
    """The integrals over the disc by quadrature; the blur (px) includes both areas of pixels."""
    s = math.sqrt(sigma**2 + 1 / 6) * 2 / zernike.MASK if sigma else 1e-3
    node, weight = np.polynomial.hermite_e.hermegauss(201)
    x = (s * node)[abs(s * node) < 1]
    weight = weight[abs(s * node) < 1] / math.sqrt(2 * math.pi)
    h = np.sqrt(1 - x * x)
    zeroth = (weight * (2 * h * (2 * x * x - 1) + 4 * h**3 / 3)).sum()
    second = (weight * ((2 * x * x - 1) * 2 * h**3 / 3 + 4 * h**5 / 5)).sum()
    slope = -1.5 * zeroth / (weight * h**3).sum()
    across = (1 - slope) * zernike.MASK**2 / 12  # of an edge whose normal is u
    normal = torch.tensor([[1.0, 0.0]], dtype=F64)
    for more in (0.0, 1.5):  # px^2, of the blur along the edge
        expected = -0.5 * (s * s + second / zeroth) * (zernike.MASK / 2) ** 2 + 0.5 * more
        blur = torch.tensor([[across, 0.0, across + more]], dtype=F64)
        assert float(zernike.curvature_shift(blur, normal)) == pytest.approx(expected, rel=0.01)
