"""The command `jaxform adapt`: writes a scene with a mesh that is finer where the wall is less accurate."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxform.cli import session
from jaxform.core.errors import format_percent

if TYPE_CHECKING:
    from jaxform.core.store import Store
    from jaxform.io.files import SceneDocument
    from jaxform.mesh.shapes import Sheet

NAME = "adapted.toml"
"""The file of the adapted scene; its mesh has the same name."""
SUMMARY = "summary.json"
"""The file that says which runs the mesh was made from."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `jaxform adapt`."""
    parser.add_argument("source", metavar="SCENE", help="a built-in name or a .toml file")
    parser.add_argument(
        "--out", metavar="DIR", required=True, type=Path, help=f"folder for {NAME}, its mesh and {SUMMARY}"
    )
    words = "largest number of elements; by default that of parison.adapt, 2500, or that of SCENE if larger"
    parser.add_argument("--elements", metavar="N", type=int, help=words)
    words = "number of runs, each followed by a new mesh; by default that of parison.adapt, or 2"
    parser.add_argument("--passes", metavar="N", type=int, help=words)
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    session.add_precision(parser)
    parser.add_argument("--force", action="store_true", help="overwrite files in DIR")


def adapt(arguments: argparse.Namespace) -> int:
    """Runs `jaxform adapt` with its arguments and returns its exit status."""
    say, store = session.prepare(arguments)
    from jaxform.io import adaptation, files, output, scene_rewriting

    read = files.read_scene(arguments.source)
    document = adaptation.adaptable(read, elements=arguments.elements, passes=arguments.passes)
    session.open_folder(arguments.out, arguments.force)

    made, runs = adapt_mesh(document, store, say)
    with files.error_context(document.file):
        path = scene_rewriting.write_scene(document, {}, arguments.out, NAME)
    output.write_json(arguments.out / SUMMARY, {"scene": document.name, "elements": len(made.triangles), "runs": runs})
    say(f"wrote {NAME} with {len(made.triangles)} elements into {arguments.out}")
    say(f"next:\n    jaxform simulate {shlex.quote(str(path))} --out {shlex.quote(str(arguments.out / 'formed'))}")
    return session.DONE


def adapt_mesh(
    document: SceneDocument, store: Store, say: Callable[[str], object]
) -> tuple[Sheet, list[dict[str, Any]]]:
    """The sheet on the mesh that `parison.adapt` asks for, and the facts of the runs for it; says what each shows."""
    from jaxform.io import adaptation, files, geometry

    runs: list[dict[str, Any]] = []

    def report(run: dict[str, Any]) -> None:
        runs.append(run)
        say(f"run {len(runs)} with {describe_run(run)}")

    with files.error_context(document.file):
        first = geometry.build_sheet(adaptation.without_adaptation(document), store)
        say(f"simulating with the initial mesh of {len(first.triangles)} elements")
        return adaptation.adapt_sheet(document, first, store, report), runs


def describe_run(run: dict[str, Any]) -> str:
    """A sentence on a run before the run: elements, error, moved and new nodes."""
    words = f"{run['elements']} elements: estimated error of their wall {format_percent(run['estimated_error'])}"
    if "nodes_moved" not in run:
        return words
    words += f"; {run['nodes_moved']} nodes moved onto sharp edges, by up to {run['farthest_move']:.2g} of an element"
    return f"{words}; {run['nodes_added']} nodes added on sides that cut edges" if run["nodes_added"] else words


def describe(document: SceneDocument) -> str:
    """A line which says that the mesh of a document will be adapted."""
    return f"the mesh of {document.name} is adapted before the run; the figures below are those of its first mesh"
