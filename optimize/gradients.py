"""Gradients within bounds: their projection at a bound, and their check against differences of values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optimize.designs import Point

# Steps in the search's numbers, tried until one agrees: large ones meet other decisions, small ones rounding errors.
_SIZES, _AGREES = (1e-3, 1e-4, 1e-5, 1e-6), 1e-7
_AT_BOUND = 2e-3  # of half the way between the bounds
# Where all of these disagree by more than this, the value may jump between designs that near: smaller ones are tried.
_SMALL_SIZES, _DISAGREES = (1e-7, 1e-8, 1e-9), 1e-2


def slope_within(free: np.ndarray, gradient: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The gradient (n,) without components that lead out of the bounds: 0 at one that it presses on."""
    held = np.where(gradient > 0.0, free <= -reach, free >= reach)
    return np.where(held, 0.0, gradient)


def side_of_bounds(free: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The end of its bounds at which each number (n,) is: -1 for the lower, 1 for the upper one, 0 for none."""
    near = reach - np.abs(free) <= _AT_BOUND * reach
    return np.where(near & (reach > 0.0), np.sign(free), 0.0)


def gradient_error(point: Point, reach: np.ndarray, values: Callable[[list[np.ndarray]], list[float]]) -> float:
    """Relative difference of a gradient and differences along one direction, the best of a few sizes of step.

    The differences are central; at a bound they are taken on its inner side, to the same order.

    Args:
        point: The design, with its gradient.
        reach: Bounds of the numbers on either side of 0 (n,).
        values: Function for the values of designs (n,), which may be computed side by side.
    """
    direction = np.random.default_rng(0).normal(size=point.free.size)
    direction /= np.linalg.norm(direction)
    margin = reach - np.abs(point.free)
    near = margin < 2.0 * _SIZES[0] * np.abs(direction)
    direction = np.where(near, -np.sign(point.free) * np.abs(direction), direction)
    slope, differences = float(point.gradient @ direction), []
    for size in (*_SIZES, *_SMALL_SIZES):
        if size == _SMALL_SIZES[0] and np.nanmin(differences) < _DISAGREES:
            break
        central = bool(np.all(margin >= size * np.abs(direction)))
        steps = (1.0, -1.0) if central else (1.0, 2.0)
        one, two = values([point.free + step * size * direction for step in steps])
        rise = one - two if central else 4.0 * one - two - 3.0 * point.value
        differences.append(abs(rise / (2.0 * size) - slope) / max(abs(slope), 1e-300))
        if differences[-1] < _AGREES:
            break
    return float(np.nanmin(differences))
