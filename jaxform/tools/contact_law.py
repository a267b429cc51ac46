"""Contact laws: the motion of nodes that touch a tool."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, pytree
from jaxform.core.ranges import check
from jaxform.mechanics.membrane import Vector, dot, vector


class ContactLaw:
    """A law of contact between the sheet and a tool.

    Attributes:
        kind: Its name in scene files.
        sticks: True if nodes move with the tool after contact, as in the paper. Otherwise they lie on its surface as
            long as it pushes them, and slide by `limit_slip`.
        has_friction: True if sliding nodes lose energy by friction.
    """

    kind: ClassVar[str]
    sticks: ClassVar[bool] = False
    has_friction: ClassVar[bool] = True

    @property
    def needs_temperature(self) -> bool:
        """True if the law depends on the temperature of the sheet."""
        return False

    def at(self, temperature: jax.Array | None) -> ContactLaw:
        """The law of nodes at temperatures (n,) [degC]; the law itself where it does not depend on them."""
        return self

    def limit_slip(self, slip: Vector, push: jax.Array) -> Vector:
        """The velocity along the surface after a step.

        Args:
            slip: Velocity relative to the tool without friction, three times (n,) [m/s], along the surface.
            push: Velocity (n,) [m/s] that the tool takes from the nodes in the direction of its normal, >= 0: the
                impulse by which it pushes them, over their mass.
        """
        raise NotImplementedError


@pytree
class Stick(ContactLaw):
    """Nodes stick where they touch, for the rest of the run."""

    kind = "stick"
    sticks = True
    has_friction = False


@pytree
class Slide(ContactLaw):
    """No friction: nodes slide freely, and leave a tool that would have to pull them."""

    kind = "slide"
    has_friction = False

    def limit_slip(self, slip: Vector, push: jax.Array) -> Vector:
        """The slip itself."""
        return slip


@pytree
class Coulomb(ContactLaw):
    """Coulomb friction, without regularization: below the cone nodes do not move at all.

    Attributes:
        friction: Coefficient of friction [-]; at each of the temperatures (n_knot,), where these are given.
        temperature: Increasing temperatures of the sheet (n_knot,) [degC]. Between them the coefficient is linear, and
            beyond the first and the last it is held. None where friction does not depend on the temperature.
    """

    friction: jax.Array
    temperature: jax.Array | None = None
    kind = "coulomb"

    @property
    def needs_temperature(self) -> bool:
        """True if friction depends on the temperature of the sheet."""
        return self.temperature is not None

    def at(self, temperature: jax.Array | None) -> Coulomb:
        """The law of nodes at temperatures (n,) [degC], with a coefficient (n,) each."""
        if self.temperature is None or temperature is None:
            return self
        knots, values = self.temperature, self.friction
        friction = values[0]
        for k in range(knots.size - 1):
            width = knots[k + 1] - knots[k]
            share = jnp.clip((temperature - knots[k]) / width, 0.0, 1.0)
            friction = friction + share * (values[k + 1] - values[k])
        return Coulomb(friction)

    def limit_slip(self, slip: Vector, push: jax.Array) -> Vector:
        """The slip, slower by `friction` times the push; 0 where friction suffices to hold the node."""
        square = dot(slip, slip)
        moves = square > jnp.square(self.friction * push)
        # The speed of a node that is held has no derivative, and needs none.
        speed = jnp.sqrt(jnp.where(moves, square, 1.0))
        share = jnp.where(moves, 1.0 - self.friction * push / speed, 0.0)
        return vector(share * x for x in slip)


def make_contact_law(
    kind: str = "stick",
    friction: ArrayLike | None = None,
    key: str = "mold",
    temperature: ArrayLike | None = None,
) -> ContactLaw:
    """A contact law by its name: "stick", "slide", or "coulomb" with a coefficient of friction.

    Args:
        kind: The name.
        friction: Coefficient of friction [-], a number, or (n_knot,) at each of the temperatures.
        key: The section of a scene file in messages.
        temperature: Increasing temperatures of the sheet (n_knot,) [degC] between which the coefficient is linear.

    Raises:
        InputError: There is no such law, or it does not go with the friction, or that with the temperatures.
    """
    if kind not in CONTACT_LAWS:
        raise InputError("is not a contact law", f"choose one of {', '.join(CONTACT_LAWS)}", f"{key}.contact", kind)
    if (kind == "coulomb") != (friction is not None):
        remedy = 'give it with contact = "coulomb", and only there'
        raise InputError("has no friction" if friction is None else "has a friction", remedy, f"{key}.friction", kind)
    if friction is None:
        return CONTACT_LAWS[kind]()
    check("mold.contact.friction", friction)
    shape, knots = np.shape(friction), () if temperature is None else np.shape(temperature)
    if shape != knots or len(knots) > 1 or knots in ((0,), (1,)):
        remedy = "give one number, or two or more and one temperature for each"
        raise InputError("does not fit its temperatures", remedy, f"{key}.friction", np.asarray(friction).tolist())
    if temperature is None:
        return Coulomb(as_real(friction))
    check("mold.contact.temperature", temperature)
    return Coulomb(as_real(friction), as_real(temperature))


CONTACT_LAWS: dict[str, type[ContactLaw]] = {law.kind: law for law in (Stick, Coulomb, Slide)}
