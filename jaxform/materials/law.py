"""Material models of the sheet; a new one is a class decorated with `law`, in one file."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any, Self, dataclass_transform, overload

import jax
import jax.numpy as jnp

from jaxform.core.errors import InputError
from jaxform.core.pytree import (
    is_internal_class,
    parameter,
    parameter_ranges,
    ranged_parameter,
    register_part,
    static,
    varying_parameter_names,
)
from jaxform.materials.temperature import Shift
from jaxform.materials.viscous import Modes

Slope = jax.Array | None
"""A derivative of the energy; None where the law never has it, so that the step does not compute it."""

LAWS: dict[str, type[Law]] = {}
"""Material models of scene files by name."""
_RESERVED = {"model", "model_file", "viscous", "shift", "tension_field"}  # keys of [material] beside the parameters
_UNSTRAINED = 3.0  # both invariants of a sheet that is not strained


class _Dense:
    """Fields that each law declares itself, at a place of its choice."""

    density: jax.Array


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Law(_Dense):
    """Strain energy of an incompressible isotropic material, as a function of the invariants (I1, I2).

    A material model is a pytree whose parameters are leaves; its class is static. It defines its energy, and the stress
    follows by automatic differentiation. A model that defines the derivatives of its energy in closed form compiles to
    a faster step, without the derivatives that are always zero (this depends on the class, never on the value of a
    parameter, whose gradient would silently be zero)::

        @jaxform.law(model="yeoh")
        class Yeoh(jaxform.Law):
            c1: jax.Array = jaxform.parameter("Pa", above=0.0)
            c2: jax.Array = jaxform.parameter("Pa")
            density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

            def energy(self, i1, i2):
                return self.c1 * (i1 - 3.0) + self.c2 * (i1 - 3.0) ** 2

    Every model has a `density` [kg/m^3]. A parameter may vary over the sheet (zones): it then has an additional last
    axis, with a value for each node in a scene, and for each element in the computation.

    Attributes:
        viscous: Prony terms, whose stress is added to the long-term stress of the model; None for an elastic material.
        shift: Time-temperature shift; None for a material that does not depend on temperature.
        tension_field: True if the sheet wrinkles where it would be compressed; see `jaxform.materials.tension_field`.
        held_taut: True if slack elements have the tangent of barely taut ones: for the stable step, not for forces.
    """

    viscous: Modes | None = dataclasses.field(default=None, metadata={"part": True})
    shift: Shift | None = dataclasses.field(default=None, metadata={"part": True})
    tension_field: bool = static(default=False)
    held_taut: bool = static(default=False)

    @property
    def elastic(self) -> Self:
        """The model without its Prony terms and its shift."""
        if self.viscous is None and self.shift is None:
            return self
        return dataclasses.replace(self, viscous=None, shift=None)

    def at(self, temperature: jax.Array | None) -> Self:
        """The model of elements at temperatures (n,) [degC], with shifted parameters; None for the reference."""
        if self.shift is None or temperature is None:
            return self
        factor, numbers = self.shift.factor(temperature), {}
        moduli = factor if self.shift.stiffens else jnp.ones_like(factor)
        if self.shift.stiffens:
            moduli_of = [name for name, allowed in parameter_ranges(self).items() if allowed.unit == "Pa"]
            zones = self.zones
            for name in moduli_of:
                number = getattr(self, name)
                numbers[name] = (number if name in zones else number[..., None]) * factor
        modes = None if self.viscous is None else self.viscous.apply_shift(factor, moduli)
        return dataclasses.replace(self.with_zones(numbers), viscous=modes, shift=None)

    def stiffness_at_once(self) -> jax.Array:
        """The instantaneous stiffness: `stiffness` and the contribution of the Prony terms."""
        return self.stiffness() if self.viscous is None else self.stiffness() + self.viscous.stiffness()

    @property
    def stiffest(self) -> Self:
        """The model that bounds the stable step: a slack sheet may become taut within the window."""
        return dataclasses.replace(self, tension_field=False, held_taut=True) if self.tension_field else self

    @property
    def depends_on_second_invariant(self) -> bool:
        """False if the energy never depends on I2, so that the step does not compute it."""
        return self.slopes(*2 * [jnp.asarray(_UNSTRAINED, self.density.dtype)])[1] is not None

    @property
    def zones(self) -> dict[str, jax.Array]:
        """Parameters that vary over the sheet, (..., n) each, by name."""
        return {name: getattr(self, name) for name in varying_parameter_names(self)}

    def with_zones(self, zones: Mapping[str, jax.Array]) -> Self:
        """The model with other values of parameters that vary."""
        return dataclasses.replace(self, **zones) if zones else self  # pyright: ignore[reportArgumentType, reportReturnType, reportCallIssue]

    def energy(self, i1: jax.Array, i2: jax.Array, /) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants, element by element."""
        raise NotImplementedError

    def slopes(self, i1: jax.Array, i2: jax.Array, /) -> tuple[Slope, Slope]:
        """dW/dI1 and dW/dI2 [Pa], numbers or of the shape of the invariants."""
        return _derivative_along(lambda x: self.energy(x, i2), i1), _derivative_along(lambda x: self.energy(i1, x), i2)

    def curvatures(self, i1: jax.Array, i2: jax.Array, /) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]: the bound of the stable step needs all of them."""
        return (
            _derivative_along(lambda x: self.slopes(x, i2)[0], i1),
            _derivative_along(lambda x: self.slopes(i1, x)[0], i2),
            _derivative_along(lambda x: self.slopes(i1, x)[1], i2),
        )

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa], a sixth of its modulus: a number, or (n,)."""
        none = jnp.full(self._places(), _UNSTRAINED, self.density.dtype)
        return sum((slope for slope in self.slopes(none, none) if slope is not None), jnp.zeros_like(none))

    def _places(self) -> tuple[int, ...]:
        """Shape (n,) of the places over which its parameters vary; () where they do not."""
        return next((values.shape[-1:] for values in self.zones.values()), ())

    def verify(self) -> None:
        """Raises InputError if parameters within their ranges are inconsistent; called on the host."""


