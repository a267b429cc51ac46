"""Design variables: maps from the numbers of a search to the parameters of a scene.

A variable has a start (the scene's own values, moved into the bounds), the change of the scene that the search's
numbers mean, and the same change in the words of a scene file. The search's numbers lie in a box, whose ends are the
bounds: the map is as steep at a bound as elsewhere, so that a search which starts or passes there is not held. (A
smooth map from unbounded numbers, such as the logistic function, is flat at the bounds: a start there was taken for
an optimum.)
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from jaxform import InputError, Scene
from jaxform.extend import number_at
from jaxform.scene_files import file_key, replacement_path

Bounds = tuple[float, float]

SPAN = 4.0  # of the search's numbers, from one bound to the other
_TIMES = ("pressure.time", "solver.end_time")


class Variable(Protocol):
    """A part of a scene that is designed.

    Attributes:
        start: The search's numbers of the scene's own values, moved into the bounds (n,).
        reach: Bounds of the numbers on either side of 0 (n,); beyond, they mean the same as the nearest end.
    """

    start: np.ndarray
    reach: np.ndarray

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """The changes of the scene, for `jaxform.replace`, from numbers shaped like `start`."""
        ...

    def shares(self, free: jax.Array) -> jax.Array:
        """Designed values (n,) as fractions of the range between their bounds, approximately: 0 to 1."""
        ...

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The changes as dotted keys of a scene file with plain values."""
        ...


@runtime_checkable
class SheetVariable(Variable, Protocol):
    """A variable that is the sheet's thickness.

    Attributes:
        bounds: Least and largest thickness [m].
    """

    bounds: Bounds

    def nearest(self, thickness: np.ndarray) -> np.ndarray:
        """The search's numbers that come closest to a nodal thickness (n_node,) [m]."""
        ...


def check_bounds(bounds: Bounds, positive: bool = True) -> None:
    """Raises InputError unless the bounds increase, above zero where they must be."""
    least = 0.0 if positive else -np.inf
    if not (least < bounds[0] < bounds[1] < np.inf):
        words = "must be 0 < lower < upper" if positive else "must be lower < upper"
        raise InputError(words, "give the lower bound first, then the upper one", "variable.bounds", bounds)


def full_reach(count: int) -> np.ndarray:
    """The reach (n,) of numbers that `apply_bounds` takes."""
    return np.full(count, 0.5 * SPAN)


def _share(free: jax.Array) -> jax.Array:
    """Fraction of the box: 0 at the lower end and 1 at the upper one, with the same slope everywhere, its ends too."""
    share = free / SPAN + 0.5
    # `clip` alone halves the slope on the ends, and rounding may lead past them.
    share = share + jax.lax.stop_gradient(jnp.clip(share, 0.0, 1.0) - share)
    return jnp.where(share < 0.0, 0.0, jnp.where(share > 1.0, 1.0, share))


def apply_bounds(free: jax.Array, bounds: Any) -> jax.Array:
    """Values within the bounds, of their shape; exactly on them at the ends of the box and beyond."""
    share = _share(free)
    # Each half from its own bound, so that neither is missed by rounding.
    width = bounds[1] - bounds[0]
    return jnp.where(share <= 0.5, bounds[0] + width * share, bounds[1] - width * (1.0 - share))


def invert_bounds(values: Any, bounds: Any) -> np.ndarray:
    """Inverse of `apply_bounds`; values beyond a bound are moved onto it, and where the bounds coincide, 0."""
    low, width = np.asarray(bounds[0], float), np.asarray(bounds[1], float) - np.asarray(bounds[0], float)
    share = np.where(width > 0.0, (np.asarray(values, float) - low) / np.where(width > 0.0, width, 1.0), 0.5)
    return SPAN * (np.clip(share, 0.0, 1.0) - 0.5)


def apply_log_bounds(free: jax.Array, bounds: Bounds) -> jax.Array:
    """Values between positive bounds, as of `apply_bounds`, but linear in their logarithms.

    The wall is proportional to its sheet: in logarithms, the one is nearly linear in the other.
    """
    share, ratio = _share(free), np.log(bounds[1] / bounds[0])
    return jnp.where(share <= 0.5, bounds[0] * jnp.exp(ratio * share), bounds[1] * jnp.exp(-ratio * (1.0 - share)))


def invert_log_bounds(values: Any, bounds: Bounds) -> np.ndarray:
    """Inverse of `apply_log_bounds`; values beyond a bound are moved onto it."""
    return invert_bounds(np.log(np.clip(values, *bounds)), np.log(bounds))


