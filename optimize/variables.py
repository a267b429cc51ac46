"""What is designed: smooth maps from unbounded numbers to the numbers of a scene.

A variable has a start (the scene's own values, moved into the bounds), the change of the scene that unbounded
numbers mean, and the same change in the words of a scene file. The optimiser never leaves the bounds, since every
unbounded number maps inside them.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from jaxform import InputError, Scene
from jaxform.model.replacing import number_at

Bounds = tuple[float, float]

EDGE = 1e-3  # of the range: where a start that lies on a bound is put, for on it the map has no slope
_TIMES = ("pressure.time", "solver.end_time")


class Variable(Protocol):
    """A part of a scene that is designed."""

    start: np.ndarray

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """What `jaxform.replace` takes, of unbounded numbers shaped like `start`."""
        ...

    def shares(self, free: jax.Array) -> jax.Array:
        """How far the bounded numbers (n,) are between their bounds, nearly: 0 at the lower one, 1 at the upper one."""
        ...

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The same as dotted keys of a scene file with plain values."""
        ...


@runtime_checkable
class SheetVariable(Variable, Protocol):
    """A variable that is the sheet's thickness."""

    def nearest(self, thickness: np.ndarray) -> np.ndarray:
        """The unbounded numbers that come closest to a nodal thickness (n_node,) [m]."""
        ...


def check_bounds(bounds: Bounds, positive: bool = True) -> None:
    """Raises InputError unless the bounds leave room, above zero where they must be."""
    least = 0.0 if positive else -np.inf
    if not (least < bounds[0] < bounds[1] < np.inf):
        words = "must be 0 < lower < upper" if positive else "must be lower < upper"
        raise InputError(words, "give the lower bound first, then the upper one", "variable.bounds", bounds)


def bounded(free: jax.Array, bounds: Any) -> jax.Array:
    """Values strictly between the bounds, for any numbers, of their shape."""
    return bounds[0] + (bounds[1] - bounds[0]) * jax.nn.sigmoid(free)


def unbounded(values: Any, bounds: Any) -> np.ndarray:
    """Inverse of `bounded`; values on or beyond a bound are moved just inside it."""
    fraction = np.clip((np.asarray(values, float) - bounds[0]) / (bounds[1] - bounds[0]), EDGE, 1 - EDGE)
    return np.log(fraction / (1 - fraction))


def log_bounded(free: jax.Array, bounds: Bounds) -> jax.Array:
    """The same between positive bounds, whose logarithms are divided evenly.

    A wall goes with its sheet in ratio: searched in logarithms, the one is nearly linear in the other.
    """
    return jnp.clip(jnp.exp(bounded(free, np.log(bounds))), *bounds)  # rounding must not lead out of them


def log_unbounded(values: Any, bounds: Bounds) -> np.ndarray:
    """Inverse of `log_bounded`; values on or beyond a bound are moved just inside it."""
    return unbounded(np.log(np.clip(values, *bounds)), np.log(bounds))


def limited(free: jax.Array, bounds: Bounds, change: Any, first: Any = None, rising: bool = False) -> jax.Array:
    """Values between the bounds of which neighbours differ by less than a limit, for any numbers.

    Each lies between those bounds and the limits that its predecessor leaves.

    Args:
        free: Unbounded numbers (n,).
        bounds: Least and largest value.
        change: Largest difference of neighbours, one number for each pair.
        first: A value that comes before the first one; None where that is free.
        rising: Whether values must not fall.
    """
    values: list[jax.Array] = []
    last, steps = first, jnp.asarray(change)
    for k in range(free.size):
        room: Any = bounds
        if last is not None:
            step = steps[k if first is not None else k - 1]
            room = _room(last, step, bounds, rising)
        last = bounded(free[k], room)
        values.append(last)
    return jnp.stack(values)


def unlimited(values: np.ndarray, bounds: Bounds, change: Any, first: Any = None, rising: bool = False) -> np.ndarray:
    """Inverse of `limited`; values that break a limit are moved just inside it."""
    free: list[float] = []
    last = first
    for k, value in enumerate(np.asarray(values, float)):
        room: Any = bounds
        if last is not None:
            room = [float(end) for end in _room(last, change[k if first is not None else k - 1], bounds, rising)]
        free.append(float(unbounded(value, room)))
        last = float(bounded(jnp.asarray(free[-1]), room))
    return np.asarray(free)


def _room(last: Any, step: Any, bounds: Bounds, rising: bool) -> tuple[jax.Array, jax.Array]:
    low = last if rising else jnp.maximum(bounds[0], last - step)
    return low, jnp.minimum(bounds[1], last + step)


class Scale:
    """A factor on a number of the scene, or on all of a list or field.

    Args:
        scene: The scene; its own values are the start, factor 1.
        of: What is scaled: a number that `jaxform.replace` takes and is no time, such as "material.c".
        bounds: Least and largest factor.

    Raises:
        InputError: If the bounds leave no room, or the scene has no such number.
    """

    def __init__(self, scene: Scene, *, of: str, bounds: Bounds) -> None:
        """See the class."""
        check_bounds(bounds)
        if of in _TIMES:
            raise InputError(
                "is a time", "scale another number; a FormingTime objective shortens it", "variable.of", of
            )
        part, _, name = of.rpartition(".")
        present = number_at(scene, of)
        jaxform.replace(scene, {of: 1.0 if present is None else present})  # says what the scene has instead
        self.of, self.bounds = of, bounds
        self._present = jnp.asarray(present)
        self._first_nodes = scene.first_nodes
        self._varies = part == "material" and name in scene.material.zones
        self.start = np.atleast_1d(unbounded(1.0, bounds))

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """The scaled number or numbers, in their own unit."""
        return {self.of: bounded(free[0], self.bounds) * self._present}

    def shares(self, free: jax.Array) -> jax.Array:
        """How far the factor (1,) is between its bounds."""
        return bounded(free, (0.0, 1.0))

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The same; what varies over the sheet at the nodes of its mesh, (..., n_node)."""
        values = np.asarray(self.changes(free)[self.of], float)
        if self.of in ("parison.thickness", "parison.temperature"):
            values = values[: self._first_nodes]
            return {self.of: float(values[0]) if np.ptp(values) == 0.0 else values}
        if self._varies:
            return {self.of: values[..., : self._first_nodes]}
        return {self.of: values.tolist()}
