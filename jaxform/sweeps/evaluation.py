"""The work for a design: its scene is built, simulated and measured, and its files are packed.

A worker need not see the folder of the results: the files come back with the numbers, and whoever started the sweep
writes both.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import math
import os
import pickle
import platform
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from jaxform.core import disk
from jaxform.core.compilation import keep_programs, share_programs_in
from jaxform.core.errors import InputWarning, redirect_warnings
from jaxform.core.store import Store
from jaxform.io import files, output, scene_rewriting
from jaxform.io.files import SceneDocument
from jaxform.io.report import write_report
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.results.summary import explain, summarize
from jaxform.runs.host import IN_MEMORY, compile_for, run
from jaxform.sweeps.workers import Outcome

_MISS = "/jax/compilation_cache/cache_misses"


@dataclass(frozen=True)
class Setting:
    """Settings of workers.

    Attributes:
        dtype: Precision, "float64" or "float32".
        cache: Folder for programs and search grids; None for the user's cache folder on the worker's machine.
        client: The process that began the sweep, as `this_process` names it.
    """

    dtype: str = "float64"
    cache: str | None = None
    client: str = ""


def worker_setting(shared: bool = True) -> Setting:
    """The settings by which workers compute as this process does; with its cache, or each with that of its machine."""
    folder = disk.user_cache_folder() if shared else None
    precision = "float64" if jax.config.read("jax_enable_x64") else "float32"
    return Setting(precision, None if folder is None else str(folder), this_process())


Worker = tuple[Store, Path | None]
"""Search grids and programs that a machine's workers share, and their folder; None where there is none."""


@functools.cache
def set_up(setting: Setting) -> Worker:
    """Sets the precision and the cache of a worker process, once; threads of the process that began are left alone."""
    if setting.client == this_process():
        return IN_MEMORY, None
    warnings.filterwarnings("ignore", message="jaxform computes in float32")
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    jax.config.update("jax_enable_x64", setting.dtype == "float64")
    jax.config.update("jax_traceback_in_locations_limit", 0)
    jax.monitoring.register_event_listener(_count)
    folder = disk.user_cache_folder() if setting.cache is None else Path(setting.cache)
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        keep_programs()
    elif folder is not None:
        (folder / disk.COMPILED).mkdir(parents=True, exist_ok=True)
        share_programs_in(folder / disk.COMPILED)
    # That of `jaxform.run` itself, so that functions of users find its programs, too.
    IN_MEMORY.folder, IN_MEMORY.shared = None if folder is None else folder / disk.MADE, True
    with disk.exclusive(folder):
        IN_MEMORY.is_noted("first design", ())  # its name depends on what XLA knows, for which a program is compiled
    return IN_MEMORY, folder


def this_process() -> str:
    """A name of this process that no other process of a cluster has."""
    return f"{platform.node()} {os.getpid()} {_BEGAN}"


_BEGAN = time.time_ns()
_compiled = [0]


def count_compiled() -> int:
    """Number of programs that this process has compiled because no cache had them."""
    return _compiled[0]


def _count(event: str, **_: Any) -> None:
    _compiled[0] += event == _MISS


_LEFT_OUT = {"parison": ("thickness", "temperature", "radius", "size"), "refinement": ()}


def _kind(document: SceneDocument) -> str:
    """The kind of a document's scene, on which the small programs that build and measure it depend, and its mesh."""
    data, shared = document.data, document.mesh_of
    tables = {
        name: {key: value for key, value in data.get(name, {}).items() if key not in left}
        for name, left in _LEFT_OUT.items()
    }
    mesh = [] if shared is None else [shared.data]
    return json.dumps([tables, sorted(data), data["material"].get("model"), *mesh], sort_keys=True, default=str)


@contextlib.contextmanager
def compile_once(worker: Worker, *kind: str) -> Iterator[None]:
    """The first design of a kind is computed by one of a machine's workers alone: the others find its programs."""
    store, folder = worker
    known = functools.partial(store.is_noted, "first design", kind)
    with contextlib.ExitStack() as lock:
        if not known():
            lock.enter_context(disk.exclusive(folder))
            if known():
                lock.close()
        yield
        if not known():
            store.note("first design", kind)


