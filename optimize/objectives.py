"""Objectives for the formed part, as one value to minimize, and their constraints.

An objective is a sum of squares where `deviations` says so (then least squares apply), and may have constraints
g <= 0, which the search keeps by an augmented Lagrangian. Objectives add up in a `Weighted` one.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform import InputError, Profile, Result, Scene, simulate
from optimize.wall_statistics import formed_area, nodal_area, nodal_volume, sheet_mass


class Objective:
    """An objective; a subclass defines at least its value or its deviations.

    Attributes:
        uniform: Uniform target wall [m], for pictures; None without one.
        squares: True if the value is the sum of the squares of `deviations`.
        constrained: True if there are constraints.
        aims: True if it has a target thickness, so that a fixed point applies.
        scale_free: True if a factor on the whole sheet hardly changes the value.
        price: Initial multipliers of its constraints.
    """

    uniform: float | None = None
    aims: bool = False
    squares: bool = False
    constrained: bool = False
    scale_free: bool = False
    price: float = 0.0

    def __call__(self, scene: Scene, result: Result) -> jax.Array:
        """The value to minimize; no unit."""
        return jnp.sum(jnp.square(self.deviations(scene, result)))

    def deviations(self, scene: Scene, result: Result) -> jax.Array:
        """Numbers (n,) whose squares add up to the value; no unit.

        Raises:
            InputError: If the value is not a sum of squares.
        """
        raise InputError(
            "needs an objective that is a sum of squares", "use lbfgs or adam", "solver.method", "least-squares"
        )

    def constraints(self, scene: Scene, result: Result) -> tuple[jax.Array, jax.Array]:
        """Constraints of the objective; none by default.

        Returns:
            The excess (n,) over each limit, relative to it, positive where a limit is broken; and the weight (n,) of
            each entry in its limit, which adds up to 1 for each limit.
        """
        return jnp.zeros(0), jnp.zeros(0)

    def first_multipliers(self, scene: Scene) -> jax.Array:
        """Initial multipliers of the constraints (n,)."""
        excess = jax.eval_shape(lambda scene: self.constraints(scene, simulate(scene))[0], scene)
        return jnp.full(excess.shape, self.price)

    def target_wall(self, result: Result) -> jax.Array:
        """The wall (n_node,) [m] that a fixed point leads to, where the objective aims at one."""
        raise NotImplementedError

    def error(self, scene: Scene, result: Result) -> jax.Array:
        """Deviation from the target, relative, rms over the formed area; NaN where there is no target."""
        return jnp.asarray(jnp.nan)


class Target(Objective):
    """The deviation of the wall from a target thickness.

    The objective is the square of the relative deviation of the wall from the target, averaged over the formed area.

    Args:
        scene: The scene that is designed.
        thickness: The target [m]: a number, a field (n_node,), or a `Profile` (along a place in the formed part, or,
            with `initial`, in the initial sheet).
        initial: True if the profile's place is that in the initial sheet.
        limit: Largest allowed deviation (rms); the objective is then a constraint, and its value is 0.

    Attributes:
        uniform: The target where it is one number, else None [m].
        nodal: The target at the nodes (n_node,) [m]; along a place in the formed part, all its values (n,).

    Raises:
        InputError: If a target is not positive or does not fit the mesh.
    """

    aims = True

    def __init__(
        self, scene: Scene, thickness: ArrayLike | Profile, *, initial: bool = True, limit: float | None = None
    ) -> None:
        """See the class."""
        self.uniform = float(thickness) if isinstance(thickness, int | float) else None
        self.limit, self.constrained, self.squares = limit, limit is not None, limit is None
        self._profile = thickness.positive() if isinstance(thickness, Profile) else None
        if isinstance(thickness, Profile):
            if initial:
                self._profile, thickness = None, thickness(np.asarray(scene.parison.positions))
            else:
                thickness = thickness.value[0]
        count = scene.parison.thickness.size
        given = np.asarray(thickness, float)
        if given.shape not in ((), (count,)):
            raise InputError(f"has shape {given.shape}", f"give shape ({count},)", "objective.thickness")
        if not np.all(np.isfinite(given) & (given > 0)):
            raise InputError("must be positive", "give metres > 0", "objective.thickness")
        self._nodal = jnp.asarray(np.broadcast_to(given, (count,)))
        self.nodal = self._nodal if self._profile is None else jnp.asarray(self._profile.value)

    def target_wall(self, result: Result) -> jax.Array:
        """The target at the nodes (n_node,) [m]."""
        if self._profile is None:
            return self._nodal
        positions = result.positions
        if self._profile.along == "radius":
            # The axis has no direction; the inner `where` keeps the root's slope finite there.
            square = jnp.square(positions[:, 0]) + jnp.square(positions[:, 1])
            place = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        else:
            place = positions[:, "xyz".index(self._profile.along)]
        return jnp.interp(place, jnp.asarray(self._profile.at), jnp.asarray(self._profile.value))

    def deviations(self, scene: Scene, result: Result) -> jax.Array:
        """Relative deviation at the nodes (n_node,), times the root of their share of the formed area."""
        weight = nodal_area(result)
        share = jnp.where(weight > 0, weight, 1.0) / jnp.sum(weight)
        relative = result.thickness / self.target_wall(result) - 1.0
        return jnp.where(weight > 0, jnp.sqrt(share) * relative, 0.0)

    def _square(self, scene: Scene, result: Result) -> jax.Array:
        return jnp.sum(jnp.square(self.deviations(scene, result)))

    def __call__(self, scene: Scene, result: Result) -> jax.Array:
        """Mean square of the relative deviation over the formed area; 0 where it is a constraint."""
        return self._square(scene, result) if self.limit is None else jnp.zeros(())

    def constraints(self, scene: Scene, result: Result) -> tuple[jax.Array, jax.Array]:
        """The mean square against that of the limit, halved so that it is relative to the rms."""
        if self.limit is None:
            return super().constraints(scene, result)
        excess = 0.5 * (self._square(scene, result) / self.limit**2 - 1.0)
        return excess[None], jnp.ones(1)

    def error(self, scene: Scene, result: Result) -> jax.Array:
        """Relative deviation, rms over the formed area."""
        return jnp.sqrt(self._square(scene, result))


class Uniform(Objective):
    """The square of the wall's coefficient of variation over the formed area."""

    squares = aims = scale_free = True

    def deviations(self, scene: Scene, result: Result) -> jax.Array:
        """Relative deviation of the elements from the mean (n_element,), times the root of their share of the area."""
        area = formed_area(result)
        share = area / jnp.sum(area)
        relative = result.element_thickness / jnp.sum(share * result.element_thickness) - 1.0
        return jnp.where(result.used, jnp.sqrt(jnp.where(result.used, share, 1.0)) * relative, 0.0)

    def target_wall(self, result: Result) -> jax.Array:
        """The mean wall (n_node,) [m]."""
        area = formed_area(result)
        mean = jnp.sum(area * result.element_thickness) / jnp.sum(area)
        return jnp.broadcast_to(mean, result.thickness.shape)


