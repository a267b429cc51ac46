"""Loads on the sheet; a new loading is a class decorated with `loading`."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, parameter, pytree, ranged_parameter, register_part, static
from jaxform.core.ranges import RANGES, as_numbers, check

_LOOKS = 17


class Interval(NamedTuple):
    """The interval from the start of one step to the start of the next.

    Attributes:
        time: Time at its end [s].
        length: Length [s]; 0 before the first step.
        before, volume: Enclosed volume at its start and at its end [m^3].
    """

    time: jax.Array
    length: jax.Array
    before: jax.Array
    volume: jax.Array


class Loading:
    """Pressure difference on the sheet, positive along its triangles' normals.

    A loading is a pytree whose parameters are leaves; its class is static. It defines the pressure at a time,
    differentiable with respect to all its arguments::

        @jaxform.loading
        class Sealed(jaxform.Loading):
            content: jax.Array = jaxform.parameter("J", above=0.0)
            dead_volume: jax.Array = jaxform.parameter("m^3", above=0.0)
            outside: jax.Array = jaxform.parameter("Pa", least=0.0)

            def at(self, time, volume):
                return self.content / (self.dead_volume + volume) - self.outside

    The stable step includes the derivative of the pressure by the volume; gradients use `jaxform.Checkpointed`.

    A loading may have a state, such as the temperature of a gas: an array, or a tree of arrays. `start` returns it at
    time 0, `after` advances it from the start of each step to the start of the next, and `at` has it as an argument.

    Attributes:
        follows_volume: True if the pressure depends on the enclosed volume; if not, steps do not compute it.
    """

    follows_volume: ClassVar[bool] = True

    def at(self, time: jax.Array, volume: Any, *state: Any) -> jax.Array:
        """Pressure [Pa] at a time [s].

        Args:
            time: Time [s].
            volume: Volume [m^3] of the modelled part between the sheet and the origin; None if the pressure does not
                follow it.
            state: State of the loading, if it has one.
        """
        raise NotImplementedError

    def start(self, volume: jax.Array) -> Any:
        """The state at time 0, with an enclosed volume [m^3]; None, the default, for a loading without a state."""
        return None

    def after(self, state: Any, interval: Interval) -> Any:
        """The state at the end of an interval; by default unchanged."""
        return state

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """Sampled pressures [Pa] of the process, which show its magnitude and direction; not traced.

        Args:
            end_time: End of the process [s].
            volume: Initially enclosed volume [m^3].
        """
        length, same = end_time / (_LOOKS - 1), as_real(volume)
        now, found = _first_sample(self, same), []
        for look in range(_LOOKS):
            interval = Interval(as_real(look * length), as_real(length * (look > 0)), same, same)
            now = _next_sample(self, now, interval)
            found.append(now.pressure)
        return np.asarray(found, float)


@pytree
class LoadState:
    """State of a loading that follows the volume, at the start of a step.

    Attributes:
        pressure: [Pa]; of loads of regions (n_load,).
        state: State of a loading with a history; None for the others.
    """

    pressure: jax.Array
    state: Any


def first_pressure(loading: Loading, volume: jax.Array) -> LoadState:
    """The state of a loading at time 0, with this enclosed volume [m^3], of loads of regions (n_load,)."""
    state = jax.tree.map(_array, loading.start(volume))
    return LoadState(_pressure(loading, jnp.zeros_like(volume, shape=()), volume, state), state)


def next_pressure(loading: Loading, last: LoadState, interval: Interval) -> LoadState:
    """The state of a loading at the end of an interval, from the `last` one at its start."""
    state = None if last.state is None else jax.tree.map(_array, loading.after(last.state, interval))
    return LoadState(_pressure(loading, interval.time, interval.volume, state), state)


# On the host, operation by operation, they would be some fifty programs.
_first_sample, _next_sample = jax.jit(first_pressure), jax.jit(next_pressure)


@jax.jit
def sample_pressure(loading: Loading, times: jax.Array) -> jax.Array:
    """Pressures (n,) [Pa] at times (n,) [s] of a loading that does not follow the volume."""
    return jax.vmap(lambda time: loading.at(time, None))(times)


def _array(values: Any) -> jax.Array:
    """User values as arrays of the dtype that they keep from step to step."""
    return as_real(values) if jnp.issubdtype(jnp.result_type(values), jnp.inexact) else jnp.asarray(values)


def _pressure(loading: Loading, time: jax.Array, volume: jax.Array, state: Any) -> jax.Array:
    return loading.at(time, volume) if state is None else loading.at(time, volume, state)


@dataclass_transform(frozen_default=True, field_specifiers=(parameter, ranged_parameter, static))
def loading[T: Loading](cls: type[T]) -> type[T]:
    """Makes a class a loading: a frozen dataclass and a pytree, its numbers known to `replace` and to designs.

    Raises:
        InputError: It does not derive from `Loading`, defines no pressure, has an undeclared parameter, or has a state
            but does not follow the volume.
    """
    remedy = "derive it from jaxform.Loading and define its pressure, `at`"
    made = register_part(cls, Loading, "at", remedy, "pressure")
    if made.start is not Loading.start and not made.follows_volume:
        raise InputError(
            "has a state, but does not follow the volume, so no step updates it",
            "set follows_volume = True",
            "pressure",
        )
    return made


# A pressure history through knots.

_INTERPOLATIONS = ("linear", "cubic-ramp")
_FEW_KNOTS = 256


@loading
class Pressure(Loading):
    """Pressure difference over time, held before the first and after the last knot.

    Attributes:
        time: Knots (n_knot,) [s], increasing.
        value: Pressure at the knots (n_knot,) [Pa].
        interpolation: "linear", or "cubic-ramp": between two knots it rises as the cube of the elapsed fraction.
    """

    follows_volume: ClassVar[bool] = False

    time: jax.Array = ranged_parameter(RANGES["pressure.time"])
    value: jax.Array = ranged_parameter(RANGES["pressure.value"])
    interpolation: str = static(default="linear")

    def at(self, time: jax.Array, volume: jax.Array | None = None) -> jax.Array:
        """Pressure [Pa] at any times [s], of their shape, whatever the volume."""
        if self.time.size == 1:
            return jnp.broadcast_to(self.value[0], jnp.shape(time))
        # Few knots are compared one by one: a search takes longer to compile than all of this.
        way = "compare_all" if self.time.size <= _FEW_KNOTS else "scan"
        knot = jnp.searchsorted(self.time, time, side="right", method=way)
        knot = jnp.clip(knot - 1, 0, self.time.size - 2)
        begin, end = self.time[knot], self.time[knot + 1]
        fraction = jnp.clip((time - begin) / (end - begin), 0.0, 1.0)
        if self.interpolation == "cubic-ramp":
            fraction = fraction**3
        return self.value[knot] + fraction * (self.value[knot + 1] - self.value[knot])

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """Pressures [Pa] at the knots."""
        return np.asarray(self.value, float)


def make_pressure(time: ArrayLike, value: ArrayLike, interpolation: str = "linear") -> Pressure:
    """A pressure history through knots (n_knot,): times [s], increasing, and values [Pa].

    Raises:
        InputError: If the knots do not increase, are not finite, or do not match.
    """
    times = np.atleast_1d(as_numbers("pressure.time", time))
    values = np.atleast_1d(as_numbers("pressure.value", value))
    if times.shape != values.shape or times.ndim != 1 or not times.size:
        raise InputError(
            f"{times.size} times and {values.size} values do not match",
            "give one value per time",
            "pressure.value",
        )
    check("pressure.time", times)
    check("pressure.value", values)
    if interpolation not in _INTERPOLATIONS:
        raise InputError(
            "unknown", f"choose one of {', '.join(_INTERPOLATIONS)}", "pressure.interpolation", interpolation
        )
    return Pressure(as_real(times), as_real(values), interpolation)
