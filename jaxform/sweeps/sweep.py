"""`sweep`: a function of many scenes, on many processes or machines."""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxform.core.errors import InputError
from jaxform.core.installation import usable_cores
from jaxform.model.scene import Scene
from jaxform.sweeps.designs import SCENE, DesignRow, Rows, make_designs, parse_path
from jaxform.sweeps.evaluation import call_function, measure, pack_scene, worker_setting
from jaxform.sweeps.records import MEASURES, Records, cell_value, head, number
from jaxform.sweeps.workers import DaskWorkers, LocalWorkers, Outcome, evaluate

_DESIGNS = "designs"


def sweep(
    scenes_or_designs: Iterable[Scene | str | Path | Mapping[str, Any]],
    function: Callable[[Scene], Any] = measure,
    *,
    scene: str | Path | None = None,
    executor: Any = None,
    workers: int | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    on_outcome: Callable[[int, Outcome], object] = lambda place, outcome: None,
) -> list[Outcome]:
    """Computes a function of many scenes, by default on a process per core of this machine.

    What fails for one scene, its process included, is the status of its outcome; the others go on. A process that ends
    is replaced, and its scene tried once more. Results do not depend on how many workers there are, to the last bit.

    Args:
        scenes_or_designs: Scenes; names or files of scenes; or designs: mappings of paths of a scene file, such as
            {"mold.depth": 0.06, "pressure.value[1]": 2.0e4}, to values. Those but the first are built by the workers.
        function: Function of a scene. It must be importable by other processes: defined in a module, or in a script
            whose own work is behind `if __name__ == "__main__":`. By default the columns of `jaxform sweep`.
        scene: Name or file of the scene that designs change.
        executor: A `concurrent.futures` executor, or a Dask `Client`; it stays open.
        workers: Number of processes where no executor is given.
        out: Folder for results.csv, to which a row is added as each outcome arrives; none by default. The function
            then returns a mapping of names to numbers, or a number.
        resume: True if outcomes that the table in that folder has are read, not computed again: of the same values,
            scene and function, by its name.
        on_outcome: Called with the place and the outcome of each, as they arrive.

    Returns:
        The outcomes, in the order of the scenes. Of those that were read a value is a mapping.

    Raises:
        InputError: There is nothing to compute, the function or a scene cannot be sent to another process, or the
            executor is broken.
    """
    given = list(scenes_or_designs)
    if not given:
        raise InputError("is empty", "give scenes, names of scenes, or designs", "scenes_or_designs")
    _check_function(function, executor)
    designs = _designs(given, scene, _name(function))
    outcomes: dict[int, Outcome] = {}
    record = None if out is None else _Recorder(Path(out), designs, MEASURES if function is measure else (), resume)

    def finish(place: int, outcome: Outcome, known: bool = False) -> None:
        outcomes[place] = outcome
        if record is not None and not known:
            record.add(designs[place], outcome)
        on_outcome(place, outcome)

    for place, design in enumerate(designs):
        if record is not None and (kept := record.outcome(design)) is not None:
            finish(place, kept, known=True)
        elif design.error:
            finish(place, Outcome(design.error))
    left = [place for place in range(len(designs)) if place not in outcomes]
    if left:
        pool, own = _pool(executor, workers, len(left))
        setting = worker_setting(shared=own)
        arguments = [(function, _worker_message(designs[place], given[place]), setting) for place in left]
        try:
            for place, outcome in evaluate(call_function, arguments, pool):
                finish(left[place], outcome)
        finally:
            if own:
                pool.shutdown(wait=False, cancel_futures=True)
    if record is not None:
        record.finish(designs)
    return [outcomes[place] for place in range(len(designs))]


