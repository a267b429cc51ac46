"""Python files of users, which declare material models for scene files."""

from __future__ import annotations

import hashlib
import sys
import traceback
import types
from pathlib import Path
from typing import Any

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.io.geometry import error_context
from jaxform.materials import LAWS, Law

_run_files: dict[tuple[Path, str], dict[str, type[Law]]] = {}


def import_models_of(tables: dict[str, Any], folder: Path, file: str) -> None:
    """Registers the material models that the key `model_file` of a scene's [material] makes known.

    Args:
        tables: Tables of a scene file, not validated.
        folder: Base of relative paths.
        file: Name of the scene file in messages.

    Raises:
        InputError: As `import_models`.
    """
    material = tables.get("material")
    name = material.get("model_file") if isinstance(material, dict) else None
    if isinstance(name, str):
        with error_context(file, "material.model_file"):
            import_models(disk.expand_path(name, folder))


def import_models(path: Path) -> None:
    """Runs a Python file, if its text has not been run before, and registers the material models that it declares.

    Raises:
        InputError: The file cannot be read or run, or declares no model with a name.
    """
    text = disk.read_text(path)
    key = path.resolve(), text
    if key not in _run_files:
        _run_files[key] = _run(path, text)
    LAWS.update(_run_files[key])


def _run(path: Path, text: str) -> dict[str, type[Law]]:
    """The models that a file declares, by name."""
    # A name outside this package's: a program with a user's class is not kept in files.
    digest = hashlib.sha256(f"{path.resolve()}\0{text}".encode()).hexdigest()
    module, before = types.ModuleType(f"models_{digest[:16]}"), dict(LAWS)
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # where dataclasses look for the types of fields
    try:
        exec(compile(text, str(path), "exec"), module.__dict__)
    except InputError as error:
        raise error.with_context(file=str(path)) from None
    except (Exception, SystemExit) as error:
        raise InputError(_describe(error, path), "correct the Python file", value=str(path)) from None
    declared = {name: made for name, made in LAWS.items() if before.get(name) is not made}
    if not declared:
        remedy = 'decorate the class of the model with @jaxform.law(model="NAME")'
        raise InputError("declares no material model", remedy, value=str(path))
    return declared


def _describe(error: BaseException, path: Path) -> str:
    """The exception of a user's file in words, with the last line of the file that led to it."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
    where = "" if line is None else f" in line {line}"
    return f"cannot be run ({type(error).__name__}{where}: {error})"
