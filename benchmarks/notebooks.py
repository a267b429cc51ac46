"""Runs the notebooks and writes their outputs back: `make notebooks`.

`python -m benchmarks.notebooks --small --out DIR NAME ...` runs small versions and leaves the notebooks as they are.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
SMALL = {
    "01_first_simulation": "elements, depths = 60, [0.155448]",
    "02_parison_design": 'mesh = {"element_size": 0.012, "mold_element_size": 0.008}\nknots, iterations = 4, 1',
    "03_pressure_schedule": "elements, knots, iterations = 60, 4, 1",
    "04_accuracy_and_speed": "counts, levels = (60,), (2,)",
    "05_own_mesh_with_optax": "elements, iterations = 60, 2",
    "06_melt_schedule": "elements, iterations = 60, 1",
    "07_monte_carlo": "elements, samples = 60, 4",
    "08_own_material_model": "elements = 60",
    "09_sweeps_and_scatter": (
        "from concurrent.futures import ThreadPoolExecutor\n\nelements, count, executor = 60, 4, ThreadPoolExecutor(1)"
    ),
}
"""Assignments to the parameters of each notebook for a quick check: few elements, few iterations."""
_LESS = "--xla_backend_optimization_level=0"
_QUICKLY = (
    "import gc, os, jax; jax.devices(); os.environ['XLA_FLAGS'] = os.environ.pop('XLA_FLAGS_BEFORE')",
    "from jaxform.core import compilation; compilation._LEVEL = 0; gc.set_threshold(100_000, 50, 50)",
    "del gc, os, jax, compilation",
)
"""Code that a kernel runs first for a quick check: it compiles as the tests do, whose programs it then finds."""


def execute(path: Path, cache: Path, *, small: bool = False) -> Any:
    """The notebook with the outputs of a run in a kernel of its own; programs are kept in a folder for the others."""
    notebook = nbformat.read(path, as_version=4)
    changes = {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    changes["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # whatever the caller draws with
    if small:
        # Compiling is nearly all of it; less careful, it takes two thirds.
        before = os.environ.get("XLA_FLAGS", "")
        changes |= {"XLA_FLAGS": f"{before} {_LESS}", "XLA_FLAGS_BEFORE": before}
    lines = [f"--IPKernelApp.exec_lines={line}" for line in _QUICKLY]
    options: dict[str, Any] = {"extra_arguments": lines} if small else {}
    with _environment(changes):
        given = parametrize(notebook, SMALL[path.stem]) if small else notebook
        NotebookClient(given, timeout=3600, kernel_name="python3", record_timing=False, **options).execute()
    given.cells = [cell for cell in given.cells if cell.metadata.get("tags") != [INJECTED]]
    return clean(given)


PARAMETERS, INJECTED = "parameters", "injected-parameters"
"""Tags, as Papermill has them: of the cell with a notebook's parameters, and of one put behind it with others."""


def parametrize(notebook: Any, assignments: str) -> Any:
    """The notebook with a cell of assignments behind the one that is tagged "parameters"."""
    place = next(k for k, cell in enumerate(notebook.cells) if cell.metadata.get("tags") == [PARAMETERS])
    cell = nbformat.v4.new_code_cell(assignments, metadata={"tags": [INJECTED]})
    notebook.cells.insert(place + 1, cell)
    return notebook


class _environment:
    """Environment variables for a while: the kernel inherits them."""

    def __init__(self, changes: dict[str, str]) -> None:
        self.changes = changes

    def __enter__(self) -> None:
        self.before = dict(os.environ)
        os.environ.update(self.changes)

    def __exit__(self, *_: object) -> None:
        os.environ.clear()
        os.environ.update(self.before)


def clean(notebook: Any) -> Any:
    """Without what tells of the machine: metadata of runs, paths in texts, warnings."""
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        cell.metadata = {"tags": [PARAMETERS]} if cell.metadata.get("tags") == [PARAMETERS] else {}
        if cell.cell_type == "code":
            cell.outputs = [out for out in cell.outputs if out.get("name") != "stderr"]
            for out in cell.outputs:
                out.pop("metadata", None) if out.output_type == "stream" else out.update(metadata={})
                if out.output_type == "stream":
                    out.text = re.sub(r"(?:/[\w.+-]+){2,}/", "", out.text)
    return notebook


def main() -> None:
    """Runs the named notebooks, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="such as 01_first_simulation; all by default")
    parser.add_argument("--small", action="store_true", help="few elements, few steps")
    parser.add_argument("--out", type=Path, default=FOLDER, help="where the run notebooks go; by default in place")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", temporary)
        for path in sorted(FOLDER.glob("*.ipynb")):
            if not arguments.names or path.stem in arguments.names:
                print(path.stem, flush=True)
                notebook = execute(path, Path(cache), small=arguments.small)
                nbformat.write(notebook, arguments.out / path.name)


if __name__ == "__main__":
    main()
