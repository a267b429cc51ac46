"""Data of a window: its state, which changes from step to step, and its constants."""

from __future__ import annotations

from typing import NamedTuple

import jax

from jaxform.contact.broad_phase import BroadPhaseCheck
from jaxform.contact.sticking import FirstHits
from jaxform.core.pytree import pytree
from jaxform.materials import Modes, Recursion
from jaxform.mechanics.elements import Corners
from jaxform.mechanics.nodes import Nodes
from jaxform.sheet.active_set import ActiveSet
from jaxform.sheet.state import EnergyBalance


@pytree
class WindowState:
    """State that changes from step to step inside a window, in packed order.

    The memory is what elements remember from one step to the next (4 n_mode, room), before the first step and at the
    window's end the stress of their viscous modes; None where they have none. Positions (3, place) [m] are three rows
    where no derivative is taken: else they would be taken apart in every step. `landing_step` is the step in which
    a node landed, NEVER where it has not in this window, and the impact that of `sticking.Landing`, None where it is
    not kept.
    Whether another list of candidates is due, what was seen last of the mold, and the room for meetings are None where
    none are looked for; the room for corner forces is None where derivatives are taken.
    """

    nodes: Nodes
    fields: dict[str, jax.Array]
    account: EnergyBalance
    memory: jax.Array | None
    landing_step: jax.Array
    impact: jax.Array | None
    count: jax.Array
    halted: jax.Array
    stale: jax.Array | None
    check: BroadPhaseCheck | None
    room: Corners | None
    hits: FirstHits | None

    @property
    def last_look(self) -> BroadPhaseCheck:
        """The last broad-phase check, where contact is searched for."""
        assert self.check is not None
        return self.check


@pytree
class WindowData:
    """Constants of a window, in packed order.

    Attributes:
        active: The elements and nodes that are active.
        begin: Its begin [s].
        length: The step [s].
        bound: The elements' bound on it [s].
        most: How many steps it takes, unless it is cut short.
        row: Of a schedule that is followed; None where none is.
        wary: Whether no look at the nodes is trusted, since the last window was not taken.
        recursion: How viscous modes go over a step; None where there are none.
        losing: Viscous modes by which losses are counted; None where there are none.
        rim: Places of the ends of moving rims' edges (2, n_edge); None where there are none.
    """

    active: ActiveSet
    begin: jax.Array
    length: jax.Array
    bound: jax.Array
    max_count: jax.Array
    row: ScheduleRow | None
    always_check: jax.Array
    recursion: Recursion | None
    losing: Modes | None = None
    rim: jax.Array | None = None


class ScheduleRow(NamedTuple):
    """The row of a schedule whose steps are taken, and the time that is left of it [s]."""

    number: jax.Array
    left: jax.Array


class KnownContact(NamedTuple):
    """Known contact of a window whose steps are recomputed, in packed order.

    The step in which each node landed (place,), NEVER where it did not, and on what, as in `State`; and how many steps
    were taken.
    """

    step: jax.Array
    wall: jax.Array
    count: jax.Array


class ContactSearch(NamedTuple):
    """Result of the contact search in a window.

    The most pairs of node and triangle that it listed at once; whether any found no room; and whether a node may have
    missed the mold, out of its sphere or faster than it was looked at.
    """

    pairs: jax.Array
    overflow: jax.Array
    missed: jax.Array
