"""Parts of a scene that declare their numbers: laws, loadings and fields, jaxform's own and a user's.

A number is declared once, with its unit and range; `replace`, designs, traced checks and messages follow from that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np

from jaxform.core.errors import InputError
from jaxform.core.pytree import pytree
from jaxform.core.ranges import Range, declare


def parameter(
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    nodal: bool = False,
    listed: bool = False,
    file_default: float | None = None,
) -> Any:
    """A number of a law, a loading or a field, with its range; by default any finite one.

    Args:
        unit: Of the number, empty where it has none.
        above: It is greater than this.
        least: It is not less than this.
        most: It is not greater than this.
        nodal: Whether it has a value at each node of the parison, (n_node,).
        listed: Whether it is a list of numbers (n,), such as one for each term of a law.
        file_default: Value where a scene file does not give the number; without one the file must give it.
    """
    allowed = Range(unit, above=above, least=least, most=most)
    return ranged_parameter(allowed, nodal=nodal, listed=listed, file_default=file_default)


def ranged_parameter(
    allowed: Range,
    *,
    nodal: bool = False,
    listed: bool = False,
    default: Any = dataclasses.MISSING,
    file_default: float | None = None,
) -> Any:
    """A number with a range that is declared elsewhere; see `parameter`."""
    metadata = {"range": allowed, "nodal": nodal, "listed": listed, "file_default": file_default}
    return field(default=default, metadata=metadata)


_NOUNS = {"Law": "material model", "Modes": "kind of Prony terms", "Shift": "time-temperature shift"}


def register_part[T](
    cls: type[T], base: type, method: str, remedy: str, section: str, needed: Sequence[str] = ()
) -> type[T]:
    """Makes a class a frozen dataclass and a pytree whose numbers are known to `replace` and to designs.

    Args:
        cls: The class.
        base: Required base class.
        method: Method that it must define.
        remedy: Remedy in words if it does not.
        section: First part of the paths of its parameters.
        needed: Parameters that it must have.

    Raises:
        InputError: It derives from something else, lacks the method, or a number is not declared or missing.
    """
    if not (isinstance(cls, type) and issubclass(cls, base)) or getattr(cls, method) is getattr(base, method):
        noun = _NOUNS.get(base.__name__, base.__name__.lower())
        raise InputError(f"is not a {noun}", remedy, value=getattr(cls, "__name__", str(cls)))
    made = pytree(cls)
    declared = {each.name: each.metadata.get("range") for each in _parameter_fields(made)}
    missing = sorted(key for key, allowed in {**dict.fromkeys(needed), **declared}.items() if allowed is None)
    if missing:
        text = ", ".join(missing)
        raise InputError(f"does not declare {text}", "declare them with jaxform.parameter", value=cls.__name__)
    for key, allowed in parameter_ranges(made).items():
        declare(f"{section}.{key}", allowed)
    return made


def is_registered(part: Any, base: type) -> bool:
    """True where the class of a part is itself declared; a subclass of a declared class is not by itself."""
    return isinstance(part, base) and type(part) is not base and "__dataclass_fields__" in vars(type(part))


def parameter_ranges(part: Any) -> dict[str, Range]:
    """The range of each number of a declared part, or of its class, by name."""
    return {each.name: each.metadata["range"] for each in _parameter_fields(part)}


def list_parameter_names(part: Any) -> list[str]:
    """The names of its numbers that are lists."""
    return [each.name for each in _parameter_fields(part) if each.metadata["listed"]]


def file_defaults(part: Any) -> dict[str, float]:
    """Values of the numbers that a scene file may leave out, by name."""
    defaults = {each.name: each.metadata["file_default"] for each in _parameter_fields(part)}
    return {name: value for name, value in defaults.items() if value is not None}


def varying_parameter_names(part: Any) -> list[str]:
    """The names of its numbers that vary over the sheet: those that have one axis more than they are declared with."""
    return [
        each.name
        for each in _parameter_fields(part)
        if np.ndim(getattr(part, each.name)) > int(each.metadata["listed"])
    ]


def nodal_parameter_names(part: Any) -> list[str]:
    """The names of its numbers that have a value at each node."""
    return [each.name for each in _parameter_fields(part) if each.metadata["nodal"]]


def _parameter_fields(part: Any) -> list[dataclasses.Field[Any]]:
    plain = (each for each in dataclasses.fields(part) if not each.metadata.get("static"))
    return [each for each in plain if not each.metadata.get("part")]
