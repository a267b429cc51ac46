"""The command: `jaxform scenes`, `simulate`, `optimize`, `check` and others. It alone knows both jaxform and optimize.

Exit status: 0 done; 2 bad input, with one line on standard error; 3 the simulation stopped early, with what was
computed written, the part does not fill its mold, or a search does not keep all limits; 130 interrupted. Heavy imports
wait until a command needs them.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from jaxform.cli import (
    adapt_command,
    defer_interrupts,
    export_command,
    fit_command,
    new_command,
    session,
    sweep_command,
)
from jaxform.core import disk, errors, installation
from jaxform.core.errors import InputError, collect_warnings
from jaxform.io import catalog

if TYPE_CHECKING:
    pass


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command, that of the process where no arguments are given, and returns its exit status."""
    # Imported objects stay: garbage collection over them takes a tenth of a short run. `prepare` enables it again.
    gc.disable()
    try:
        arguments = _parser().parse_args(argv)
        arguments.own_process = argv is None
        with collect_warnings(session.warn) as arguments.warned:
            return arguments.command(arguments)
    except InputError as error:
        _complain(str(error))
        return session.BAD_INPUT
    except KeyboardInterrupt:
        _complain("interrupted")
        return session.INTERRUPTED
    except (OSError, MemoryError, RuntimeError) as error:
        words = errors.describe_system_error(error)
        if words is None:
            raise
        _complain(words)
        return session.BAD_INPUT
    finally:
        session.guard.close()
        if argv is None:
            # The process ends: a last garbage collection would take a quarter of a second.
            gc.freeze()
        else:
            # For a caller that goes on, wherever the command ended.
            gc.unfreeze()
        gc.enable()


def _complain(words: str) -> None:
    """Prints the line of an error on standard error, if there is one."""
    with contextlib.suppress(OSError):
        print(f"jaxform: {words}", file=sys.stderr, flush=True)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # `--mold` takes every name that follows it.
        order = ", which has to be named before --mold" if message.endswith("required: FOLDER") else ""
        raise InputError(f"{message}{order}; see `{self.prog} --help`")


