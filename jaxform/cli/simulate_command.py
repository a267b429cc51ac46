"""The command `jaxform simulate`: a run with a bar and frames, its files and its picture."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxform.cli import adapt_command, session
from jaxform.core import disk
from jaxform.core.errors import InputError, defer_warnings, format_percent, redirect_warnings

if TYPE_CHECKING:
    from jaxform.core.store import Store
    from jaxform.model.scene import Scene
    from jaxform.results.result import Result


def simulate(arguments: argparse.Namespace) -> int:
    """Runs `jaxform simulate` with its arguments and returns its exit status."""
    with session.start_picture(arguments) as draw:
        source = arguments.source
        subject = os.path.abspath(source) if disk.is_file(Path(source)) else source
        say, store = session.prepare(arguments, subject)
        from jaxform.io import files, process, scene_rewriting
        from jaxform.io.output import Frames
        from jaxform.runs import host

        document = files.read_scene(arguments.source)
        reference = files.read_reference(document)
        sheet, runs = None, []
        if document.model.parison.adapt is not None:
            sheet, runs = adapt_command.adapt_mesh(document, store, say)
        with session.report_waiting(arguments, "reading the mold and preparing its search grid"):
            scene = files.build_unchecked(document, store, sheet)

        def add_runs(summary: dict[str, Any]) -> dict[str, Any]:
            return summary | {"adaptation": runs} if runs else summary

        session.open_folder(arguments.out, arguments.force)
        frames = Frames(arguments.out, document.model.output.frames)
        frames.begin(scene)
        host.start_programs(scene, store)
        look = session.run_in_background(lambda: _warn_of_scene(scene, document, arguments.warned))
        # Warnings of the run come after those of the scene, whichever ends first.
        with defer_warnings(), look as looked:
            result, there = _run(scene, frames, arguments, store, add_runs)
            history = process.process_history(scene, result)
            picture = session.picture(arguments, scene, result, reference, history, draw)
            store.record_programs(subject)
        looked.result()

        def write_rest() -> None:
            scene_rewriting.keep_scene(document, arguments.out)
            frames.finish(scene, result)
            process.write_process(history, arguments.out)
            with session.report_waiting(arguments, "writing the report"):
                session.write_report(arguments.out)

        summary = session.write_part(arguments, scene, result, picture, add_runs, write_rest, there=there)
    touched = "the mold" if not scene.tools else "mold and tools" if scene.mold is not None else "tools"
    _tell(say, summary, arguments.out, touched)
    return session.exit_status(result)


def _warn_of_scene(scene: Scene, document: Any, warned: list[str]) -> None:
    """Warns of likely errors in the scene while programs are loaded or compiled; then prepares to write the results."""
    from jaxform.io import files, scene_checks

    def tell(sentence: str) -> None:
        if sentence not in warned:
            warned.append(sentence)
            session.warn(sentence)

    with redirect_warnings(tell):
        files.review_scene(scene, document)
        if scene.mold is not None and document.model.mold.shape == "file":
            scene_checks.warn_of_side_holes(scene, document.file)
    import meshio  # noqa: F401
    import scipy.spatial  # noqa: F401


def _run(
    scene: Scene,
    frames: Any,
    arguments: argparse.Namespace,
    store: Store,
    amend: Callable[[dict[str, Any]], dict[str, Any]],
) -> tuple[Result, bool]:
    """Runs a scene with a bar and frames where they are wanted; Ctrl-C keeps what was computed.

    What is written at once has an amended summary.

    Returns:
        The result, and whether its files are written, except for what must be measured.
    """
    from jaxform.io import output
    from jaxform.runs.host import Moment, run

    interrupted = there = False

    with contextlib.ExitStack() as measuring, session.progress(not arguments.quiet, scene.name) as bar:

        def on_end(result: Result) -> None:
            nonlocal there
            # A failure to write is reported at the end.
            with contextlib.suppress(OSError, InputError):
                output.write_at_once(scene, result, arguments.out, arguments.warned, amend)
                there = True
            measuring.enter_context(session.report_waiting(arguments, session.COMPARING))

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
        result = run(scene, on_window=on_window if watched else None, on_end=on_end, store=store)
    return result, there


def _tell(say: Callable[[str], None], summary: dict[str, Any], folder: Path, touched: str) -> None:
    from jaxform.core.errors import format_place

    wall = {key: 1e3 * summary["thickness"][key] for key in ("min", "mean", "max")}
    say(
        f"{summary['scene']}: {summary['elements_final']} elements, {summary['steps']} steps in "
        f"{summary['run_seconds']:.2f} s (compiled in {summary['compile_seconds']:.1f} s)"
    )
    say(
        f"wall {wall['min']:.4g} to {wall['max']:.4g} mm, mean {wall['mean']:.4g} mm, coefficient of variation "
        f"{format_percent(summary['thickness']['cv'], 3)}; {format_percent(summary['contact_fraction'], 3)} in contact "
        f"with {touched}; energy balance within {format_percent(summary['energy']['balance_error'])}"
    )
    say(_thinnest(summary["thinnest"]))
    if pieces := summary.get("flash"):
        low, high = (format_place(place) for place in pieces[0]["box"])
        count = "1 piece," if len(pieces) == 1 else f"{len(pieces)} pieces, the heaviest"
        mass = f"{1e3 * summary['flash_mass']:.3g} of {1e3 * summary['sheet_mass']:.3g} g"
        say(f"flash, which is cut off: {mass}, in {count} from {low} to {high}")
    for tool in summary["tools"]:
        if tool["name"] != "mold":
            say(_contact_words(tool))
    if summary["gap_max"] > summary["thickness"]["mean"]:
        where = format_place(summary["gap_place"])
        say(f"largest gap between part and mold: {1e3 * summary['gap_max']:.3g} mm at {where}")
    say(f"status: {summary['status']}; results in {folder}")


def _contact_words(tool: dict[str, Any]) -> str:
    """The contact of a tool over the run, its work and its friction, in words."""
    if tool["contact_period"] is None:
        return f"{tool['name']}: never touches the sheet"
    begin, end = tool["contact_period"]
    words = (
        f"{tool['name']}: in contact from {begin:.3g} to {end:.3g} s, with "
        f"{format_percent(tool['contact_fraction_max'], 3)} of the area at most and "
        f"{format_percent(tool['contact_fraction'], 3)} at the end"
    )
    energies = [
        f"{name} {tool[key]:.3g} J" for name, key in (("work", "work"), ("friction", "friction_loss")) if tool[key]
    ]
    return "; ".join([words, *energies])


def _thinnest(found: dict[str, Any]) -> str:
    """The thinnest recovered wall in words, with its scatter."""
    from jaxform.core.errors import format_place

    where, around = (
        format_place(found["recovered_place"]),
        "around its circle" if found["scatter_of"] == "ring" else "among the elements there",
    )
    return (
        f"thinnest wall, recovered from the elements: {1e3 * found['recovered']:.4g} mm, "
        f"{format_percent(found['recovered_ratio'], 3)} of the initial thickness there, at {where}; scatter "
        f"{format_percent(found['scatter'])} {around}"
    )
