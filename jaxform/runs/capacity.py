"""More room where a run found too little: for elements, for pairs near the mold, for windows. On the host.

What has a size in a compiled program is planned when a scene is built. Where a plan does not suffice the run is left
as it was before, and goes on in a program with more room.
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
    """The scene with more room of the kind that a state found too little of, and the run's state in it.

    None where it found enough, or where more would be of no use.

    Args:
        scene: The scene.
        state: Where the run is.
        taken: What its windows took.
        done: Whether there is nothing left to do.
        most_steps: Where the run stops at the latest.
    """
    status, tables, adaptivity = int(state.status), scene.tables, scene.adaptivity
    if status == Status.REFINEMENT_OVERFLOW and adaptivity is not None and can_enlarge_capacity(adaptivity):
        return *enlarge_capacity(scene, adaptivity, state), taken
    if status == Status.CONTACT_OVERFLOW and tables.pairs_per_node < _MOST_PAIRS:
        wider = dataclasses.replace(tables, pairs_per_node=_MORE_PAIRS * tables.pairs_per_node)
        # The window that found no room counts as none that failed.
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
    """How many windows a run may take until its plan, or the limit on its steps, is at its end."""
    steps = most_steps - int(state.steps)
    return max(0, min(scene.tables.window_count - int(state.windows), -(-steps // int(scene.tables.longest_window))))
