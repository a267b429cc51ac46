"""The command: `jaxform scenes | simulate | optimize | check`. The one room that knows both jaxform and optimize.

Exit status: 0 done; 2 bad input, with one line on standard error; 3 the simulation stopped early, with what was
computed written, or a search keeps not all limits; 130 interrupted. Heavy imports wait until a command needs them.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from jaxform import catalog
from jaxform.errors import InputError
from jaxform.writing import PREFIX

if TYPE_CHECKING:
    from concurrent.futures import Future

    from jaxform.files import SceneDocument
    from jaxform.result import Result
    from jaxform.scene import Scene
    from jaxform.store import Store

DONE, BAD_INPUT, STOPPED, INTERRUPTED = 0, 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command, that of the process where no arguments are given, and returns its exit status."""
    # What is imported stays: to look for garbage in it takes a tenth of a short run. `_prepare` turns it on again.
    gc.disable()
    try:
        arguments = _parser().parse_args(argv)
        return arguments.command(arguments)
    except InputError as error:
        print(f"jaxform: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("jaxform: interrupted", file=sys.stderr)
        return INTERRUPTED
    finally:
        if argv is None:
            # The process ends: to look through all that is left for garbage takes a quarter of a second.
            gc.freeze()
        else:
            # For a caller that goes on, wherever the command ended.
            gc.unfreeze()
        gc.enable()


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see `{self.prog} --help`")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxform", description="Blow moulding and thermoforming, simulated and designed.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    scenes = commands.add_parser("scenes", help="list the built-in scenes and studies")
    scenes.set_defaults(command=_scenes)
    for name, command, what, words in (
        ("simulate", _simulate, "SCENE", "simulate a scene"),
        ("optimize", _optimize, "STUDY", "search for the best design of a study"),
        ("check", _check, "SCENE", "validate a scene, say what will be simulated, run no step"),
    ):
        sub = commands.add_parser(name, help=words, description=words)
        sub.add_argument("source", metavar=what, help="a built-in name or a .toml file")
        sub.add_argument("--quiet", action="store_true", help="print errors only")
        sub.add_argument("--dtype", choices=("float64", "float32"), default="float64")
        if name != "check":
            sub.add_argument("--out", metavar="DIR", required=True, type=Path, help="where the results go")
            sub.add_argument("--force", action="store_true", help="overwrite results in DIR")
        if name == "optimize":
            words = "go on with the search in DIR where it was killed, or with more iterations where it had ended"
            sub.add_argument("--resume", action="store_true", help=words)
        sub.set_defaults(command=command)
    return parser


def _scenes(_: argparse.Namespace) -> int:
    uses: dict[catalog.Kind, str] = {"scene": "simulate", "study": "optimize"}
    for kind, use in uses.items():
        for name, words in catalog.descriptions(kind).items():
            _say(f"{name:20} {kind:6} jaxform {use} {name:18}  {words}")
    return DONE


def _say(words: str) -> None:
    """Prints a line for people; where nobody reads it any more, the work goes on in silence."""
    try:
        print(words, flush=True)
    except BrokenPipeError:
        # All that is still to come goes nowhere, what Python flushes at the end included.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _prepare(arguments: argparse.Namespace) -> tuple[Callable[[str], None], Store]:
    """Sets the precision and what is kept between runs; returns what prints for people, and the store."""
    import warnings

    import jax

    from jaxform.store import Store

    # Asked for on the command line, so the reminder that Python users get is not needed.
    warnings.filterwarnings("ignore", message="jaxform computes in float32")
    # Told in one line, from the summary.
    warnings.filterwarnings("ignore", message="jaxform: this is no slow process")
    jax.config.update("jax_enable_x64", arguments.dtype == "float64")
    # Lines of source in the programs help nobody here; without them they are a tenth smaller and sooner read back.
    jax.config.update("jax_traceback_in_locations_limit", 0)
    folder = _cache_folder()
    if folder is not None:
        _use_compile_cache(folder / "compiled")
    store = Store(None if folder is None else folder / "made")
    gc.freeze()
    gc.enable()
    return (lambda _: None) if arguments.quiet else _say, store


def _cache_folder() -> Path | None:
    """In the user's cache folder; None where that cannot be written."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxform"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder


def _use_compile_cache(folder: Path) -> None:
    """Keeps compiled programs between runs, in a folder or where the environment says."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(folder))
    # Many small programs together take longer than one large one.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _open_folder(folder: Path, force: bool) -> None:
    """Makes the output folder, or refuses before anything is computed."""
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file", "name a folder", "--out", str(folder))
    try:
        # What was killed while it wrote may have left a file that is no result.
        results = (file for file in folder.iterdir() if not file.name.startswith(PREFIX)) if folder.exists() else ()
        if any(results) and not force:
            raise InputError("exists and is not empty", "choose another folder or give --force", "--out", str(folder))
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f"{PREFIX}writes"
        probe.touch()
        probe.unlink()
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        raise InputError(problem, "choose another folder", "--out", str(folder)) from None


@contextlib.contextmanager
def _progress(show: bool, words: str) -> Iterator[Callable[[float, str], None] | None]:
    """A bar on a terminal, nothing in a pipe: what it gives takes the fraction done and a few words, or is None."""
    if not (show and sys.stderr.isatty()):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(words, total=1.0, note="compiling")
        yield lambda fraction, note: progress.update(task, completed=fraction, note=note)


def _simulate(arguments: argparse.Namespace) -> int:
    say, store = _prepare(arguments)
    from jaxform import files
    from jaxform.output import Frames

    document = files.read_scene(arguments.source)
    reference = files.read_reference(document)
    scene = files.build(document, store)
    _open_folder(arguments.out, arguments.force)
    frames = Frames(arguments.out, document.model.output.frames)
    with _meanwhile(_warm_up):
        result = _run(scene, frames, not arguments.quiet, store)
    summary = _write_part(arguments.out, scene, result, reference)
    frames.finish(scene, result)
    _tell(say, summary, arguments.out)
    _warn(summary)
    return _exit_status(result)


def _warm_up() -> None:
    """What writing the results needs."""
    import meshio  # noqa: F401
    import scipy.spatial  # noqa: F401

    from jaxform import plots

    plots.warm_up()


@contextlib.contextmanager
def _meanwhile[T](work: Callable[[], T]) -> Iterator[Future[T]]:
    """Does something on another thread; much of a run, and of writing, is spent outside of Python."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(work)


def _run(scene: Scene, frames: Any, show: bool, store: Store) -> Result:
    """Runs a scene with a bar and frames where they are wanted; Ctrl-C keeps what was computed."""
    from jaxform.simulation import Moment, run

    interrupted = False

    with _progress(show, scene.name) as bar:

        def on_window(moment: Moment) -> bool:
            nonlocal interrupted
            try:
                if bar is not None:
                    bar(moment.time / moment.end_time, f"{moment.steps} steps")
                frames.offer(scene, moment)
            except KeyboardInterrupt:
                interrupted = True
            return interrupted

        watched = bar is not None or frames.count > 0
        return run(scene, on_window=on_window if watched else None, store=store)


def _write_part(
    folder: Path,
    scene: Scene,
    result: Result,
    reference: dict[str, Any] | None,
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    from jaxform import output, plots

    with _meanwhile(lambda: output.write_result(scene, result, folder, amend)) as summary:
        plots.thickness_picture(folder / "thickness.png", scene, result, reference)
    return summary.result()


def _warn(summary: dict[str, Any]) -> None:
    for sentence in summary["warnings"]:
        _warn_of(sentence)


def _warn_of(sentence: str) -> None:
    """On standard error, --quiet or not."""
    print(f"jaxform: warning: {sentence}", file=sys.stderr)


def _exit_status(result: Result) -> int:
    from jaxform.result import explain

    if int(result.status):
        print(f"jaxform: {explain(result)}", file=sys.stderr)
        return STOPPED
    return DONE


def _tell(say: Callable[[str], None], summary: dict[str, Any], folder: Path) -> None:
    wall = {key: 1e3 * summary["thickness"][key] for key in ("min", "mean", "max")}
    say(
        f"{summary['scene']}: {summary['elements_final']} elements, {summary['steps']} steps in "
        f"{summary['run_seconds']:.2f} s (compiled in {summary['compile_seconds']:.1f} s)"
    )
    say(
        f"wall {wall['min']:.4g} to {wall['max']:.4g} mm, mean {wall['mean']:.4g} mm, variation "
        f"{100 * summary['thickness']['cv']:.3g} %; {100 * summary['contact_fraction']:.3g} % touches the mold; "
        f"energy balance within {100 * summary['energy']['balance_error']:.2g} %"
    )
    if summary["penetration_max"] > summary["thickness"]["mean"]:
        place = ", ".join(f"{value:.4g}" for value in summary["penetration_place"])
        say(
            f"an element cuts an edge of the mold, {1e3 * summary['penetration_max']:.3g} mm deep at ({place}) m: "
            "smaller elements would follow it"
        )
    say(f"status: {summary['status']}; results in {folder}")


def _check(arguments: argparse.Namespace) -> int:
    say, store = _prepare(arguments)
    from jaxform import files

    document = files.read_scene(arguments.source)
    files.read_reference(document)
    scene = files.build(document, store)
    for line in _plan(document, scene):
        say(line)
    return DONE


def _plan(document: SceneDocument, scene: Scene) -> Iterator[str]:
    """What will be simulated and what is skipped, line by line."""
    import jax

    from jaxform.body import body
    from jaxform.result import SLOW_ENOUGH
    from jaxform.scene import SHORT_WINDOW
    from jaxform.state import initial_state
    from jaxform.timestep import choose_step
    from jaxform.working import worked_through

    def first_step(scene: Scene) -> jax.Array:
        state = initial_state(scene)
        working = worked_through(state, scene, body(scene))
        return choose_step(working.taken(state), scene, working)[0]

    step = float(jax.jit(first_step)(scene))
    parison, law = scene.parison, document.model.material.model
    forest, refinement = scene.tables.forest, scene.refinement
    yield f"{scene.name}: {len(parison.triangles)} elements, {scene.first_nodes} nodes, {law}"
    if forest is not None and refinement is not None:
        yield (
            f"refined up to level {refinement.deepest} of {forest.depth}, looked at every {refinement.interval} steps: "
            f"{forest.bound.size} triangles bisected beforehand, room for {refinement.elements} elements at once"
        )
    longest = scene.tables.longest_window
    steps = f"{SHORT_WINDOW} to {longest}" if longest > SHORT_WINDOW else f"{SHORT_WINDOW}"
    yield (
        f"to {float(scene.solver.end_time):.4g} s, first step {step:.3g} s, at most "
        f"{scene.tables.window_count} windows of {steps} steps"
    )
    if scene.solver.quasi_static:
        yield f"meant to be slow: it is warned of if the wall is more than {100 * SLOW_ENOUGH:.2g} % off for haste"
    if scene.mold is not None:
        dropped = f" ({scene.mold.dropped} degenerate or duplicate ones left out)" if scene.mold.dropped else ""
        yield f"mold: {len(scene.mold.triangles)} triangles{dropped}"
    skipped = {
        "contact (no mold)": scene.mold is None,
        "damping (none given)": scene.solver.damping is None,
        "the second invariant (the law has none)": law == "neo-hookean",
        "refinement (none given)": scene.refinement is None,
        "frames (none wanted)": document.model.output.frames == 0,
    }
    yield "skipped: " + ", ".join(what for what, skip in skipped.items() if skip)


def _optimize(arguments: argparse.Namespace) -> int:
    from jaxform import designing

    return designing.optimize_study(arguments)


if __name__ == "__main__":
    sys.exit(main())
