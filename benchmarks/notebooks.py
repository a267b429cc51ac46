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
SMALL = "JAXFORM_SMALL"
"""Environment variable under which the notebooks take few elements and few steps."""
_QUICKLY = "from jaxform.core import compiling as c; c._LEVEL = 0; import gc; gc.set_threshold(100_000, 50, 50)"


def executed(path: Path, cache: Path, *, small: bool = False) -> Any:
    """The notebook with the outputs of a run in a kernel of its own; programs compiled twice are kept in a folder."""
    notebook = nbformat.read(path, as_version=4)
    changes = {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    changes[SMALL] = "1" if small else ""
    changes["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # whatever the caller draws with
    if small:
        # Compiling is nearly all of it; less careful, it takes two thirds.
        changes["XLA_FLAGS"] = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    options: dict[str, Any] = {"extra_arguments": [f"--IPKernelApp.exec_lines={_QUICKLY}"]} if small else {}
    with _environment(changes):
        NotebookClient(notebook, timeout=3600, kernel_name="python3", record_timing=False, **options).execute()
    return cleaned(notebook)


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


def cleaned(notebook: Any) -> Any:
    """Without what tells of the machine: metadata of runs, paths in texts, warnings."""
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in notebook.cells:
        cell.metadata = {}
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
    with tempfile.TemporaryDirectory() as cache:
        for path in sorted(FOLDER.glob("*.ipynb")):
            if not arguments.names or path.stem in arguments.names:
                print(path.stem, flush=True)
                notebook = executed(path, Path(cache), small=arguments.small)
                nbformat.write(notebook, arguments.out / path.name)


if __name__ == "__main__":
    main()
