"""Contact laws: what a node that touches a tool does there."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, pytree
from jaxform.core.ranges import check
from jaxform.mechanics.membrane import Vector, dot, vector


class ContactLaw:
    """A law of contact between the sheet and a tool.

    Attributes:
        kind: Its name in scene files.
        sticks: Whether nodes that touch the tool move with it from then on, as the paper has it. Otherwise they lie on
            its surface as long as it pushes them, and slide by `limit_slip`.
    """

    kind: ClassVar[str]
    sticks: ClassVar[bool] = False

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
    """Nodes stick where they touch, and never let go."""

    kind = "stick"
    sticks = True


@pytree
class Slide(ContactLaw):
    """No friction: nodes slide freely, and leave a tool that would have to pull them."""

    kind = "slide"

    def limit_slip(self, slip: Vector, push: jax.Array) -> Vector:
        """The slip itself."""
        return slip


@pytree
class Coulomb(ContactLaw):
    """Coulomb friction, without regularization: below the cone nodes do not move at all.

    Attributes:
        friction: Coefficient of friction [-].
    """

    friction: jax.Array
    kind = "coulomb"

    def limit_slip(self, slip: Vector, push: jax.Array) -> Vector:
        """The slip, slower by `friction` times the push; 0 where friction suffices to hold the node."""
        square = dot(slip, slip)
        moves = square > jnp.square(self.friction * push)
        # The speed of a node that is held has no derivative, and needs none.
        speed = jnp.sqrt(jnp.where(moves, square, 1.0))
        share = jnp.where(moves, 1.0 - self.friction * push / speed, 0.0)
        return vector(share * x for x in slip)


def make_contact_law(kind: str = "stick", friction: ArrayLike | None = None, key: str = "mold") -> ContactLaw:
    """A contact law by its name: "stick", "slide", or "coulomb" with a coefficient of friction.

    Raises:
        InputError: There is no such law, or it does not go with the friction.
    """
    if kind not in CONTACT_LAWS:
        raise InputError("is no contact law", f"choose one of {', '.join(CONTACT_LAWS)}", f"{key}.contact", kind)
    if (kind == "coulomb") != (friction is not None):
        remedy = 'give it with contact = "coulomb", and only there'
        raise InputError("has no friction" if friction is None else "has a friction", remedy, f"{key}.friction", kind)
    if friction is None:
        return CONTACT_LAWS[kind]()
    check("mold.contact.friction", friction)
    return Coulomb(as_real(friction))


CONTACT_LAWS: dict[str, type[ContactLaw]] = {law.kind: law for law in (Stick, Coulomb, Slide)}