class LeastMass(Objective):
    """The least material for a wall that is nowhere thinner than a minimum.

    The value is the mass, of the part where the scene has one, or with `flash` of the whole sheet, over that of the
    initial whole sheet. The minimum is a constraint for each element of the part, with its own multiplier; no mean is
    taken. The weighted sum of the multipliers is the change of the mass, relative to the initial one, per relative
    change of the minimum. Wall and mass are nearly proportional: it is near the value, about 1 initially.

    Args:
        scene: The scene that is designed.
        minimum: The wall to keep [m].
        flash: True if the mass is that of the whole sheet, with its flash and all that is cut from the part.

    Raises:
        InputError: If the minimum is not positive.
    """

    constrained = aims = True
    price = 1.0

    def __init__(self, scene: Scene, minimum: float, *, flash: bool = False) -> None:
        """See the class."""
        if not 0.0 < minimum < np.inf:
            raise InputError("must be positive", "give metres > 0", "objective.minimum", minimum)
        self.minimum = self.uniform = float(minimum)
        self.flash = flash
        self._first_mass = float(sheet_mass(scene))

    def __call__(self, scene: Scene, result: Result) -> jax.Array:
        """The mass, of the part where the scene has one or of the whole sheet, over that of the initial whole sheet."""
        return (sheet_mass(scene) if self.flash else result.mass) / self._first_mass

    def constraints(self, scene: Scene, result: Result) -> tuple[jax.Array, jax.Array]:
        """Shortfall from the minimum (n_element,), relative to it; each element has the same weight."""
        excess = jnp.where(result.used, 1.0 - result.element_thickness / self.minimum, -1.0)
        return excess, jnp.where(result.used, 1.0, 0.0) / jnp.sum(result.used)

    def target_wall(self, result: Result) -> jax.Array:
        """The minimum (n_node,) [m]."""
        return jnp.full_like(result.thickness, self.minimum)


