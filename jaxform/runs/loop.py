"""Programs of the host's loop of windows: they begin a run, take windows, end it and make its result."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.adapt.refinement import refine_in_place
from jaxform.core.store import PendingProgram, Store
from jaxform.dynamics.window import allocate_workspace, window_in_place
from jaxform.dynamics.window_state import initial_state
from jaxform.kernels.blocks import lax_cond_once
from jaxform.model.scene import Scene
from jaxform.results.result import UNBALANCED, Result, make_result
from jaxform.runs.padding import Padded, pad_to_bucket
from jaxform.sheet.active_set import ActiveSet, repack, whole_set
from jaxform.sheet.discretization import Discretization, discretize, present_discretization
from jaxform.sheet.energy_balance import energy_rounding
from jaxform.sheet.self_contact import stick_folds
from jaxform.sheet.state import PackedState, State, Status, Taken, is_finished

IN_MEMORY = Store()
_ABOVE = 2  # next larger bucket sizes whose compiled programs are used for a smaller mesh too
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
    """The result of a state; that of the last one has its final status."""
    status = jnp.where(last, finalize_state(state, scene, first).status, state.status)
    return make_result(dataclasses.replace(state, status=status), scene, first, taken, last)


@jax.jit
def finalize_state(state: State, scene: Scene, first: Discretization) -> State:
    """The final state; its status tells if the windows did not suffice, or if the energy is out of balance."""
    short = jnp.where(is_finished(state, scene), 0, Status.WINDOWS_EXHAUSTED)
    least = energy_rounding(scene, jnp.sum(first.sheet.area * first.thickness))
    missing = jnp.abs(state.account.imbalance) > UNBALANCED * state.account.peak_work + least
    status = jnp.where((state.status | short) == 0, jnp.where(missing, Status.UNBALANCED, 0), state.status | short)
    return dataclasses.replace(state, status=status.astype(jnp.int32))


@jax.jit
def begin(scene: Scene) -> tuple[State, Discretization, Taken]:
    """The initial state and discretization of a run, and empty arrays for the decisions of its windows."""
    count = scene.tables.window_count
    state = initial_state(scene)
    none = jnp.zeros(count, state.time.dtype)
    return state, discretize(scene), (none, jnp.zeros(count, jnp.int32), none)


@jax.jit
def advance(
    state: State, scene: Scene, first: Discretization, taken: Taken, most: jax.Array
) -> tuple[State, Taken, jax.Array]:
    """At most `most` windows."""

    def continues(carry: _LoopState) -> jax.Array:
        return (carry.count < most) & ~is_finished(carry.state, scene)

    def take(carry: _LoopState) -> _LoopState:
        state, now, stale, active = carry.state, carry.now, carry.count == 0, carry.active
        if state.mesh is not None:
            before = state.mesh.element_count
            state, now, active = refine_in_place(state, scene, now, active)
            stale |= state.refined_mesh.element_count != before
            if active.idle is not None and carry.active.idle is not None:
                # Idle elements were brought up to date, so that their energy has changed.
                stale |= active.idle.since > carry.active.idle.since
        state, active = repack(state, scene, now, active, stale)
        whole_window = lambda now: window_in_place(stick_folds(now[0], scene, now[1]), scene, now[1])  # noqa: E731
        after, active = skip_if_full(state.status, scene, whole_window, (state, active))
        at = state.windows
        taken = jax.tree.map(lambda rows, row: rows.at[at].set(row), carry.taken, latest_decisions(after))
        return _LoopState(after, now, active, taken, carry.count + 1)

    now = present_discretization(scene, state.mesh, first, stepped=True)
    active = allocate_workspace(whole_set(state, scene, now), scene)
    begun = _LoopState(active.pack_state(state), now, active, taken, jnp.int32(0))
    gone = jax.lax.while_loop(continues, take, begun)
    return gone.active.unpack_state(gone.state), gone.taken, is_finished(gone.state, scene)


class _LoopState(NamedTuple):
    """State of the loop over windows: the state in packed order, the discretization, and its active set."""

    state: PackedState
    now: Discretization
    active: ActiveSet
    taken: Taken
    count: jax.Array


def latest_decisions(state: State) -> Taken:
    """Decisions of the last window: its length, its number of steps, and its bound."""
    return state.control.last_length, state.control.last_count, state.control.bound


def skip_if_full[T](
    status: jax.Array, scene: Scene, take: Callable[[T], T], now: T, only_if: Callable[..., T] = lax_cond_once
) -> T:
    """A window, unless refinement overflowed at its boundary: the state is left for a run with a larger capacity."""
    return take(now) if scene.refinement is None else only_if(status == 0, take, now)


def _request_programs(scene: Scene, store: Store) -> tuple[PendingProgram, PendingProgram, PendingProgram]:
    """The programs that begin a run, take windows and make its result, which are compiled concurrently.

    The longest is begun as soon as its arguments' shapes are known.
    """
    beginning = store.start_program(begin, scene)
    state, first, taken = beginning[0]
    return (
        beginning,
        store.start_program(advance, state, scene, first, taken, np.int32(1)),
        store.start_program(result_of, state, scene, first, taken, np.bool_(True)),
    )


def programs(
    scene: Scene, store: Store
) -> tuple[
    Callable[[Scene], tuple[State, Discretization, Taken]],
    Callable[..., tuple[State, Taken, jax.Array]],
    PendingProgram,
]:
    """The compiled programs that begin a run and take windows, and the pending one that makes its result."""
    (_, beginning), (_, advancing), ending = _request_programs(scene, store)
    return beginning.result(), advancing.result(), ending


def select_bucket(scene: Scene, store: Store) -> Padded:
    """The scene padded for a run: to its bucket sizes, or to larger ones where only their programs are compiled.

    A mesh that is not refined gives the same result at any capacity, its nodes to the last bit, sums to rounding.
    Padding by two more bucket sizes takes up to 7 % of a run; compiling takes seconds.
    """
    own = room = pad_to_bucket(scene, recorded=True)
    kept = room.order is None or scene.refinement is not None or len(scene.parison.triangles) > _LARGE
    if kept or store.shared or store.has_program(begin, room.scene):
        return own
    for _ in range(_ABOVE):
        room = pad_to_bucket(scene, len(room.scene.parison.triangles), recorded=True)
        if _has_programs(room.scene, store):
            return room
    return own


def is_compiled(scene: Scene, store: Store, least: int | None = None) -> bool:
    """True if a run of a scene finds all its programs compiled, for its bucket sizes or at least `least` elements."""
    room = select_bucket(scene, store) if least is None else pad_to_bucket(scene, least, recorded=True)
    return _has_programs(room.scene, store)


def _has_programs(scene: Scene, store: Store) -> bool:
    """True if all programs for a padded scene are compiled."""
    if not store.has_program(begin, scene):
        return False
    (state, first, taken), _ = store.start_program(begin, scene)
    ending = store.has_program(result_of, state, scene, first, taken, np.bool_(True))
    return ending and store.has_program(advance, state, scene, first, taken, np.int32(1))


def compile_for(scene: Scene, store: Store, least: int = 0) -> None:
    """Compiles and stores the programs for scenes of a kind and bucket sizes, for at least `least` elements."""
    for _, program in _request_programs(pad_to_bucket(scene, least, recorded=True).scene, store):
        program.result()


def start_programs(scene: Scene, store: Store) -> None:
    """Starts to compile the programs for a run of a scene; the run will find them in the store."""
    _request_programs(select_bucket(scene, store).scene, store)


def compile_advance(
    state: State, scene: Scene, first: Discretization, taken: Taken
) -> Callable[..., tuple[State, Taken, jax.Array]]:
    """`advance`, compiled for the shapes of a run, in memory."""
    return IN_MEMORY.program(advance, state, scene, first, taken, np.int32(1))
