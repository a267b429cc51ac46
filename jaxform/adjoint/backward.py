"""One step of the reversed scheme: over the nodes, from one step to the one before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import ArraySlice, materialize, over_blocks
from jaxform.materials import Law
from jaxform.mechanics.corners import Load, corner_forces
from jaxform.mechanics.elements import Corners, gather_shares, gather_table
from jaxform.mechanics.membrane import Vector, dot, vector
from jaxform.model.scene import Scene
from jaxform.sheet.packing import Packed


class ReverseWindow(NamedTuple):
    """Constants of a window, in packed order; as in `step`, and the landing steps of the nodes (place,).

    The law has its zones for each element. Beyond the steps that were taken, pressure and kick are 0.
    """

    scene: Scene
    packed: Packed
    thickness: jax.Array
    material: Law
    mass: jax.Array
    compliance: jax.Array
    landing_step: jax.Array
    pressure: jax.Array
    kick: jax.Array
    length: jax.Array
    count: jax.Array


class ReverseStart(NamedTuple):
    """The start of the reverse steps, in packed order: as in `_WindowResiduals`, with each step's velocities if kept.

    Attributes:
        before: Of nodes that landed, before that step (3, place) [m].
        velocities: After the last step (3, place) [m/s]; of nodes that landed, what they landed with.
        speeds: Velocities before each step and after the last (3, (1 + steps) place) [m/s], one step's after another's.
        keeps: Whether they are kept.
    """

    before: jax.Array
    velocities: jax.Array
    speeds: jax.Array | None = None
    keeps: jax.Array | bool = False

    def velocities_before(self, number: jax.Array) -> ArraySlice | None:
        """Velocities before a step; where none are kept, it is the same part for all of them, which costs least."""
        if self.speeds is None:
            return None
        places = self.before.shape[1]
        return ArraySlice(self.speeds, jnp.where(self.keeps, number, 0) * places, places)


class BackwardNodes(NamedTuple):
    """Between two steps: the nodes' positions [m] and cotangents, and what the sums over steps have come to.

    Attributes:
        at: Where they are (3, place) [m].
        speeds: Their velocities after the step that begins there (3, place) [m/s].
        positions: Cotangents of the positions (3, place), all but what the force at them adds.
        velocities: Of the velocities after the step (3, place), with what the positions after it add.
        force: Of the force in the step (3, place).
        mass, compliance, contact_time: Of the mass, the compliance's logarithm and the contact time (place,).
        damping, vertices: Of the damping and of the mold's vertices (n_vertex, 3).
    """

    at: jax.Array
    speeds: jax.Array
    positions: jax.Array
    velocities: jax.Array
    force: jax.Array
    mass: jax.Array
    compliance: jax.Array
    contact_time: jax.Array
    damping: jax.Array
    vertices: jax.Array | None


class AdjointStep(NamedTuple):
    """Between two steps: the number of the earlier one and its length, and the kicks of both [s].

    Before the first step there is one of no length.
    """

    number: jax.Array
    length: jax.Array
    kick: jax.Array
    later_kick: jax.Array


def _half_damping(kick: jax.Array, damping: jax.Array | None) -> jax.Array | float:
    return 0.0 if damping is None else 0.5 * kick * damping


def _velocities_before(
    nodal: Sequence[jax.Array],
    after: Any,
    speeds: Any,
    node: tuple[jax.Array, Any],
    kick: jax.Array,
    now: ReverseWindow,
    end: ReverseStart,
) -> Vector:
    """Velocities before a step, (n,) each, from its force and those `after` it; or as they were kept, `speeds`.

    Args:
        nodal: The force [N].
        after: Velocities after the step [m/s].
        speeds: Those before it, where they are kept.
        node: Whether the nodes are free in it, and their compliance [1/kg].
        kick: The step that the velocity takes [s].
        now: The window.
        end: Its end.
    """
    flies, compliance = node
    half = _half_damping(kick, now.scene.solver.damping)
    rest = 1.0 / (1.0 - half)

    def invert_update(v: jax.Array, f: jax.Array, c: jax.Array) -> jax.Array:
        before = ((1.0 + half) * v - kick * (f * c)) * rest
        return jnp.where(flies, before, v)

    found = [invert_update(*each) for each in zip(after, nodal, compliance, strict=True)]
    if speeds is not None:
        found = [jnp.where(end.keeps, old, v) for old, v in zip(speeds, found, strict=True)]
    return vector(found)


def force_cotangent(velocities: Any, compliance: Any, kick: jax.Array, now: ReverseWindow) -> list[jax.Array]:
    """Cotangents of the force in a step, from those of the velocities after it."""
    factor = kick / (1.0 + _half_damping(kick, now.scene.solver.damping))
    return [factor * c * g for g, c in zip(velocities, compliance, strict=True)]


def add_loss_cotangents(
    nodes: BackwardNodes,
    corners: Corners,
    load: Load,
    turn: AdjointStep,
    damping: jax.Array,
    now: ReverseWindow,
    end: ReverseStart,
    loss: jax.Array,
) -> tuple[BackwardNodes, Corners]:
    """Adds to the cotangents of a step's velocities and force what its damping loss has of them.

    For that the velocities before the step must be known, and so its force, before its elements are gone back over.
    """
    elements = now.packed.elements
    forces, _ = corner_forces(load, elements, corners[3:])
    kick = turn.later_kick

    def work(old: Any, own: Any, landed: Any, mass: Any, compliance: Any, after: Any, kept: Any) -> Any:
        flies = landed > turn.number
        nodal = gather_shares(forces, own)
        before = _velocities_before(nodal, after, kept, (flies, compliance), kick, now, end)
        share = jnp.where(flies, 0.5 * loss * kick * mass * damping, 0.0)
        more = [share * (v + w) for v, w in zip(before, after, strict=True)]
        more = [more, force_cotangent(more, compliance, kick, now)]
        return [[x + own for x, own in zip(*pair, strict=True)] for pair in zip(old, more, strict=True)], []

    kept = end.velocities_before(turn.number + 1)
    inputs = gather_table(elements), now.landing_step, now.mass, now.compliance, nodes.speeds, kept
    into = [nodes.velocities, nodes.force]
    new, _ = over_blocks(work, elements.node_block_count, inputs, into, update=2)
    return nodes._replace(velocities=new[0], force=new[1]), [*corners[:3], *forces]


def step_nodes_back(
    nodes: BackwardNodes, corners: Corners, turn: AdjointStep, now: ReverseWindow, end: ReverseStart, loss: jax.Array
) -> BackwardNodes:
    """Steps the nodes back by one step, from the cotangents and forces at the elements' corners.

    Nodes that landed in the earlier one are left for `_landings`.
    """
    elements, damping = now.packed.elements, now.scene.solver.damping
    kick, half = turn.later_kick, _half_damping(turn.later_kick, damping)

    def work(old: Any, own: Any, landed: Any, mass: Any, compliance: Any, kept: Any) -> Any:
        at, after, position, velocity, (power,), *more = old
        flies = landed > turn.number
        both = gather_shares(corners, own)
        pulled, nodal = both[:3], both[3:]
        before = _velocities_before(nodal, after, kept, (flies, compliance), kick, now, end)
        position = [x + own for x, own in zip(position, pulled, strict=True)]
        before, position = materialize((before, position))
        ratio = (1.0 - half) / (1.0 + half)
        gains = vector(jnp.where(flies, v - ratio * w, 0.0) for v, w in zip(after, before, strict=True))
        power, sums = [power + dot(vector(velocity), gains)], []
        if damping is not None:
            twice = vector(jnp.where(flies, v + w, 0.0) for v, w in zip(before, after, strict=True))
            rate, share = 0.25 * loss * kick * dot(twice, twice), 0.5 * loss * kick * mass * damping
            more = [[more[0][0] + rate * damping]]
            sums = [rate * mass - 0.5 * kick / (1.0 + half) * dot(vector(velocity), twice)]
            velocity = [ratio * g + share * both for g, both in zip(velocity, twice, strict=True)]
        velocity = [g + turn.length * x for g, x in zip(velocity, position, strict=True)]
        velocity = materialize(velocity)
        force = [jnp.where(flies, f, 0.0) for f in force_cotangent(velocity, compliance, turn.kick, now)]
        at = [x - jnp.where(flies, turn.length * v, 0.0) for x, v in zip(at, before, strict=True)]
        return [at, before, position, velocity, power, *more, force], sums

    kept = end.velocities_before(turn.number + 1)
    inputs = gather_table(elements), now.landing_step, now.mass, now.compliance, kept
    updated = [nodes.at, nodes.speeds, nodes.positions, nodes.velocities, nodes.compliance[None]]
    updated += [nodes.mass[None]] if damping is not None else []
    count = int(damping is not None)
    new, sums = over_blocks(
        work, elements.node_block_count, inputs, [*updated, nodes.force], sums=count, update=len(updated)
    )
    at, before, position, velocity, (power,), *more, force = new
    nodes = nodes._replace(at=at, speeds=before, positions=position, velocities=velocity, force=force, compliance=power)
    return nodes if damping is None else nodes._replace(mass=more[0][0], damping=nodes.damping + sums[0])
