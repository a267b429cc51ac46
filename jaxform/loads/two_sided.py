"""Loads on both sides of the sheet: a pressure or a gas inside it, and the gas between it and the mold."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import numpy as np

from jaxform.core.errors import InputError
from jaxform.loads.gas import Gas
from jaxform.loads.loading import Interval, Loading, loading


@loading
class TwoSidedLoad(Loading):
    """A pressure history or a gas inside the sheet, and a gas on its other side, trapped in the mold.

    The pressure on the sheet is their difference. Numbers of the two have the paths `pressure.inside.value` and
    `pressure.trapped.vent_area`.

    Attributes:
        inside: The load inside the sheet.
        trapped: The gas between the sheet and the mold, closed by the mold.
    """

    follows_volume: ClassVar[bool] = True

    inside: Loading = dataclasses.field(metadata={"part": True})
    trapped: Gas = dataclasses.field(metadata={"part": True})

    def start(self, volume: jax.Array) -> Any:
        """The states of the two."""
        return self.inside.start(volume), self.trapped.start(volume)

    def after(self, state: Any, interval: Interval) -> Any:
        """The states of the two at the end of an interval."""
        inside, trapped = state
        inside = None if inside is None else self.inside.after(inside, interval)
        return inside, self.trapped.after(trapped, interval)

    def at(self, time: jax.Array, volume: jax.Array, state: Any) -> jax.Array:
        """Difference of the pressures [Pa]."""
        inside, trapped = state
        pushed = self.inside.at(time, volume, *(() if inside is None else (inside,)))
        return pushed + self.trapped.at(time, volume, trapped)

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """The pressures [Pa] inside."""
        return self.inside.pushes(end_time, volume)


def make_two_sided_load(inside: Loading, trapped: Gas) -> TwoSidedLoad:
    """A load inside the sheet and the gas that it traps in the mold; see `TwoSidedLoad`.

    Raises:
        InputError: The second is no gas that is closed by the mold, or the first is one.
    """
    if not isinstance(trapped, Gas) or trapped.closed_by != "mold":
        raise InputError("is no gas closed by the mold", 'use make_gas(..., closed_by="mold")', "pressure.trapped")
    if (
        not isinstance(inside, Loading)
        or isinstance(inside, TwoSidedLoad)
        or getattr(inside, "closed_by", "") == "mold"
    ):
        raise InputError("is no load inside the sheet", "use make_pressure or make_gas", "pressure.inside")
    return TwoSidedLoad(inside, trapped)


def list_gases(load: Loading) -> list[Gas]:
    """The gases of a load."""
    parts = (load.inside, load.trapped) if isinstance(load, TwoSidedLoad) else (load,)
    return [part for part in parts if isinstance(part, Gas)]
