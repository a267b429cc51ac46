"""The host's loop of windows as programs: what begins a run, takes windows, closes it and makes its result."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.adapt.refinement import refined_in_place
from jaxform.core.store import Soon, Store
from jaxform.dynamics.initial import initial_state
from jaxform.dynamics.window import window_in_place, with_room
from jaxform.kernels.blocks import only_if
from jaxform.model.scene import Scene
from jaxform.results.energy import UNBALANCED
from jaxform.results.result import Result, make_result
from jaxform.runs.padding import Padded, on_rungs
from jaxform.sheet.account import energy_rounding
from jaxform.sheet.active_set import ActiveSet, repacked, whole_set
from jaxform.sheet.discretization import Discretization, discretize, present_discretization
from jaxform.sheet.state import PackedState, State, Status, Taken, finished

IN_MEMORY = Store()
_ABOVE = 2  # rungs whose programs serve a smaller mesh too, rather than that others are compiled
_LARGE = 20_000  # elements, whose runs take as long as compiling: such a mesh has programs of its own


@jax.jit
def whole_run(scene: Scene) -> Result:
    """A run without its host's loop."""
    state, first, taken = begin(scene)
    state, taken, _ = advance(state, scene, first, taken, jnp.int32(scene.tables.window_count))
    return result_of(state, scene, first, taken, jnp.asarray(True))


@jax.jit
def result_of(
    state: State, scene: Scene, first: Discretization, taken: Taken | None = None, last: jax.Array | bool = False
) -> Result:
    """The result of a state; of the last one with what it has ended with."""
    status = jnp.where(last, closed(state, scene, first).status, state.status)
    return make_result(dataclasses.replace(state, status=status), scene, first, taken, last)


@jax.jit
def closed(state: State, scene: Scene, first: Discretization) -> State:
    """The last state; where the windows did not suffice, or energy was lost or won, its status says so."""
    short = jnp.where(finished(state, scene), 0, Status.WINDOWS_EXHAUSTED)
    least = energy_rounding(scene, jnp.sum(first.sheet.area * first.thickness))
    missing = jnp.abs(state.account.imbalance) > UNBALANCED * state.account.peak_work + least
    status = jnp.where((state.status | short) == 0, jnp.where(missing, Status.UNBALANCED, 0), state.status | short)
    return dataclasses.replace(state, status=status.astype(jnp.int32))


@jax.jit
def begin(scene: Scene) -> tuple[State, Discretization, Taken]:
    """The first state and body of a run, and room for what its windows take."""
    count = scene.tables.window_count
    state = initial_state(scene)
    none = jnp.zeros(count, state.time.dtype)
    return state, discretize(scene), (none, jnp.zeros(count, jnp.int32), none)


@jax.jit
def advance(
    state: State, scene: Scene, first: Discretization, taken: Taken, most: jax.Array
) -> tuple[State, Taken, jax.Array]:
    """At most so many windows."""

    def going(carry: _Going) -> jax.Array:
        return (carry.count < most) & ~finished(carry.state, scene)

    def take(carry: _Going) -> _Going:
        state, now, stale, active = carry.state, carry.now, carry.count == 0, carry.active
        if state.mesh is not None:
            before = state.mesh.element_count
            state, now, active = refined_in_place(state, scene, now, active)
            stale |= state.refined_mesh.element_count != before
            if active.idle is not None and carry.active.idle is not None:
                # What is idle was brought up to date: it holds another energy now.
                stale |= active.idle.since > carry.active.idle.since
        state, active = repacked(state, scene, now, active, stale)
        whole_window = lambda now: window_in_place(now[0], scene, now[1])  # noqa: E731
        after, active = unless_full(state.status, scene, whole_window, (state, active))
        at = state.windows
        taken = jax.tree.map(lambda rows, row: rows.at[at].set(row), carry.taken, latest(after))
        return _Going(after, now, active, taken, carry.count + 1)

    now = present_discretization(scene, state.mesh, first, stepped=True)
    active = with_room(whole_set(state, scene, now), scene)
    begun = _Going(active.taken(state), now, active, taken, jnp.int32(0))
    gone = jax.lax.while_loop(going, take, begun)
    return gone.active.put_back(gone.state), gone.taken, finished(gone.state, scene)


