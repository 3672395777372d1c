"""Independent witness of the renderer: brute supersampling, the blur applied on the fine grid.

Nothing is shared with the renderer: rays come from OpenCV, the coverage of a fine cell from the plane radius of its
ray; the kernel is sampled on the fine grid. The error falls with the square of the oversampling.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from torchpose.camera import Camera

Array = NDArray[np.float64]
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)


def rays(camera: Camera, pixels: Array) -> Array:
    """Undistorted normalised coordinates (N, 2) of pixels (N, 2)."""
    matrix, distortion = camera.matrix.numpy(), camera.distortion.numpy()
    points = pixels[:, None]
    if camera.model == "kannala_brandt":
        return np.asarray(cv2.fisheye.undistortPoints(points, matrix, distortion, criteria=_CRITERIA)[:, 0], np.float64)
    return np.asarray(cv2.undistortPoints(points, matrix, distortion, criteria=_CRITERIA)[:, 0], np.float64)


def cell_coverage(distance: Array, gx: Array, gy: Array) -> Array:
    """Area of unit cells on the inner side of a straight edge, ``distance`` cells along its unit normal (gx, gy)."""
    a = np.maximum(np.maximum(abs(gx), abs(gy)), 1e-4)
    b = np.maximum(np.minimum(abs(gx), abs(gy)), 1e-4)

    def q(x: Array) -> Array:
        return np.maximum(x, 0) ** 2 / 2

    area = q(distance + (a + b) / 2) - q(distance + (a - b) / 2) - q(distance - (a - b) / 2) + q(distance - (a + b) / 2)
    return np.where(distance > 1, 1.0, np.where(distance < -1, 0.0, area / (a * b)))


def blur_operator(size: int, pad: int, oversampling: int, psf_sigma: float) -> Array:
    """Matrix (size, (size + 2 pad) oversampling) from fine samples to pixels: sampled Gaussian * box of one pixel."""
    m = np.arange(-int(7 * psf_sigma * oversampling) - 1, int(7 * psf_sigma * oversampling) + 2)
    gauss = np.exp(-0.5 * (m / (oversampling * psf_sigma)) ** 2)
    kernel = np.convolve(gauss / gauss.sum(), np.ones(oversampling) / oversampling)
    operator = np.zeros((size, (size + 2 * pad) * oversampling))
    for i in range(size):
        start = (i + pad) * oversampling + m[0]
        low, high = max(start, 0), min(start + len(kernel), operator.shape[1])
        operator[i, low:high] = kernel[low - start : high - start]
    return operator


def ring_image(
    camera: Camera,
    R: Array,
    t: Array,
    center: Array,
    radii: tuple[float, float],
    psf_sigma: float,
    window: tuple[int, int, int, int],
    oversampling: int,
    dark: float,
    light: float,
) -> Array:
    """Grey values (h, w) of one dark ring of the plane z = 0 in the window (u0, v0, w, h) of the frame."""
    u0, v0, w, h = window
    pad = int(np.ceil(0.5 + 6.5 * psf_sigma))

    def axis(first: int, size: int) -> Array:
        return first - pad - 0.5 + (np.arange((size + 2 * pad) * oversampling) + 0.5) / oversampling

    u, v = np.meshgrid(axis(u0, w), axis(v0, h))
    ray = np.concatenate([rays(camera, np.stack([u.ravel(), v.ravel()], 1)), np.ones((u.size, 1))], 1)
    depth = (R[:, 2] @ t) / (ray @ R[:, 2])
    plane = (depth[:, None] * ray - t) @ R[:, :2] - center[:2]
    radius = np.hypot(*plane.T).reshape(u.shape)
    gv, gu = np.gradient(radius)
    g = np.hypot(gu, gv)
    outer, inner = (cell_coverage((r - radius) / g, gu / g, gv / g) for r in radii)
    fine = light + (dark - light) * (outer - inner)
    return blur_operator(h, pad, oversampling, psf_sigma) @ fine @ blur_operator(w, pad, oversampling, psf_sigma).T
