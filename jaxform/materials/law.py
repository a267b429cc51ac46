"""What a law of the sheet's material is, and how one is added: a class of its own, decorated with `law`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import field
from typing import Any, dataclass_transform

import jax
import jax.numpy as jnp

from jaxform.errors import InputError
from jaxform.pytree import pytree, static
from jaxform.ranges import Range, declare

Slope = jax.Array | None
"""A derivative of the energy; None where the law never has it, so that the step does not compute it."""

_UNSTRAINED = 3.0  # both invariants of a sheet that is not strained


class Law:
    """Strain energy of an incompressible isotropic material, as a function of the invariants (I1, I2).

    A law is a pytree whose parameters are leaves; its class is the static choice. It gives its energy, and the rest
    follows by automatic differentiation: a law that gives its derivatives in closed form compiles to a faster step,
    and leaves out what it never has (decided by its class, never by a parameter's value: the gradient of that would
    silently be zero)::

        @jaxform.law
        class Yeoh(jaxform.Law):
            c1: jax.Array = jaxform.parameter("Pa", above=0.0)
            c2: jax.Array = jaxform.parameter("Pa")
            density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

            def energy(self, i1, i2):
                return self.c1 * (i1 - 3.0) + self.c2 * (i1 - 3.0) ** 2

    Every law has a `density` [kg/m^3].
    """

    density: jax.Array

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants, element by element."""
        raise NotImplementedError

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope]:
        """dW/dI1 and dW/dI2 [Pa], numbers or of the shape of the invariants."""
        return _along(lambda x: self.energy(x, i2), i1), _along(lambda x: self.energy(i1, x), i2)

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]: the step's bound needs them, and none may be forgotten."""
        return (
            _along(lambda x: self.slopes(x, i2)[0], i1),
            _along(lambda x: self.slopes(i1, x)[0], i2),
            _along(lambda x: self.slopes(i1, x)[1], i2),
        )

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]: a sixth of its modulus."""
        none = jnp.full_like(self.density, _UNSTRAINED)
        return sum((slope for slope in self.slopes(none, none) if slope is not None), jnp.zeros_like(none))


def _along(function: Callable[[jax.Array], Slope], at: jax.Array) -> Slope:
    """Derivative of a function that works element by element; None of one that is None."""
    if function(at) is None:
        return None

    def spread(x: jax.Array) -> jax.Array:
        value = function(x)
        assert value is not None
        return jnp.broadcast_to(value, jnp.shape(x))

    return jax.jvp(spread, (at,), (jnp.ones_like(at),))[1]


def parameter(
    unit: str = "", *, above: float | None = None, least: float | None = None, most: float | None = None
) -> Any:
    """A number of a law, with its range; by default any finite one.

    Args:
        unit: Of the number, empty where it has none.
        above: It is greater than this.
        least: It is not less than this.
        most: It is not greater than this.
    """
    return within(Range(unit, above=above, least=least, most=most))


def within(allowed: Range) -> Any:
    """A number of a law with a range that is declared elsewhere."""
    return field(metadata={"range": allowed})


@dataclass_transform(frozen_default=True, field_specifiers=(parameter, within, static))
def law[T: Law](cls: type[T]) -> type[T]:
    """Makes a class a law: a frozen dataclass and a pytree, its parameters known to `replace` and to designs.

    Raises:
        InputError: It does not derive from `Law`, has no energy or density, or an undeclared parameter.
    """
    name = getattr(cls, "__name__", str(cls))
    if not (isinstance(cls, type) and issubclass(cls, Law)) or cls.energy is Law.energy:
        raise InputError("is no law", "derive it from jaxform.Law and give it an energy", value=name)
    made = pytree(cls)
    declared = {part.name: part.metadata.get("range") for part in _numbers(made)}
    missing = sorted(key for key, allowed in {"density": None, **declared}.items() if allowed is None)
    if missing:
        raise InputError(f"does not declare {', '.join(missing)}", "declare them with jaxform.parameter", value=name)
    for key, allowed in ranges_of(made).items():
        declare(f"material.{key}", allowed)
    return made


def ranges_of(law: type[Law] | Law) -> dict[str, Range]:
    """The range of each parameter of a law, by name."""
    return {part.name: part.metadata["range"] for part in _numbers(law)}


def _numbers(law: Any) -> list[dataclasses.Field[Any]]:
    return [part for part in dataclasses.fields(law) if not part.metadata.get("static")]
