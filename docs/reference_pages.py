"""Pages of the reference that are written from what they describe: the schema of files and the command's parser."""

from __future__ import annotations

import argparse
import inspect
import re
import types
import typing
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from jaxform.cli import command
from jaxform.io import schema
from jaxform.io.validation import Table
from optimize.designs import Study

_METHODS = (schema.Lbfgs, schema.Adam, schema.LeastSquares, schema.FixedPoint)
_SIMPLE = {float: "number", int: "whole number", bool: "`true` or `false`", str: "text"}


def write(folder: Path) -> None:
    """Writes scene.md, study.md and command.md into a folder, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.md").write_text(_page(_SCENE_INTRODUCTION, schema.SceneFile), encoding="utf-8")
    (folder / "study.md").write_text(_page(_STUDY_INTRODUCTION, schema.StudyFile), encoding="utf-8")
    (folder / "command.md").write_text(_command(), encoding="utf-8")


_SCENE_INTRODUCTION = """# Scene file

A scene is a TOML file. Units are SI throughout: m, s, Pa, kg/m³; nothing is converted. Unknown keys, wrong types and
numbers out of range are refused in one line that names file, key, value and hint.
"""
_STUDY_INTRODUCTION = """# Study file

A study names the variables, the objective, and the method of the search.
"""


def tables(model: type[Table]) -> list[tuple[str, type[Table]]]:
    """The tables of a file in its order, each with the key that it stands at; each kind once."""
    found: dict[type[Table], str] = {model: ""}
    waiting = [model]
    while waiting:
        one = waiting.pop(0)
        for name, field in one.model_fields.items():
            for inner in _tables_in(field):
                if inner not in found:
                    prefix = found[one]
                    found[inner] = f"{prefix}.{name}" if prefix else name
                    waiting.append(inner)
    return [(key, one) for one, key in found.items()]


def _tables_in(field: FieldInfo) -> list[type[Table]]:
    """The tables that a key may have as its value."""
    found = _tables_in_annotation(field.annotation)
    return [*schema.material_tables()] if schema.MaterialTable in found else found


def _tables_in_annotation(annotation: Any) -> list[type[Table]]:
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return [annotation]
    return [inner for part in get_args(annotation) for inner in _tables_in_annotation(part)]


def describe(model: type[Table]) -> dict[str, str]:
    """What each key of a table means, from the docstrings of its class and of those that it derives from."""
    found: dict[str, str] = {}
    for one in reversed(model.__mro__[: model.__mro__.index(Table)]):
        text = inspect.cleandoc(one.__doc__ or "")
        text = re.sub(r"\n {4,}(?=\S)", " ", re.sub(r"\n {4}(?=\w+: )", "\n@", text))
        found |= re.findall(r"^@(\w+): (.*?)\s*$", text, re.MULTILINE)
    return found


def _page(introduction: str, model: type[Table]) -> str:
    parts = [introduction]
    for key, one in tables(model):
        parts.append(f"## {_title(key, one)}\n\n{_first(one)}\n")
        parts.append("| key | value | default | |\n|---|---|---|---|")
        words = describe(one)
        # What tells the kind comes first.
        for name, field in sorted(one.model_fields.items(), key=lambda item: not _only(item[1])):
            parts.append(f"| `{name}` | {_value(field)} | {_default(name, field, one)} | {words[name]} |")
        parts.append("")
    return "\n".join(parts)


def _title(key: str, model: type[Table]) -> str:
    if not key:
        return "The file"
    for field in model.model_fields.values():
        if _only(field):
            return f"{key}: {_only(field)}"
    return f"{key}: {_form(model)}" if "." in key else key


def _only(field: FieldInfo) -> str:
    """The one value that a key can have."""
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    return str(choices[0]) if len(choices) == 1 else ""


def _form(model: type[Table]) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", model.__name__.removesuffix("Table")).lower()


def _first(model: type[Table]) -> str:
    return inspect.cleandoc(model.__doc__ or "").split("\n\n")[0].replace("\n", " ")


def _value(field: FieldInfo) -> str:
    return " ".join(part for part in (_kind(field.annotation), _range(field.metadata)) if part)


def _kind(annotation: Any) -> str:
    origin = get_origin(annotation)
    if annotation in _SIMPLE:
        return _SIMPLE[annotation]
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return "table"
    if origin is typing.Annotated:
        base, *more = get_args(annotation)
        return " ".join(part for part in (_kind(base), _range(more)) if part)
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(annotation))
    if origin in (typing.Union, types.UnionType):
        kinds = [_kind(part) for part in get_args(annotation) if part is not type(None)]
        return " or ".join(dict.fromkeys(kinds))
    if origin is list:
        words = re.sub(r"\blist of number\b", "numbers", f"list of {_kind(get_args(annotation)[0])}")
        return re.sub(r"\blist of (table|text)\b", r"list of \1s", words)
    return "table"


def _range(metadata: Any) -> str:
    words = []
    for part in [inner for one in metadata for inner in getattr(one, "metadata", [one])]:
        for sign, attribute in ((">", "gt"), ("≥", "ge"), ("<", "lt"), ("≤", "le")):
            limit = getattr(part, attribute, None)
            if limit is not None and abs(limit) < 1e9:
                words.append("> 0" if 0 < limit < 1e-20 else f"{sign} {limit:,g}")
        least, most = getattr(part, "min_length", None), getattr(part, "max_length", None)
        if least is not None and least == most:
            words.append(f"{least} of them")
    return ", ".join(dict.fromkeys(words))


def _default(name: str, field: FieldInfo, model: type[Table]) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None and model in _METHODS:
        value = Study.__dataclass_fields__[name].default
    if isinstance(value, Table):
        return "its defaults"
    words = {None: "none", True: "`true`", False: "`false`", "": "empty"}
    if isinstance(value, (bool, str, type(None))) and value in words:
        return words[value]
    return f"`{value:,}`".replace(",", "_") if isinstance(value, int) else f"`{value}`"


def _command() -> str:
    parser = command._parser()
    parts = ["# Command\n"]
    for name, (text, sub) in _commands(parser).items():
        parts.append(f"## jaxform {name}\n\n{text[:1].upper()}{text[1:]}.\n")
        rows = [_argument(action) for action in sub._actions if not isinstance(action, argparse._HelpAction)]
        if rows:
            parts += ["| argument | |", "|---|---|", *rows, ""]
    return "\n".join([*parts, _STATUSES])


def _commands(parser: argparse.ArgumentParser) -> dict[str, tuple[str, argparse.ArgumentParser]]:
    action = next(one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    words = {choice.dest: choice.help or "" for choice in action._choices_actions}
    return {name: (words[name], sub) for name, sub in action.choices.items()}


def _argument(action: argparse.Action) -> str:
    values = " ".join([f"`{name}`" for name in action.option_strings] or [f"`{action.metavar or action.dest}`"])
    if action.choices:
        values += " " + " or ".join(f"`{choice}`" for choice in action.choices)
    elif action.option_strings and action.metavar:
        values += f" `{action.metavar}`"
    return f"| {values} | {action.help or ''} |"


_STATUSES = """## Exit status

| status | meaning |
|---|---|
| 0 | done |
| 2 | the input was refused, in one line that names file, key, value and hint; or the system refused a file or memory |
| 3 | the run stopped early, the part does not fill its mold, or a search did not keep a limit; results are written |
| 130 | interrupted; results so far are written |
"""
