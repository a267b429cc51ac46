"""What is designed: smooth maps from unbounded numbers to the numbers of a scene.

A variable has a start (the scene's own values, moved into the bounds), the change of the scene that unbounded
numbers mean, and the same change in the words of a scene file. The optimiser never leaves the bounds, since every
unbounded number maps inside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import InputError, Scene
from jaxform.profiles import Profile

_EDGE = 1e-3  # of the range: where a start that lies on a bound is put, for on it the map has no slope


class Variable(Protocol):
    """A part of a scene that is designed."""

    start: np.ndarray

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """What `jaxform.replace` takes, of unbounded numbers shaped like `start`."""
        ...

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The same as dotted keys of a scene file with plain values."""
        ...


def bounded(free: jax.Array, bounds: tuple[float, float]) -> jax.Array:
    """Values strictly between the bounds, for any numbers, of their shape."""
    return bounds[0] + (bounds[1] - bounds[0]) * jax.nn.sigmoid(free)


def unbounded(values: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    """Inverse of `bounded`; values on or beyond a bound are moved just inside it."""
    fraction = np.clip((np.asarray(values, float) - bounds[0]) / (bounds[1] - bounds[0]), _EDGE, 1 - _EDGE)
    return np.log(fraction / (1 - fraction))


class ThicknessProfile:
    """Initial thickness, piecewise linear along a place in the initial sheet.

    Args:
        scene: The scene whose sheet is designed; its own thickness is the start.
        along: "radius", "x", "y" or "z".
        bounds: Least and largest thickness [m].
        knots: Number of knots, evenly placed over the sheet; or
        at: Their places [m], increasing.

    Raises:
        InputError: If the bounds leave no room, or neither or both of `knots` and `at` are given.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        along: str,
        bounds: tuple[float, float],
        knots: int | None = None,
        at: Sequence[float] | None = None,
    ) -> None:
        """See the class."""
        if not 0 < bounds[0] < bounds[1] < np.inf:
            raise InputError("must be 0 < lower < upper", "give thicknesses in m", "variable.bounds", bounds)
        if (knots is None) == (at is None):
            raise InputError("needs knots or at", "give one of the two", "variable.knots", knots)
        positions = np.asarray(scene.parison.positions)
        place = Profile(along, (0.0, 1.0), (0.0, 1.0)).coordinate(positions)
        self.along, self.bounds = along, bounds
        evenly = np.linspace(place.min(), place.max(), knots or 2)
        self.at = evenly if at is None else np.asarray(at, float)
        hats = [np.interp(place, self.at, row) for row in np.eye(len(self.at))]
        self._hats = jnp.asarray(np.stack(hats, axis=1))
        present = np.asarray(scene.parison.thickness)
        nearest = np.linalg.lstsq(np.asarray(self._hats), present, rcond=None)[0]
        # A knot that no node feels has no best value; the mean does no harm.
        felt = np.asarray(self._hats).sum(0) > 0
        self.start = unbounded(np.where(felt, nearest, present.mean()), bounds)

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """Nodal thickness (n_node,) [m]."""
        return {"parison.thickness": self._hats @ bounded(free, self.bounds)}

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The profile as a table."""
        value = np.asarray(bounded(free, self.bounds)).tolist()
        return {"parison.thickness": {"along": self.along, "at": self.at.tolist(), "value": value}}


class PressureKnots:
    """Pressure at the knots of the scene's history.

    Args:
        scene: The scene; its own pressure is the start.
        bounds: Least and largest pressure [Pa].
        increasing: Whether the pressure must never fall from knot to knot.

    Raises:
        InputError: If the bounds leave no room.
    """

    def __init__(self, scene: Scene, *, bounds: tuple[float, float], increasing: bool = False) -> None:
        """See the class."""
        if not -np.inf < bounds[0] < bounds[1] < np.inf:
            raise InputError("must be lower < upper", "give pressures in Pa", "variable.bounds", bounds)
        self.bounds, self.increasing = bounds, increasing
        present = np.asarray(scene.pressure.value, float)
        self.start = self._shares(present) if increasing else unbounded(present, bounds)

    def _shares(self, values: np.ndarray) -> np.ndarray:
        """Of the way from the lower bound to the upper, what each knot climbs, and what is left; as logarithms."""
        fraction = np.clip((values - self.bounds[0]) / (self.bounds[1] - self.bounds[0]), 0.0, 1.0)
        climbs = np.diff(np.concatenate([[0.0], np.maximum.accumulate(fraction), [1.0]]))
        climbs = np.maximum(climbs, _EDGE / len(climbs))
        return np.log(climbs[:-1] / climbs[-1])

    def _values(self, free: jax.Array) -> jax.Array:
        if not self.increasing:
            return bounded(free, self.bounds)
        climbs = jax.nn.softmax(jnp.append(free, 0.0))
        return self.bounds[0] + (self.bounds[1] - self.bounds[0]) * jnp.cumsum(climbs)[:-1]

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """Pressure (n_knot,) [Pa]."""
        return {"pressure.value": self._values(free)}

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The pressures as a list."""
        return {"pressure.value": np.asarray(self._values(free)).tolist()}