def _designs(given: Sequence[Any], scene: str | Path | None, about: str) -> list[DesignRow]:
    """A design for each of what is given; that of a scene has no document, and no error either."""
    about = f"{about} {_precision()}"
    rows: list[dict[str, Any]] = []
    for place, one in enumerate(given):
        if isinstance(one, Mapping):
            rows.append({str(path): value for path, value in one.items()})
        elif isinstance(one, str | Path):
            rows.append({SCENE: str(one)})
        elif not isinstance(one, Scene):
            remedy = "give a scene, the name of one, or a mapping of paths to values"
            raise InputError("is neither a scene nor a design", remedy, f"scenes_or_designs[{place}]", one)
    for path in {path for row in rows for path in row}:
        parse_path(path)
    table = Rows(_DESIGNS, Path.cwd(), list(dict.fromkeys(path for row in rows for path in row)), rows)
    made = iter(make_designs(table, scene, about=about))
    return [
        DesignRow(place, {}, None, "", _scene_digest(one, about))
        if isinstance(one, Scene)
        else dataclasses.replace(next(made), number=place)
        for place, one in enumerate(given, 1)
    ]


def _worker_message(design: DesignRow, given: Any) -> Any:
    """The message to a worker for a design: its document, or the scene that was given."""
    return pack_scene(given) if design.document is None else design.document


def _scene_digest(scene: Scene, about: str) -> str:
    digest = hashlib.sha256(about.encode())
    for leaf in jax.tree.leaves(scene):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def _precision() -> str:
    return "float64" if jax.config.read("jax_enable_x64") else "float32"


def _pool(executor: Any, workers: int | None, count: int) -> tuple[Executor, bool]:
    """The executor, and whether it is this module's own."""
    if executor is None:
        if workers is not None and not (isinstance(workers, int) and workers > 0):
            raise InputError("must be a positive whole number", "leave it out for one per core", "workers", workers)
        return LocalWorkers(workers or max(1, min(usable_cores(), count))), True
    if isinstance(executor, Executor):
        return executor, False
    if hasattr(executor, "scheduler_info"):
        return DaskWorkers(executor), False
    remedy = "give a concurrent.futures executor or a Dask client, or leave it out"
    raise InputError("is not an executor", remedy, "executor", executor)


def _name(function: Callable[..., Any]) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', repr(function))}"


def _check_function(function: Any, executor: Any) -> None:
    """Raises for a function that other processes cannot import; executors of others may have ways of their own."""
    if not callable(function):
        raise InputError("is not a function", "give a function of a scene", "function", function)
    if executor is not None:
        return
    main = sys.modules["__main__"]
    interactive = getattr(function, "__module__", "") == "__main__" and not hasattr(main, "__file__")
    try:
        pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError):
        interactive = True
    if interactive:
        remedy = "define it with `def` in a module beside the notebook or script, and import it"
        raise InputError("cannot be sent to another process", remedy, "function", function)


class _Recorder:
    """The table of a sweep from Python."""

    def __init__(self, folder: Path, designs: Sequence[DesignRow], names: Iterable[str], resume: bool) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        paths = list(dict.fromkeys(path for design in designs for path in design.values))
        self._records = Records(folder, paths, names, resume)
        self._records.keep_only({design.digest: head(design) for design in designs})

    def outcome(self, design: DesignRow) -> Outcome | None:
        """The outcome that is recorded of a design; None where none is."""
        if design.digest not in self._records.rows:
            return None
        row, found = self._records.rows[design.digest], self._records.measures(design.digest)
        seconds = number(found.pop("seconds", "")) or 0.0
        value = {name: cell_value(text) for name, text in found.items() if text}
        return Outcome(row["status"], value or None, seconds)

    def add(self, design: DesignRow, outcome: Outcome) -> None:
        """Records an outcome."""
        if design.digest in self._records.rows:
            return
        value = outcome.value if isinstance(outcome.value, Mapping) else {"value": outcome.value}
        value = {str(name): _plain(one) for name, one in value.items() if one is not None}
        said = {"status": outcome.status, "digest": design.digest}
        self._records.append(head(design) | value | {"seconds": outcome.seconds} | said)

    def finish(self, designs: Sequence[DesignRow]) -> None:
        """Puts the rows into the order of the designs."""
        self._records.finish((design.digest, head(design)) for design in designs)


def _plain(value: Any) -> Any:
    """A value as a table has it: arrays as lists."""
    return np.asarray(value).tolist() if isinstance(value, np.ndarray | np.generic | jax.Array) else value