class PlaneLaw(Law):
    """A material model as a function of the strain in the plane of the sheet, for models in terms of stretches.

    `energy`, `slopes` and `curvatures` get the trace T = l1^2 + l2^2 and the determinant D = (l1 l2)^2 of the right
    Cauchy-Green tensor in the plane instead of I1 and I2, and the third stretch is (l1 l2)^-1. Both slopes are there.
    """

    def slopes(self, trace: jax.Array, determinant: jax.Array, /) -> tuple[jax.Array, jax.Array]:
        """dW/dT and dW/dD [Pa], of the shape of both."""
        by_trace, by_determinant = super().slopes(trace, determinant)
        assert by_trace is not None and by_determinant is not None
        return by_trace, by_determinant

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa], a sixth of its modulus: a number, or (n,)."""
        one = jnp.ones(self._places(), self.density.dtype)
        return self.slopes(2.0 * one, one)[0]


def _derivative_along(function: Callable[[jax.Array], Slope], at: jax.Array) -> Slope:
    """Derivative of a function that works element by element; None of one that is None."""
    if function(at) is None:
        return None

    def broadcast(x: jax.Array) -> jax.Array:
        value = function(x)
        assert value is not None
        return jnp.broadcast_to(value, jnp.shape(x))

    return jax.jvp(broadcast, (at,), (jnp.ones_like(at),))[1]


@overload
@dataclass_transform(frozen_default=True, field_specifiers=(parameter, ranged_parameter, static))
def law[T: Law](cls: type[T], /) -> type[T]: ...
@overload
@dataclass_transform(frozen_default=True, field_specifiers=(parameter, ranged_parameter, static))
def law[T: Law](*, model: str) -> Callable[[type[T]], type[T]]: ...
def law(cls: Any = None, /, *, model: str = "") -> Any:
    """Declares a class as a material model: a frozen dataclass and a pytree, its parameters known to `replace`.

    With a name, as in `@jaxform.law(model="power")`, scene files and `jaxform fit` know it, too. A name that a model of
    a user already has is given to the new one, so that a file or a cell can be run again.

    Args:
        cls: The class.
        model: Name of the model in scene files; without one, only Python knows it.

    Raises:
        InputError: It does not derive from `Law`, has no energy or density, or an undeclared parameter; or the name
            is that of a built-in model, or cannot stand in a scene file.
    """

    def declare(cls: Any) -> Any:
        remedy = "derive it from jaxform.Law and define its energy"
        made = register_part(cls, Law, "energy", remedy, "material", needed=("density",))
        if model:
            _register_model(model, made)
        return made

    return declare if cls is None else declare(cls)


def _register_model(name: str, made: type[Law]) -> None:
    if not isinstance(name, str) or not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        remedy = "use lower-case letters and digits, words joined by hyphens"
        raise InputError("is not a name of a material model", remedy, "model", name)
    if name in LAWS and is_internal_class(LAWS[name]):
        raise InputError("is the name of a built-in material model", "choose another name", "model", name)
    reserved = sorted(_RESERVED & set(parameter_ranges(made)))
    if reserved:
        remedy = "name the parameter differently, so that scene files can give it"
        raise InputError(f"has a parameter {reserved[0]}, which is a key of [material]", remedy, "model", name)
    LAWS[name] = made
