"""What is taken for noise: the limits that all stages share."""

from typing import TypeVar

from torch import Tensor

Value = TypeVar("Value", float, Tensor)

CUT = 4.0  # deviations, beyond which a value is no noise: of a ring's thousand pixels noise loses 0.06 (derived)
# of the pixels of a ring that must follow its model: with less, what is left may be something else (convention)
LEAST_KEPT = 0.5
RATIO_RANGE = (0.12, 0.93)  # of inner to outer radius: beyond, a plain disc or its rim (convention)


def _exact(count: Value) -> Value:
    """Counts as double numbers: torch divides integers in its default type."""
    return count.double() if isinstance(count, Tensor) and not count.is_floating_point() else count


def of_chance(number: Value) -> Value:
    """Most that the mean square of so many values exceeds its expectation by chance, as a factor."""
    return 1 + CUT * (2 / _exact(number)) ** 0.5


def quantile(freedom: Value, deviations: float) -> Value:
    """What chi-squared stays below as often as a normal deviate below so many deviations (Wilson and Hilferty 1931)."""
    freedom = _exact(freedom)
    share = 2 / (9 * freedom)
    return freedom * (1 - share + deviations * share**0.5) ** 3
