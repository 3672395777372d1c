"""Up to which radius a lens model can be inverted."""

import math
from collections.abc import Callable

import numpy as np
from numpy.polynomial import Polynomial

# d log(distorted radius) / d log(radius) of a rational model. A pincushion by k1 alone stays below 3 however
# strong it is, near a pole there is no bound (derived)
_STEEPEST = 3.0
_BESIDE = 1e-9  # of u, to see which way a function goes on behind a root (convention: far above rounding)
_HALVINGS = 80  # of an interval: more than the digits of a float64


def polynomial_fold(k: np.ndarray) -> float:
    """The radius at which theta (1 + k1 theta^2 + ... + k4 theta^8), theta = atan(r), stops to grow; inf: nowhere."""
    growth = Polynomial([1.0, *(k * [3, 5, 7, 9])])
    theta = math.sqrt(first_root(growth))
    return math.tan(theta) if theta < math.pi / 2 else math.inf


def _ratio(above: np.ndarray, below: np.ndarray) -> tuple[Polynomial, Polynomial, Polynomial]:
    """n and q of f = r n(r^2) / q(r^2), and the numerator of df / dr, all in u = r^2."""
    n, q, u = Polynomial([1.0, *above]), Polynomial([1.0, *below]), Polynomial([0.0, 1.0])
    return n, q, n * q + 2 * u * (n.deriv() * q - n * q.deriv())


def growing_radius(above: np.ndarray, below: np.ndarray) -> float:
    """The radius up to which f = r n(r^2) / q(r^2) grows and has no pole, however steep it is; arguments as below.

    On the way to a lens a fit passes others that are less plausible.
    """
    _, q, growth = _ratio(above, below)
    return math.sqrt(min(first_root(growth), first_root(q)))


def rational_fold(above: np.ndarray, below: np.ndarray) -> float:
    """The radius up to which f = r n(r^2) / q(r^2) has one inverse, and a plausible one; inf where it has everywhere.

    It ends where f stops to grow. A pole ends it too, but before: close to one, f runs through all values within a
    fraction of a pixel of r. So does a spike without a pole, where q is only small. Fits of too many coefficients have
    one that nearly cancels against a root of n; the lens goes on behind it (f is small again, and grows), so that a
    pixel has two rays, of which the near one is an artefact of the spike. There is no telling which of them is meant:
    the inverse ends where the second begins.

    Args:
        above: the coefficients of n behind its constant 1.
        below: those of q.
    """
    n, q, growth = _ratio(above, below)
    fold, pole = first_root(growth), first_root(q)
    steep = growth - _STEEPEST * n * q
    spike = first_root(steep) if np.any(below) else math.inf
    if fold <= min(spike, pole) or math.isinf(min(spike, pole)):
        return math.sqrt(fold)
    before = min(spike, pole)

    def bent(u: float) -> float:
        return math.sqrt(u) * float(n(u) / q(u))

    def resumes(u: float) -> bool:
        """Whether the lens grows again from there on, no steeper than any."""
        after = u * (1 + _BESIDE)
        size = float(n(after) * q(after))
        return size > 0 and 0 < float(growth(after)) <= _STEEPEST * size

    behind = next((v for v in sorted([*_roots(growth), *_roots(steep)]) if v > before and resumes(v)), math.inf)
    # a lens that goes on behind the spike continues what was before it; half of that is another sheet of the function
    if math.isfinite(behind) and 0.5 * bent(before) < bent(behind) < bent(before):
        before = _where(bent, bent(behind), before)
    return math.sqrt(before)


def first_root(polynomial: Polynomial) -> float:
    """The smallest positive root of a polynomial whose constant term is not zero; inf where there is none."""
    return next(iter(_roots(polynomial)), math.inf)


def _roots(polynomial: Polynomial) -> list[float]:
    """Positive real roots, ascending."""
    # the reciprocals of the roots are those of the polynomial from its constant term on, however small the others
    roots = np.roots(polynomial.coef)
    # a double root comes out as a pair beside the axis, by the root of the rounding; what is tiny is a root at infinity
    real = np.abs(roots.imag) <= 1e-6 * np.abs(roots)
    positive = roots.real[real & (roots.real > np.finfo(float).tiny)]
    return sorted(1 / positive)


def _where(function: Callable[[float], float], value: float, high: float) -> float:
    """The argument in 0..high at which a growing function has a value."""
    low = 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < value else (low, middle)
    return low
