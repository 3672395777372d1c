"""Blurred indicators against a supersampled and filtered picture, derivatives against central differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve
from torch import Tensor

from torchpose.geometry import conics
from torchpose.geometry.blur import isotropic
from torchpose.geometry.blurred_ellipse import Profile, blurred_ellipse, disc, gaussian, nodes_needed


@pytest.mark.parametrize("axes", [(2.1, 2.1), (6.0, 3.0), (9.6, 8.0)])
@pytest.mark.parametrize("sigma", [(0.7, 0.7), (1.73, 1.73), (3.6, 3.6), (0.8, 2.5), (2.0, 4.0)])
def test_values(axes: tuple[float, float], sigma: tuple[float, float]) -> None:
    """Blurs along u and v; the ellipse lies at an angle to them."""
    fine, size, scale = 16, 48, 0.8
    params = torch.tensor([[0.3, -0.2, *axes, 0.6]], dtype=torch.float64)
    grid = (np.arange(size * fine) + 0.5) / fine - size / 2
    x, y = np.meshgrid(grid - 0.3, grid + 0.2)
    p, q = np.cos(0.6) * x + np.sin(0.6) * y, np.cos(0.6) * y - np.sin(0.6) * x
    rho = np.hypot(p / axes[0], q / axes[1])
    slope = np.hypot(p / axes[0] ** 2, q / axes[1] ** 2) / rho
    inside = np.clip((scale - rho) / slope * fine + 0.5, 0, 1)
    picture = gaussian_filter(inside, (sigma[1] * fine, sigma[0] * fine), truncate=6)[::8, ::8]
    xy = torch.from_numpy(np.stack(np.meshgrid(grid[::8], grid[::8]), -1).reshape(1, -1, 2))
    blur = torch.tensor([[sigma[0] ** 2, 0.0, sigma[1] ** 2]], dtype=torch.float64)
    value, _ = blurred_ellipse(
        xy,
        params[:, :2],
        conics.shape_matrix(params),
        torch.full_like(blur[:, 0], scale),
        blur,
        nodes_needed(scale * params[:, 2], blur.new_tensor(sigma).amin()[None]),
    )
    # what is left is the supersampling of the witness
    assert np.abs(value.numpy().reshape(picture.shape) - picture).max() < 1e-3


@pytest.mark.parametrize("radius", [2.6, 5.0])
def test_a_disc(radius: float) -> None:
    """A ring of 6 px under a disc and 0.28 deviations of a Gaussian: both filtered from a supersampled picture."""
    fine, size, axes = 16, 40, (6.0, 5.0)
    grid = (np.arange(size * fine) + 0.5) / fine - size / 2
    x, y = np.meshgrid(grid, grid)
    inside = (np.hypot(x / axes[0], y / axes[1]) < 1).astype(float)
    kernel = (np.hypot(x, y) < radius).astype(float)
    picture = gaussian_filter(fftconvolve(inside, kernel / kernel.sum(), "same"), 0.28 * radius / 2 * fine)
    xy = torch.from_numpy(np.stack(np.meshgrid(grid[::8], grid[::8]), -1).reshape(1, -1, 2))
    shape = torch.diag_embed(torch.tensor([axes], dtype=torch.float64))
    sigma = torch.tensor([radius / 2 * np.hypot(1, 0.28)], dtype=torch.float64)
    none, one = torch.zeros(1, 2, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    nodes = nodes_needed(torch.tensor([axes[0]]), sigma)
    seen, gauss = (
        blurred_ellipse(xy, none, shape, one, isotropic(sigma), nodes, profile)[0].numpy().reshape(80, 80)
        for profile in (disc, gaussian)
    )
    error = np.abs(seen - picture[::8, ::8]).max()
    assert error < 0.015
    assert np.abs(gauss - picture[::8, ::8]).max() > 2 * error


@pytest.mark.parametrize("profile", [gaussian, disc])
def test_a_profile_is_a_blur_of_its_covariance(profile: Profile) -> None:
    """Its share within m is 1 in the end and grows by its density, and m has the mean 2 of two dimensions."""
    m = torch.linspace(1e-6, 60, 600_001, dtype=torch.float64)
    less, density = profile(m.clone())
    assert float(less[-1]) == pytest.approx(-1, abs=1e-12)
    torch.testing.assert_close(torch.gradient(-less, spacing=(m,))[0][1:-1], 0.5 * density[1:-1], rtol=0, atol=1e-5)
    assert float(torch.trapezoid(0.5 * density * m, m)) == pytest.approx(2, abs=0.02)


@pytest.mark.parametrize("profile", [gaussian, disc])
def test_derivatives(profile: Profile) -> None:
    g = torch.Generator().manual_seed(0)
    center = torch.randn(3, 2, generator=g, dtype=torch.float64)
    entries = torch.tensor([[5.0, 1, 3], [4, -0.5, 2.5], [7, 2, 6]], dtype=torch.float64)
    scale = torch.tensor([0.4, 1, 0.7]).double()
    blur = torch.tensor([[1.4, 0.3, 2.0], [4.0, -1.5, 2.5], [9.0, 0, 9.0]], dtype=torch.float64)
    xy = 8 * torch.randn(3, 20, 2, generator=g, dtype=torch.float64)

    def both(center: Tensor, entries: Tensor, scale: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
        shape = entries[:, (0, 1, 1, 2)].unflatten(-1, (2, 2))
        return blurred_ellipse(xy, center, shape, scale, blur, 400, profile)

    parameters = (center, entries, scale, blur)
    step, columns = 1e-5, []
    for k, value in enumerate(parameters):
        for entry in range(value[0].numel()):
            move = torch.zeros_like(value).flatten(1) if value.ndim > 1 else torch.zeros_like(value)[:, None]
            move[:, entry] = step
            ahead, behind = (
                both(*(p + sign * move.view_as(p) if i == k else p for i, p in enumerate(parameters)))[0]
                for sign in (1, -1)
            )
            columns.append((ahead - behind) / (2 * step))
    torch.testing.assert_close(both(*parameters)[1], torch.stack(columns, -1), rtol=0, atol=1e-9)


def test_as_many_nodes_as_needed() -> None:
    """Twice as many change values by no more than is stated."""
    semi, sigma = torch.tensor([12.0]).double(), torch.tensor([0.9]).double()
    xy = torch.linspace(0, 20, 101, dtype=torch.float64)[None, :, None] * torch.tensor([0.6, 0.8])
    shape, one = torch.diag_embed(torch.stack([semi, 0.5 * semi], -1)), torch.ones(1, dtype=torch.float64)
    nodes = nodes_needed(semi, sigma)
    blur = isotropic(sigma)
    few = blurred_ellipse(xy, torch.zeros(1, 2).double(), shape, one, blur, nodes)[0]
    many = blurred_ellipse(xy, torch.zeros(1, 2).double(), shape, one, blur, 2 * nodes)[0]
    torch.testing.assert_close(few, many, rtol=0, atol=1e-5)
