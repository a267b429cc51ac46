"""The command: `jaxform scenes | simulate | optimize | check | warm`. It alone knows both jaxform and optimize.

Exit status: 0 done; 2 bad input, with one line on standard error; 3 the simulation stopped early, with what was
computed written, or a search keeps not all limits; 130 interrupted. Heavy imports wait until a command needs them.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from jaxform import cachefolder, catalog, disk, lastresort
from jaxform.errors import InputError, heard
from jaxform.writing import PREFIX

if TYPE_CHECKING:
    from concurrent.futures import Future

    from jaxform.result import Result
    from jaxform.scene import Scene
    from jaxform.store import Store

DONE, BAD_INPUT, STOPPED, INTERRUPTED = 0, 2, 3, 130
_guard = contextlib.ExitStack()  # of the compiled programs, while a command uses them


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command, that of the process where no arguments are given, and returns its exit status."""
    # What is imported stays: to look for garbage in it takes a tenth of a short run. `_prepare` turns it on again.
    gc.disable()
    try:
        arguments = _parser().parse_args(argv)
        with heard(_warn) as arguments.warned:
            return arguments.command(arguments)
    except InputError as error:
        _complain(str(error))
        return BAD_INPUT
    except KeyboardInterrupt:
        _complain("interrupted")
        return INTERRUPTED
    except (OSError, MemoryError, RuntimeError) as error:
        words = lastresort.in_words(error)
        if words is None:
            raise
        _complain(words)
        return BAD_INPUT
    finally:
        _guard.close()
        if argv is None:
            # The process ends: to look through all that is left for garbage takes a quarter of a second.
            gc.freeze()
        else:
            # For a caller that goes on, wherever the command ended.
            gc.unfreeze()
        gc.enable()


def _complain(words: str) -> None:
    """The one line on standard error, where there is one."""
    with contextlib.suppress(OSError):
        print(f"jaxform: {words}", file=sys.stderr, flush=True)


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
        ("check", _check, "SCENE", "validate a scene or study, say what will be simulated, run no step"),
    ):
        sub = commands.add_parser(name, help=words, description=words)
        sub.add_argument("source", metavar=what, help="a built-in name or a .toml file")
        sub.add_argument("--quiet", action="store_true", help="print errors only")
        sub.add_argument("--dtype", choices=("float64", "float32"), default="float64")
        words = "where check.png goes, the sheet in the mold" if name == "check" else "where the results go"
        sub.add_argument("--out", metavar="DIR", required=name != "check", type=Path, help=words)
        sub.add_argument("--force", action="store_true", help="overwrite results in DIR")
        if name == "optimize":
            words = "go on with the search in DIR where it was killed, or with more iterations where it had ended"
            sub.add_argument("--resume", action="store_true", help=words)
        sub.set_defaults(command=command)
    words = "compile beforehand what common scenes need, or the scenes that are named"
    warm = commands.add_parser("warm", help=words, description=words)
    warm.add_argument("sources", metavar="SCENE", nargs="*", help="a built-in name or a .toml file")
    warm.add_argument("--quiet", action="store_true", help="print errors only")
    warm.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    warm.set_defaults(command=_warm)
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
    except UnicodeEncodeError:
        print(words.encode("ascii", "backslashreplace").decode(), flush=True)
    except BrokenPipeError:
        # All that is still to come goes nowhere, what Python flushes at the end included.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _prepare(arguments: argparse.Namespace) -> tuple[Callable[[str], None], Store]:
    """Sets the precision and what is kept between runs; returns what prints for people, and the store."""
    import jax

    from jaxform.store import Store

    # Asked for on the command line, so the reminder that Python users get is not needed.
    warnings.filterwarnings("ignore", message="jaxform computes in float32")
    jax.config.update("jax_enable_x64", arguments.dtype == "float64")
    # Lines of source in the programs help nobody here; without them they are a tenth smaller and sooner read back.
    jax.config.update("jax_traceback_in_locations_limit", 0)
    folder = _cache_folder()
    if folder is not None:
        _use_compile_cache(folder / cachefolder.COMPILED)
    store = Store(None if folder is None else folder / cachefolder.MADE)
    gc.freeze()
    gc.enable()
    return (lambda _: None) if arguments.quiet else _say, store


def _cache_folder() -> Path | None:
    """In the user's cache folder; None where that is not the user's alone, or cannot be written."""
    return cachefolder.own_folder()


def _use_compile_cache(folder: Path) -> None:
    """Keeps compiled programs between runs, in a folder or where the environment says."""
    import warnings

    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        _guard.enter_context(cachefolder.guarded(folder))
        jax.config.update("jax_compilation_cache_dir", str(folder))
    # Many small programs together take longer than one large one.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    # What cannot be kept, or read back, is compiled again: nothing that anybody must know, on a full disk for each one.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")


def _open_folder(folder: Path, force: bool) -> None:
    """Makes the output folder, or refuses before anything is computed."""
    if disk.is_file(folder):
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
    except InputError:
        raise
    except (OSError, ValueError) as error:
        problem = f"cannot be written ({disk.reason(error)})"
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
    frames.begin(scene)
    with _meanwhile(_warm_up):
        result = _run(scene, frames, not arguments.quiet, store)
    summary = _write_part(arguments, scene, result, reference)
    frames.finish(scene, result)
    _tell(say, summary, arguments.out)
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
    arguments: argparse.Namespace,
    scene: Scene,
    result: Result,
    reference: dict[str, Any] | None,
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Writes files and picture, the summary amended on request; warns of what was not told before."""
    from jaxform import output, plots

    folder, told = arguments.out, list(arguments.warned)
    with _meanwhile(lambda: output.write_result(scene, result, folder, told, amend)) as written:
        plots.thickness_picture(folder / "thickness.png", scene, result, reference)
    summary = written.result()
    for sentence in summary["warnings"]:
        if sentence not in told:
            _warn(sentence)
    return summary


def _warn(sentence: str) -> None:
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
    from jaxform import checking, files

    if catalog.kind_of(arguments.source) == "study":
        document, scene, lines = checking.read_study(arguments.source, store)
    else:
        document, lines = files.read_scene(arguments.source), []
        scene = files.build(document, store)
    files.read_reference(document)
    if arguments.out is not None:
        _open_folder(arguments.out, arguments.force)
    for line in [*lines, *checking.scene_lines(document, scene, store)]:
        say(line)
    if arguments.out is not None:
        from jaxform import preview

        preview.check_picture(arguments.out / "check.png", scene, arguments.warned)
        say(f"picture in {arguments.out / 'check.png'}")
    return DONE


def _optimize(arguments: argparse.Namespace) -> int:
    from jaxform import designing

    return designing.optimize_study(arguments)


def _warm(arguments: argparse.Namespace) -> int:
    from jaxform import warming

    return warming.warm(arguments)


if __name__ == "__main__":
    sys.exit(main())