def _make_programs(scene: Scene, store: Store) -> float:
    """Compiles or loads the programs of a scene; returns how long that took [s]."""
    began = time.perf_counter()
    compile_for(scene, store)
    return time.perf_counter() - began


def simulate_design(task: tuple[SceneDocument, Setting]) -> Outcome:
    """The part of a scene document: its numbers and files, and its status in words.

    The outcome's value is the columns of the design's row, its files as a ZIP archive, and the number of programs that
    were compiled for it.

    Raises:
        InputError: The scene cannot be simulated.
    """
    document, setting = task
    before = count_compiled()
    worker = store, _ = set_up(setting)
    warned: list[str] = []
    with compile_once(worker, _kind(document)), tell_warnings(warned.append):
        began = time.perf_counter()
        scene = files.build(document, store)
        began += _make_programs(scene, store)
        with tempfile.TemporaryDirectory(prefix="jaxform-") as name:
            folder = Path(name)
            frames = output.Frames(folder, document.model.output.frames)
            frames.begin(scene)
            offer = (lambda moment: frames.offer(scene, moment)) if frames.count else None
            result = run(scene, on_window=offer, store=store)
            summary = output.write_result(scene, result, folder, list(dict.fromkeys(warned)))
            frames.finish(scene, result)
            scene_rewriting.keep_scene(document, folder)
            archive = pack(folder)
    measures = measures_of(summary) | {"seconds": time.perf_counter() - began}
    return Outcome(summary["status"], (measures, archive, count_compiled() - before))


@contextlib.contextmanager
def tell_warnings(tell: Callable[[str], object]) -> Iterator[None]:
    """Passes warnings about a scene to a function; warnings of its run are in its summary and are not shown."""
    with warnings.catch_warnings(), redirect_warnings(tell):
        warnings.simplefilter("ignore", InputWarning)
        yield


def pack(folder: Path) -> bytes:
    """The files of a folder as a ZIP archive, with a report of them where one can be made."""
    with contextlib.suppress(ValueError):
        write_report(folder)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder).as_posix())
    return content.getvalue()


def measures_of(summary: dict[str, Any]) -> dict[str, Any]:
    """The columns of a row from the contents of summary.json; None for what is not known."""
    wall = summary["thickness"]
    found = {
        "wall_min": wall["min"],
        "wall_mean": wall["mean"],
        "wall_cv": wall["cv"],
        "mass": summary["mass"],
        "flash_mass": summary.get("flash_mass"),
        "contact_fraction": summary["contact_fraction"],
        "gap_max": summary["gap_max"],
        "warnings": len(summary["warnings"]),
    }
    return {name: value if value is None or math.isfinite(value) else None for name, value in found.items()}


def pack_scene(scene: Scene) -> Scene | bytes:
    """A scene as bytes: a worker must set its precision before it reads them. As it is where it cannot be packed."""
    try:
        return pickle.dumps(scene)
    except (pickle.PicklingError, AttributeError, TypeError):
        return scene  # threads of this process can do without


def call_function(task: tuple[Callable[[Scene], Any], Scene | SceneDocument | bytes, Setting]) -> Any:
    """The value of a user's function of a scene, which is built here where it comes as a document."""
    function, given, setting = task
    worker = store, _ = set_up(setting)
    if isinstance(given, bytes):
        given = pickle.loads(given)
    name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', repr(function))}"
    kind = _kind(given) if isinstance(given, SceneDocument) else ""
    with compile_once(worker, name, kind):
        scene = files.build(given, store) if isinstance(given, SceneDocument) else given
        return function(scene)


def measure(scene: Scene) -> Outcome:
    """The numbers of a row of results, of a scene that is simulated by `jaxform.run`; what `jaxform.sweep` computes."""
    result: Result = run(scene)
    return Outcome(explain(result), measures_of(summarize(result, scene)))
