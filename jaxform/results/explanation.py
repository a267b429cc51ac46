"""The status of a run in words."""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxform.core.errors import InputError
from jaxform.core.formatting import format_place
from jaxform.model.replacement import describe_out_of_range
from jaxform.results.result import Result
from jaxform.sheet.state import Status

_WORDS = {
    Status.NON_FINITE: "a position or velocity is not finite; the state before that window is kept",
    Status.UNSTABLE: "unstable: the sheet holds more energy than was put in, or less",
    Status.WINDOWS_EXHAUSTED: "the limit on steps was reached before the end time",
    Status.CONTACT_OVERFLOW: "more candidate pairs of node and mold triangle were found than the capacity holds",
    Status.CONTACT_MISSED: "a node moved so far in one step that it may have missed the mold",
    Status.STOPPED: "stopped by the caller",
    Status.REFINEMENT_OVERFLOW: "refinement asked for more elements or nodes than the capacity holds",
    Status.RUNAWAY: "the sheet ran away: it is ten thousand times its initial size",
    Status.ESCAPED: "the sheet left its mold: it is as far outside the box of sheet and mold as the box is long",
    Status.BURST: "the sheet passed through itself and burst: a sheet's contact with itself is not simulated",
    Status.INPUT: "a parameter of the scene is out of its range, so nothing was simulated",
    Status.UNBALANCED: "the run reached its end, but its energy balance misses more than 1 % of the work",
    Status.UNFILLED: "the mold is not filled",
}
_REMEDIES = {
    Status.NON_FINITE: "lower solver.safety or the pressure",
    Status.UNSTABLE: "lower solver.safety, or raise the pressure more slowly",
    Status.WINDOWS_EXHAUSTED: "raise solver.max_steps or lower the pressure; `jaxform.simulate`, which plans its steps "
    "beforehand, needs a scene that is built with the end time and material that it simulates, `jaxform.run` does not",
    Status.CONTACT_OVERFLOW: "coarsen the mold, or use `jaxform.run`, which enlarges the capacity by itself",
    Status.CONTACT_MISSED: "lower solver.safety or the pressure",
    Status.REFINEMENT_OVERFLOW: "raise refinement.elements, or lower refinement.max_level",
    Status.RUNAWAY: "lower the pressure below what the sheet bears, or put it in a mold",
    Status.ESCAPED: "look at sheet and mold with `jaxform check` (units, sides, holes), or lower the pressure",
    Status.BURST: "lower the pressure, or widen what is narrow in the mold",
    Status.INPUT: "keep what is designed within its range, and free of NaN",
    Status.UNBALANCED: "lower solver.safety, raise solver.damping, or raise the pressure more slowly",
    Status.UNFILLED: "raise pressure.value or solver.end_time, or say mold.fill = false where the mold is not to be "
    "filled",
}


def explain(result: Result) -> Any:
    """The status in words: "ok", or what stopped the run, when and where, and what may help.

    Of results side by side (from `vmap` or `simulate_batch`) a list with a sentence for each.

    Raises:
        InputError: If it is no result, or one that is traced.
    """
    if not isinstance(result, Result):
        raise InputError("is no result", "give what `simulate`, `run` or `simulate_batch` returns", "result", result)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(result)):
        raise InputError("is traced, its numbers are not known yet", "explain it outside of the function", "result")
    count = np.shape(result.status)
    if not count:
        return _describe_status(result)
    # Each leaf is brought to the host once; what the host's loop adds is no array.
    leaves = jax.tree.map(np.asarray, dataclasses.replace(result, schedule=None, seconds=None, filling=None))
    return [explain(jax.tree.map(operator.itemgetter(k), leaves)) for k in range(count[0])]


def _describe_status(result: Result) -> str:
    status = int(result.status)
    if status == 0:
        return "ok"
    what = [
        words + (_describe_gap(result) if bit == Status.UNFILLED else "")
        for bit, words in _WORDS.items()
        if status & bit
    ]
    remedy = [words for bit, words in _REMEDIES.items() if status & bit]
    if status & Status.INPUT:
        return "; ".join([f"{what[0]}: {describe_out_of_range(np.asarray(result.out_of_range))}", *what[1:], *remedy])
    if status == Status.UNFILLED:
        return "; ".join([*what, *remedy])
    speed = np.linalg.norm(np.asarray(result.velocities), axis=1)
    node = int(np.argmax(speed))
    at = ", ".join(f"{value:.4g}" for value in np.asarray(result.positions)[node])
    where = f"at t = {float(result.time):.6g} s, fastest node {node} at ({at}) m with {speed[node]:.3g} m/s"
    return "; ".join([*what, where, *remedy])


def _describe_gap(result: Result) -> str:
    """Description of the gap that is left open: its width, place, and share of the depth; empty if not measured."""
    if result.filling is None:
        return ""
    left, depth = result.filling.left, result.filling.depth
    share = f"{100 * left.width / depth:.0f} % of the opening's depth of {depth:.3g} m"
    return f": {left.width:.3g} m are left at {format_place(left.place)}, {share}"