def apply_step_limit(
    free: jax.Array, bounds: Bounds, change: Any, first: Any = None, rising: bool = False
) -> jax.Array:
    """Values within the bounds of which neighbours differ by a limit at most, for any numbers.

    Each lies between those bounds and the limits that its predecessor leaves.

    Args:
        free: Numbers of the search (n,).
        bounds: Least and largest value.
        change: Largest difference of neighbours, one number for each pair.
        first: A value that comes before the first one; None where that is free.
        rising: True if values must not fall.
    """
    values: list[jax.Array] = []
    last, steps = first, jnp.asarray(change)
    for k in range(free.size):
        interval: Any = bounds
        if last is not None:
            step = steps[k if first is not None else k - 1]
            interval = _interval(last, step, bounds, rising)
        last = apply_bounds(free[k], interval)
        values.append(last)
    return jnp.stack(values)


def invert_step_limit(
    values: np.ndarray, bounds: Bounds, change: Any, first: Any = None, rising: bool = False
) -> np.ndarray:
    """Inverse of `apply_step_limit`; values that break a limit are moved onto it."""
    free: list[float] = []
    last = first
    for k, value in enumerate(np.asarray(values, float)):
        interval: Any = bounds
        if last is not None:
            interval = [
                float(end) for end in _interval(last, change[k if first is not None else k - 1], bounds, rising)
            ]
        free.append(float(invert_bounds(value, interval)))
        last = float(apply_bounds(jnp.asarray(free[-1]), interval))
    return np.asarray(free)


def _interval(last: Any, step: Any, bounds: Bounds, rising: bool) -> tuple[jax.Array, jax.Array]:
    low = last if rising else jnp.maximum(bounds[0], last - step)
    return low, jnp.minimum(bounds[1], last + step)


def _no_number(scene: Scene, key: str) -> str:
    """Description of a key of a tool or of the gas that is not a number of the scene."""
    if key.startswith("gas."):
        names = ", ".join(getattr(scene.pressure, "names", ()))
        regions = f"; its gases are {names}, as in gas.NAME.mass_flow" if names else ""
        has = regions or hasattr(scene.pressure, "dead_volume")
        return "is not a number of the scene" + (regions if has else ", which has no gas")
    known = [
        file_key(f"{part}.{path}")
        for part in [*(["mold"] if scene.mold is not None else []), *(f"tools.{tool.name}" for tool in scene.tools)]
        for path in ("contact.friction", "motion.displacement", "motion.time")
        if number_at(scene, f"{part}.{path}") is not None
    ]
    return f"is not a number of the scene; those of its tools are {', '.join(known) or 'none'}"


class Scale:
    """A factor on a number of the scene, or on all of a list or field.

    Args:
        scene: The scene; its own values are the start, factor 1.
        of: The scaled quantity: a key of the scene file such as "material.c" or "tool.plug.friction", or a number that
            `jaxform.replace` accepts; no time of the pressure or of the end.
        bounds: Least and largest factor.

    Raises:
        InputError: If the bounds do not increase, or the scene has no such number.
    """

    def __init__(self, scene: Scene, *, of: str, bounds: Bounds) -> None:
        """See the class."""
        check_bounds(bounds)
        if of in _TIMES:
            raise InputError(
                "is a time",
                "scale another parameter; use a FormingTime objective to shorten the process",
                "variable.of",
                of,
            )
        given, of = of, replacement_path(of)
        part, _, name = of.rpartition(".")
        present = number_at(scene, of)
        if present is None and given != of:
            raise InputError(
                _no_number(scene, given), "see the scene file's [[tool]], [mold] and [gas]", "variable.of", given
            )
        jaxform.replace(scene, {of: 1.0 if present is None else present})  # says what the scene has instead
        self.of, self.bounds, self._key = of, bounds, given if given != of else file_key(of)
        self._present = jnp.asarray(present)
        self._first_nodes = scene.first_nodes
        self._varies = part == "material" and name in scene.material.zones
        self.start, self.reach = np.atleast_1d(invert_bounds(1.0, bounds)), full_reach(1)

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """The scaled number or numbers, in their own unit."""
        return {self.of: apply_bounds(free[0], self.bounds) * self._present}

    def shares(self, free: jax.Array) -> jax.Array:
        """The factor (1,) as a fraction of the range between its bounds."""
        return apply_bounds(free, (0.0, 1.0))

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The changes as keys of a scene file; fields over the sheet at the nodes of its mesh, (..., n_node)."""
        values = np.asarray(self.changes(free)[self.of], float)
        if self.of in ("parison.thickness", "parison.temperature"):
            values = values[: self._first_nodes]
            return {self.of: float(values[0]) if np.ptp(values) == 0.0 else values}
        if self._varies:
            return {self.of: values[..., : self._first_nodes]}
        return {self._key: values.tolist()}