class _Going(NamedTuple):
    """What goes from window to window: with the state, in packed order, the body and what of it is active."""

    state: PackedState
    now: Discretization
    active: ActiveSet
    taken: Taken
    count: jax.Array


def latest(state: State) -> Taken:
    """Of the last window."""
    return state.control.last_length, state.control.last_count, state.control.bound


def unless_full[T](
    status: jax.Array, scene: Scene, take: Callable[[T], T], now: T, only_if: Callable[..., T] = only_if
) -> T:
    """A window, unless refinement found no room at its border: then the state is left for a run with more."""
    return take(now) if scene.refinement is None else only_if(status == 0, take, now)


class _Programs(NamedTuple):
    """Compiled for a scene's sizes: what begins a run and takes windows; soon, what makes its result."""

    begin: Callable[[Scene], tuple[State, Discretization, Taken]]
    advance: Callable[..., tuple[State, Taken, jax.Array]]
    result: Soon


class _Asked(NamedTuple):
    """The same three, being compiled side by side."""

    begin: Soon
    advance: Soon
    result: Soon


def _asked(scene: Scene, store: Store) -> _Asked:
    """The longest is begun as soon as its arguments' shapes are known."""
    beginning = store.soon(begin, scene)
    state, first, taken = beginning.shapes
    return _Asked(
        beginning,
        store.soon(advance, state, scene, first, taken, np.int32(1)),
        store.soon(result_of, state, scene, first, taken, np.bool_(True)),
    )


def programs(scene: Scene, store: Store) -> _Programs:
    """The programs of a run, once those that it begins with are compiled."""
    asked = _asked(scene, store)
    return _Programs(asked.begin.ready(), asked.advance.ready(), asked.result)


def roomed(scene: Scene, store: Store) -> Padded:
    """A scene in the room that a run gives it: of its own rungs, or larger where only the programs for that are there.

    A mesh that is not refined comes out the same in any room, its nodes to the last bit, sums to rounding. What is not
    used of two rungs more takes up to 7 % of a run, and to compile takes seconds.
    """
    own = room = on_rungs(scene, recorded=True)
    kept = room.order is None or scene.refinement is not None or len(scene.parison.triangles) > _LARGE
    if kept or store.holds(begin, room.scene):
        return own
    for _ in range(_ABOVE):
        room = on_rungs(scene, len(room.scene.parison.triangles), recorded=True)
        if _is_held(room.scene, store):
            return room
    return own


def is_compiled(scene: Scene, store: Store, least: int | None = None) -> bool:
    """Whether a run of a scene finds all its programs compiled: those of its rungs, as if it had so many elements."""
    room = roomed(scene, store) if least is None else on_rungs(scene, least, recorded=True)
    return _is_held(room.scene, store)


def _is_held(scene: Scene, store: Store) -> bool:
    """Whether all programs for a scene with room are there."""
    if not store.holds(begin, scene):
        return False
    state, first, taken = store.soon(begin, scene).shapes
    ending = store.holds(result_of, state, scene, first, taken, np.bool_(True))
    return ending and store.holds(advance, state, scene, first, taken, np.int32(1))


def compile_for(scene: Scene, store: Store, least: int = 0) -> None:
    """Compiles what runs of scenes of a kind and rungs need, and keeps it; as if one had at least so many elements."""
    for program in _asked(on_rungs(scene, least, recorded=True).scene, store):
        program.ready()


def compiling(scene: Scene, store: Store) -> None:
    """Compiles what a run of a scene needs, and does not wait for it: the run will find it in the store."""
    _asked(roomed(scene, store).scene, store)


def compiled_advance(
    state: State, scene: Scene, first: Discretization, taken: Taken
) -> Callable[..., tuple[State, Taken, jax.Array]]:
    """`advance`, compiled for the shapes of a run, in memory."""
    return IN_MEMORY.program(advance, state, scene, first, taken, np.int32(1))