class _Version(argparse.Action):
    """Prints the version, which is looked up on demand."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        session.say(f"{parser.prog} {installation.version()}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxform", description="Simulate and design blow moulding and thermoforming.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    scenes = commands.add_parser("scenes", help="list the built-in scenes and studies")
    scenes.set_defaults(command=_scenes)
    for name, command, what, words in (
        ("simulate", _simulate, "SCENE", "simulate a scene"),
        ("optimize", _optimize, "STUDY", "search for the best design of a study"),
        (
            "check",
            _check,
            "SCENE",
            "validate a scene or study and print what will be simulated, without running a step",
        ),
    ):
        sub = commands.add_parser(name, help=words, description=words)
        words = "a built-in name or a .toml file" + (" of a scene or a study" if name == "check" else "")
        sub.add_argument("source", metavar=what, help=words)
        sub.add_argument("--quiet", action="store_true", help="print warnings and errors only")
        session.add_precision(sub)
        words = "folder for check.png, a picture of sheet and mold" if name == "check" else "folder for the results"
        sub.add_argument("--out", metavar="DIR", required=name != "check", type=Path, help=words)
        sub.add_argument("--force", action="store_true", help="overwrite results in DIR")
        if name == "optimize":
            words = "resume the search in DIR after an interruption, or with more iterations"
            sub.add_argument("--resume", action="store_true", help=words)
            words = "processes of this machine for several starts (solver.starts); default: 1"
            sub.add_argument("--workers", metavar="N", type=sweep_command.process_count, default=1, help=words)
        sub.set_defaults(command=command)
    words = "compute many designs of a scene: a row of results for each, pictures and a report"
    swept = commands.add_parser("sweep", help=words, description=words)
    sweep_command.add_arguments(swept)
    swept.set_defaults(command=sweep_command.sweep)
    words = "adapt the mesh of a scene's sheet: finer where its wall is less accurate; writes the scene with that mesh"
    adapted = commands.add_parser("adapt", help=words, description=words)
    adapt_command.add_arguments(adapted)
    adapted.set_defaults(command=adapt_command.adapt)
    words = "write report.html again from the files in a folder of results"
    report = commands.add_parser("report", help=words, description=words)
    report.add_argument("folder", metavar="DIR", type=Path, help="folder of results of simulate or optimize")
    report.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    report.set_defaults(command=_report)
    words = "render the part in a folder of results from both sides; needs PyVista (pip install pyvista)"
    render = commands.add_parser("render", help=words, description=words)
    render.add_argument("folder", metavar="DIR", type=Path, help="folder of results of simulate or optimize")
    render.add_argument("--out", metavar="FILE", type=Path, help="the picture (default: part.png in DIR)")
    render.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    render.set_defaults(command=_render)
    words = "compile the programs of common scenes, or of the given scenes, in advance"
    warm = commands.add_parser("warm", help=words, description=words)
    warm.add_argument("sources", metavar="SCENE", nargs="*", help="a built-in name or a .toml file")
    warm.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    session.add_precision(warm)
    warm.set_defaults(command=_warm)
    words = "export the wall of a formed part for another analysis, on the formed mesh or on a given mesh"
    exported = commands.add_parser("export", help=words, description=words)
    export_command.add_arguments(exported)
    exported.set_defaults(command=export_command.export)
    words = "fit the parameters of a material model to test data"
    fit = commands.add_parser("fit", help=words, description=words)
    fit_command.add_arguments(fit)
    fit.set_defaults(command=fit_command.fit)
    words = "write a scene and a study for a mold, ready to run"
    new = commands.add_parser("new", help=words, description=words)
    new_command.add_arguments(new)
    new.set_defaults(command=new_command.start)
    return parser


def _scenes(_: argparse.Namespace) -> int:
    uses: dict[catalog.Kind, str] = {"scene": "simulate", "study": "optimize"}
    listed = {kind: catalog.descriptions(kind) for kind in uses}
    width = max(len(name) for names in listed.values() for name in names)
    for kind, use in uses.items():
        for name, words in listed[kind].items():
            session.say(f"{name:{width}}  {kind}  jaxform {use} {name:{width}}  {words}")
    return session.DONE


def _check(arguments: argparse.Namespace) -> int:
    say, store = session.prepare(arguments)
    from jaxform.cli import check_command
    from jaxform.io import adaptation, files, scene_checks

    if catalog.kind_of(arguments.source) == "study":
        document, scene, lines = check_command.read_study(arguments.source, store)
    else:
        document, lines = files.read_scene(arguments.source), []
        if document.model.parison.adapt is not None:
            # That takes runs.
            document, lines = adaptation.without_adaptation(document), [adapt_command.describe(document)]
        scene = files.build(document, store)
    scene_checks.warn_of_side_holes(scene, document.file)
    files.read_reference(document)
    if arguments.out is not None:
        session.open_folder(arguments.out, arguments.force)
    for line in [*lines, *check_command.scene_lines(document, scene, store)]:
        say(line)
    if arguments.out is not None:
        from jaxform.io import geometry, plots

        covers = geometry.cover_triangles(document, scene.mold, store)
        plots.check_picture(arguments.out / "check.png", scene, arguments.warned, covers)
        say(f"picture in {arguments.out / 'check.png'}")
    return session.DONE


def _simulate(arguments: argparse.Namespace) -> int:
    from jaxform.cli import simulate_command

    return simulate_command.simulate(arguments)


def _optimize(arguments: argparse.Namespace) -> int:
    from jaxform.cli import optimize_command

    return optimize_command.optimize_study(arguments)


def _report(arguments: argparse.Namespace) -> int:
    with defer_interrupts():
        from jaxform.io.report import write_report

    path = write_report(arguments.folder)
    if not arguments.quiet:
        session.say(f"report in {path}")
    return session.DONE


def _render(arguments: argparse.Namespace) -> int:
    with defer_interrupts():
        from jaxform.io.rendering import render

    path = arguments.folder / "part.png" if arguments.out is None else disk.expand_path(arguments.out)
    render(arguments.folder, path)
    if not arguments.quiet:
        session.say(f"picture in {path}")
    return session.DONE


def _warm(arguments: argparse.Namespace) -> int:
    with defer_interrupts():
        from jaxform.cli import precompile

    return precompile.warm(arguments)
