"""Contact of a formed part with the mold and each tool: shares of its area, its wall there, and figures per tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.tools.mold import Mold
from jaxform.tools.penetration import (
    Penetration,
    element_depths,
    penetration,
    pull_direction,
    resting_directions,
)
from jaxform.tools.search import SearchGrid

Array = NDArray[np.float64]


def formed_areas(result: Result) -> Array:
    """Final area (n_element,) [m^2] of the elements; 0 where not used."""
    volume, wall = np.asarray(result.element_volume, float), np.asarray(result.element_thickness, float)
    return volume / np.where(wall > 0.0, wall, 1.0)


def wall_statistics(result: Result, chosen: NDArray[np.bool_] | None = None) -> dict[str, float]:
    """Least, mean and largest thickness [m] of the elements and its coefficient of variation, by formed area.

    Args:
        result: The part.
        chosen: Mask of the elements (n_element,) that count; all by default.
    """
    used = np.asarray(result.used) if chosen is None else np.asarray(result.used) & chosen
    area, wall = formed_areas(result)[used], np.asarray(result.element_thickness, float)[used]
    mean = float(np.average(wall, weights=area))
    spread = float(np.sqrt(np.average(np.square(wall - mean), weights=area)))
    return {"min": float(wall.min()), "mean": mean, "max": float(wall.max()), "cv": spread / mean}


def contact_elements(result: Result) -> NDArray[np.bool_]:
    """Elements with three nodes that are clamped or touch a tool (n_element,), at least one of which touches one."""
    triangles = np.asarray(result.triangles)
    held = np.asarray(result.stuck) | (np.asarray(result.tool) >= 0)
    stuck, touched = held[triangles], (np.asarray(result.contact_time) > 0)[triangles]
    return stuck.all(1) & touched.any(1)


def touched_tools(result: Result) -> NDArray[np.int64]:
    """The number of the tool that each element touches (n_element,), as in `Scene.surfaces`; -1 for none.

    An element touches a tool if it counts for the summary's `contact_fraction`; one between two tools is counted with
    the later one.
    """
    tool = np.asarray(result.tool)[np.asarray(result.triangles)].max(1, initial=-1)
    return np.where(contact_elements(result), tool, -1)


def contact_shares(result: Result, count: int) -> Array:
    """Shares (count,) of the formed area that touch each of so many tools, as in `Scene.surfaces`.

    Their sum is the summary's `contact_fraction`.
    """
    area, touched = formed_areas(result), touched_tools(result)
    return np.array([area[touched == number].sum() for number in range(count)]) / area.sum()


def contact_shares_over_time(result: Result, time: Array, count: int) -> Array:
    """Shares (count, n) like `contact_shares` at times (n,) [s], of tools to which nodes stick: contact never ends."""
    area, touched = formed_areas(result), touched_tools(result)
    last = np.asarray(result.contact_time, float)[np.asarray(result.triangles)].max(1, initial=0.0)
    shares = []
    for number in range(count):
        touching = touched == number
        order = np.argsort(last[touching])
        so_far = np.concatenate([[0.0], np.cumsum(area[touching][order])])
        shares.append(so_far[np.searchsorted(last[touching][order], time, side="right")] / area.sum())
    return np.array(shares).reshape(count, len(time))


_RECORDS = 60  # of the contact in a run in which nodes slide


class ContactRecord:
    """Shares of the sheet on each tool, some tens of times in a run: where nodes slide, they also leave tools.

    Args:
        count: Number of the scene's surfaces.
        end_time: End time of the run [s].
    """

    def __init__(self, count: int, end_time: float) -> None:
        """See the class."""
        self._every, self._count = end_time / _RECORDS, count
        self._times: list[float] = []
        self._shares: list[Array] = []
        self._periods = np.full((count, 2), np.nan)
        self._tool, self._durations = np.zeros(0, np.int64), np.zeros((0, count))

    def offer(self, time: float, make: Callable[[], Result]) -> None:
        """Records the contact at a time [s], of the result that is made then, unless the last record is recent."""
        if self._times and time < self._times[-1] + self._every:
            return
        result = make()
        tool, landed = np.asarray(result.tool), np.asarray(result.contact_time, float)
        self._durations, self._tool = self.durations(result), tool
        self._times.append(time)
        self._shares.append(contact_shares(result, self._count))
        for number in np.unique(tool[tool >= 0]):
            first, _ = self._periods[number]
            self._periods[number] = np.fmin(first, landed[tool == number].min()), time

    def rows(self) -> Array:
        """Times and shares (1 + count, n), from 0 on, when nothing has been formed yet."""
        shares = np.array(self._shares).reshape(-1, self._count)
        rows = np.concatenate([np.array(self._times)[:, None], shares], axis=1)
        return np.concatenate([np.zeros((1, 1 + self._count)), rows]).T

    def periods(self) -> Array:
        """First and last time of contact of any node with each tool (count, 2) [s]; NaN without contact."""
        return self._periods

    def durations(self, result: Result) -> Array:
        """Times for which each node has touched each tool until a result (n_node, count) [s].

        The time at which a node left a tool is known only to lie between two records: half of that interval is counted.
        """
        time, since = float(result.time), self._times[-1] if self._times else 0.0
        tool, landed = np.asarray(result.tool), np.asarray(result.contact_time, float)
        more = len(tool) - len(self._tool)
        former = np.pad(self._tool, (0, more), constant_values=-1)
        durations = np.pad(self._durations, ((0, more), (0, 0)))
        begin = np.where(tool >= 0, np.clip(landed, since, time), time)
        left = np.flatnonzero((former >= 0) & ((tool != former) | (landed > since)))
        durations[left, former[left]] += 0.5 * (begin[left] - since)
        on = np.flatnonzero(tool >= 0)
        durations[on, tool[on]] += time - begin[on]
        return durations


def contact_durations(result: Result, count: int) -> Array | None:
    """Times for which each node has touched each of so many tools (n_node, count) [s]; None where it is not known.

    Nodes that stick have touched their tool since they came to it; of others the run keeps a record.
    """
    if result.contact_duration is not None:
        return result.contact_duration
    if result.slip is not None:
        return None
    landed = _from_start(np.asarray(result.contact_time, float))
    on = np.asarray(result.tool)[:, None] == np.arange(count)
    return np.where(on, float(result.time) - landed[:, None], 0.0)


def tool_label(tool: Mold) -> str:
    """The name of a tool; that of the mold is mold."""
    return tool.name or "mold"


def summarize_tools(result: Result, scene: Scene) -> list[dict[str, Any]]:
    """Figures of the mold and each tool, in the order of `Scene.surfaces`; their penetration is null here."""
    tools = [surface.mold for surface in scene.surfaces]
    shares, touched = contact_shares(result, len(tools)), touched_tools(result)
    energy = result.energy
    works = _energies_by_tool(energy.tool_work, energy.by_tool.work, [tool.motion is not None for tool in tools])
    frictions = _energies_by_tool(
        energy.friction_loss, energy.by_tool.friction, [tool.contact.has_friction for tool in tools]
    )
    return [
        {
            "name": tool_label(tool),
            "contact_fraction": float(shares[number]),
            **_contact_over_time(result, number, float(shares[number])),
            "thickness": wall_statistics(result, touched == number) if (touched == number).any() else None,
            "work": works[number],
            "friction_loss": frictions[number],
            "penetration_max": None,
            "penetration_place": None,
        }
        for number, tool in enumerate(tools)
    ]


def _contact_over_time(result: Result, number: int, share: float) -> dict[str, Any]:
    """Largest share of the formed area on a tool at any time, when something touches it, and since when it does."""
    landed = _from_start(np.asarray(result.contact_time, float)[np.asarray(result.tool) == number])
    times = [float(landed.min()), float(result.time)] if len(landed) else []
    most = share
    if result.contacts is not None and result.contact_periods is not None:
        most = max(most, float(result.contacts[1 + number].max(initial=0.0)))
        times += [time for time in _from_start(result.contact_periods[number]).tolist() if np.isfinite(time)]
    return {
        "contact_fraction_max": most,
        "contact_period": [min(times), max(times)] if times else None,
        "contact_time": {"min": float(landed.min()), "max": float(landed.max())} if len(landed) else None,
    }


def _from_start(time: Array) -> Array:
    """Times of contact (n,) [s], 0 of nodes in contact from the start, which the state marks by the least number."""
    return np.where(np.abs(time) <= np.finfo(np.float32).tiny, 0.0, time)


def _energies_by_tool(whole: jax.Array, split: Sequence[jax.Array], sources: list[bool]) -> list[float]:
    """An energy [J] of each tool: 0 of those that are no source; the parts of the sources, or of a single one all."""
    parts = iter(split or [whole])
    return [float(next(parts)) if source else 0.0 for source in sources]


def measure_tool_penetration(result: Result, scene: Scene, number: int) -> Penetration:
    """Penetration of the part into one of `Scene.surfaces`, at its final position."""
    if not np.isfinite(np.asarray(result.positions)).all():
        return Penetration(0.0, 0.0, np.zeros(3))
    compared, offset, grid = _compare_with_tool(result, scene, number)
    pull = None
    if scene.surfaces[number].mold is scene.mold:
        pull = pull_direction(np.asarray(scene.parison.positions, float), compared[1], scene.strongest_push())
    found = penetration(*compared, grid=grid, pull=pull)
    return found._replace(place=found.place + offset, ribs=found.ribs._replace(place=found.ribs.place + offset))


def measure_cuts(result: Result, scene: Scene) -> tuple[Array, Array]:
    """Depths (n_tool, n_element) [m] of elements in each of `Scene.surfaces`, at its final position.

    Also the shares (n_tool, n_element, 3) of the elements' corners at the deepest places.
    """
    count = len(scene.surfaces), len(result.element_thickness)
    depth, share = np.zeros(count), np.full((*count, 3), 1.0 / 3.0)
    if np.isfinite(np.asarray(result.positions)).all():
        element = np.flatnonzero(result.used)
        for number in range(len(scene.surfaces)):
            compared, _, grid = _compare_with_tool(result, scene, number)
            depth[number, element], share[number, element] = element_depths(*compared, grid=grid)
    return depth, share


def _compare_with_tool(
    result: Result, scene: Scene, number: int
) -> tuple[tuple[Array, Any, Any, Mold, Array], Array, SearchGrid]:
    """The first arguments of `penetration`, of the part and one of `Scene.surfaces`, in whose frame the nodes are.

    Also the displacement (3,) [m] of that frame, and the tool's search structure.
    """
    tool, grid, _ = scene.surfaces[number]
    positions, triangles = np.asarray(result.positions, float), np.asarray(result.triangles)[np.asarray(result.used)]
    offset = tool.offset_at(float(result.time))
    resting = np.zeros_like(positions)
    if tool is scene.mold:
        wall = np.asarray(result.wall)
        start = np.asarray(scene.parison.positions, float)
        resting = resting_directions(start, positions, triangles, scene.strongest_push())
    else:
        wall = np.where(np.asarray(result.tool) == number, np.asarray(result.tool_wall), 0)
    return (positions - offset, triangles, wall, tool, resting), offset, grid
