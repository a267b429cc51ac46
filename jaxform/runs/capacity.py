"""Larger capacities where a run overflowed: for elements, for pairs near the mold, for windows. On the host.

Sizes of compiled programs are planned when a scene is built. Where one does not suffice, the run keeps the state
before the overflow, and continues in a program with a larger capacity.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.adapt.refinement import can_enlarge_capacity, enlarge_capacity
from jaxform.model.scene import Scene
from jaxform.sheet.state import State, Status, Taken

_MORE_PAIRS, _MOST_PAIRS = 4, 2048  # times as many; and at most so many for each node


def enlarge_room(
    scene: Scene, state: State, taken: Taken, done: bool, most_steps: int
) -> tuple[Scene, State, Taken] | None:
    """The scene with a larger capacity of the kind that overflowed, and the run's state in it.

    None where nothing overflowed, or where a larger capacity would be of no use.

    Args:
        scene: The scene.
        state: State of the run.
        taken: Decisions of its windows.
        done: Whether the run is finished.
        most_steps: Limit on the steps of the run.
    """
    status, tables, adaptivity = int(state.status), scene.tables, scene.adaptivity
    if status == Status.REFINEMENT_OVERFLOW and adaptivity is not None and can_enlarge_capacity(adaptivity):
        return *enlarge_capacity(scene, adaptivity, state), taken
    if status == Status.CONTACT_OVERFLOW and tables.pairs_per_node < _MOST_PAIRS:
        wider = dataclasses.replace(tables, pairs_per_node=_MORE_PAIRS * tables.pairs_per_node)
        # The window that overflowed does not count as failed.
        retries = jnp.maximum(state.control.retries - 1, 0)
        control = dataclasses.replace(state.control, retries=retries)
        state = dataclasses.replace(state, status=jnp.zeros_like(state.status), control=control)
        return dataclasses.replace(scene, tables=wider), state, taken
    if not done and int(state.windows) >= tables.window_count and int(state.steps) < most_steps:
        longer = dataclasses.replace(tables, window_count=2 * tables.window_count)
        rows = jax.tree.map(lambda row: jnp.asarray(np.append(row, np.zeros_like(row))), taken)
        return dataclasses.replace(scene, tables=longer), state, rows
    return None


def remaining_windows(scene: Scene, state: State, most_steps: int) -> int:
    """Number of windows that a run may take until the end of its plan, or its limit on steps."""
    steps = most_steps - int(state.steps)
    return max(0, min(scene.tables.window_count - int(state.windows), -(-steps // int(scene.tables.longest_window))))
