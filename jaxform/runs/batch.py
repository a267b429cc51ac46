"""`simulate_batch`: many designs of a scene."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.promotion import device_context, with_standard_promotion
from jaxform.core.ranges import as_numbers
from jaxform.kernels.blocks import on_cpu
from jaxform.model.replacement import replace
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.runs.loop import IN_MEMORY, whole_run
from jaxform.runs.padding import pad_to_bucket


@with_standard_promotion
def simulate_batch(scene: Scene, changes: Mapping[str, ArrayLike], *, workers: int | None = None) -> Result:
    """Simulates many designs of a scene: the results stacked, a design per row of every array.

    On the CPU the designs are shared out over threads, one after another on each, which is several times faster than
    one program for all of them; on other devices they run side by side. Not differentiable: map `simulate` for that.

    Args:
        scene: The scene.
        changes: New values at dotted paths, as `replace` takes them, with a row for each design (n_design, ...).
        workers: Number of threads; one per core by default.

    Raises:
        InputError: If a path or a row does not fit the scene, or the numbers of rows differ.
    """
    rows = _rows(changes)
    if workers is not None and not (isinstance(workers, int) and workers > 0):
        raise InputError("must be a positive whole number", "leave it out for one per core", "workers", workers)
    with device_context(scene.parison.positions) as placed:
        return placed(_results(scene, rows, workers))


def _results(scene: Scene, rows: dict[str, np.ndarray], workers: int | None) -> Result:
    """Results of the designs, stacked."""
    designs = [replace(scene, {path: values[k] for path, values in rows.items()}) for k in range(_row_count(rows))]
    if not on_cpu():
        return _simulate_designs(scene, {path: jnp.asarray(values) for path, values in rows.items()})
    rooms = [pad_to_bucket(design, recorded=True) for design in designs]
    whole = IN_MEMORY.program(whole_run, rooms[0].scene)
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        results = list(pool.map(lambda room: room.result(whole(room.scene)), rooms))
    return jax.tree.map(lambda *values: jnp.asarray(np.stack(values)), *results)


def _rows(changes: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """The changes, as arrays with a row for each design."""
    if not isinstance(changes, Mapping):
        raise InputError("is no mapping of paths to rows of values", "stack a row per design", "changes", changes)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(dict(changes))):
        raise InputError("is traced, but a batch is not differentiable", "map `simulate` for that", "changes")
    return {str(path): as_numbers(str(path), values) for path, values in changes.items()}


def _row_count(rows: Mapping[str, np.ndarray]) -> int:
    counts = {path: len(values) if values.ndim else 0 for path, values in rows.items()}
    if not rows or min(counts.values()) == 0 or len(set(counts.values())) > 1:
        raise InputError("needs as many rows for one path as for another", "stack a row per design", "changes", counts)
    return next(iter(counts.values()))


@jax.jit
def _simulate_designs(scene: Scene, rows: dict[str, jax.Array]) -> Result:
    """All designs in one program, which serves every batch of as many designs of such a scene."""
    return jax.vmap(lambda row: whole_run(replace(scene, row)))(rows)