class FormingTime(Objective):
    """The time at which the sheet touches the mold, over the scene's end time.

    The times of the nodes are averaged by volume with a high power, so that the last ones dominate; a node without
    contact counts with the end time.

    Args:
        scene: The scene that is designed.
        power: Power of the mean; the higher, the nearer to the last node's time.

    Raises:
        InputError: If the scene has no mold.
    """

    def __init__(self, scene: Scene, power: float = 8.0) -> None:
        """See the class."""
        if scene.mold is None:
            raise InputError("needs a mold to touch", "add a mold to the scene", "objective.kind", "forming-time")
        self.power, self._end = power, float(scene.solver.end_time)

    def __call__(self, scene: Scene, result: Result) -> jax.Array:
        """Mean contact time over the scene's end time."""
        movable = result.contact_time != 0.0
        weight = jnp.where(movable, nodal_volume(result), 0.0)
        share = jnp.where(result.contact_time > 0.0, result.contact_time, self._end) / self._end
        mean = jnp.sum(weight * share**self.power) / jnp.sum(weight)
        return mean ** (1.0 / self.power)


class KineticEnergy(Objective):
    """The kinetic energy of the sheet at contact with the mold, and at the end, over the work."""

    squares = True

    def deviations(self, scene: Scene, result: Result) -> jax.Array:
        """The root of that share (1,)."""
        energy = result.energy
        share = (energy.contact_loss + energy.kinetic) / jnp.abs(energy.work)
        return jnp.sqrt(jnp.maximum(share, 1e-30))[None]


class Weighted(Objective):
    """A weighted sum of objectives; the constraints of all are kept.

    Args:
        parts: Weight and objective of each.
    """

    def __init__(self, parts: Sequence[tuple[float, Objective]]) -> None:
        """See the class."""
        self.parts = list(parts)
        uniform = [part.uniform for _, part in self.parts if part.uniform is not None]
        self.uniform = uniform[0] if uniform else None
        self.squares = all(part.squares for _, part in self.parts)
        self.constrained = any(part.constrained for _, part in self.parts)
        self.aims = any(part.aims for _, part in self.parts)

    def __call__(self, scene: Scene, result: Result) -> jax.Array:
        """The weighted sum."""
        return sum((weight * part(scene, result) for weight, part in self.parts), start=jnp.zeros(()))

    def deviations(self, scene: Scene, result: Result) -> jax.Array:
        """Deviations of all parts, times the roots of their weights."""
        return jnp.concatenate([weight**0.5 * part.deviations(scene, result) for weight, part in self.parts])

    def constraints(self, scene: Scene, result: Result) -> tuple[jax.Array, jax.Array]:
        """Constraints of all parts."""
        each = [part.constraints(scene, result) for _, part in self.parts]
        excess, weight = (jnp.concatenate(values) for values in zip(*each, strict=True))
        return excess, weight

    def first_multipliers(self, scene: Scene) -> jax.Array:
        """Multipliers of all parts, times their weights."""
        return jnp.concatenate([weight * part.first_multipliers(scene) for weight, part in self.parts])

    def target_wall(self, result: Result) -> jax.Array:
        """Wanted thickness of the first objective that has one."""
        return next(part for _, part in self.parts if part.aims).target_wall(result)

    def error(self, scene: Scene, result: Result) -> jax.Array:
        """Deviation of the first objective with a target; NaN without one."""
        errors = [part.error(scene, result) for _, part in self.parts if isinstance(part, Target)]
        return errors[0] if errors else jnp.asarray(jnp.nan)
