"""Validation of a file's tables: strict types, known keys, and one clear line about the first error."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from jaxform.core.errors import InputError
from jaxform.core.ranges import LEAST, MOST, RANGES, Range

MOST_LENGTH = 1e6
NO_KEY = "is not a valid key here"


def _finite(value: float) -> float:
    if abs(value) > MOST:
        raise validation_error(
            "is outside the range of the computation", f"give a number of up to {MOST:g}", value=value
        )
    return value


def _not_underflowing(value: float) -> float:
    if value < LEAST:
        raise validation_error(
            "is outside the range of the computation", f"give a number of at least {LEAST:g}", value=value
        )
    return value


def _short(value: float) -> float:
    if abs(value) > MOST_LENGTH:
        raise validation_error("is larger than any possible length", f"give metres, up to {MOST_LENGTH:g}", value=value)
    return value


Number = Annotated[float, AfterValidator(_finite)]
"""Any number whose products with others stay finite."""
NotNegative = Annotated[Number, Field(ge=0)]
Positive = Annotated[Number, Field(gt=0), AfterValidator(_not_underflowing)]
Coordinate = Annotated[float, AfterValidator(_short)]
"""A place along an axis [m]."""
Length = Annotated[Coordinate, Field(gt=0), AfterValidator(_not_underflowing)]
"""[m]"""


def declared_range(key: str) -> Any:
    """The range that is declared for a number of a scene, for `Annotated`."""
    return allow_range(RANGES[key])


def allow_range(allowed: Range) -> Any:
    """A range, for `Annotated`."""
    positive = allowed.above == 0.0
    return Field(
        gt=None if positive else allowed.above,
        ge=LEAST if positive else -MOST if allowed.least is None and not allowed.count else allowed.least,
        le=MOST if allowed.most is None and not allowed.count else allowed.most,
    )


class Table(BaseModel):
    """A table of a scene or study file: known keys only, no conversions, finite numbers.

    Attributes:
        later: Keys that a later version will know, and what to do without them.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True, defer_build=True)
    later: ClassVar[Mapping[str, str]] = {}

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        """Reports unknown keys first: a misspelt key explains the missing one."""
        for key in data if isinstance(data, dict) else ():
            if key in cls.later:
                raise validation_error("is not supported yet", cls.later[key], key)
            if key not in cls.model_fields:
                free = [name for name in cls.model_fields if name not in data]
                raise validation_error(NO_KEY, _suggestion(key, free, list(cls.model_fields)), key)
        return data


def validation_error(problem: str, remedy: str, key: str = "", value: Any = None) -> PydanticCustomError:
    """The error to raise in a validator.

    Args:
        problem: Description of the error.
        remedy: Remedy for the error.
        key: Key below the table that is validated.
        value: The offending value, where it is not the one that is validated.
    """
    return PydanticCustomError("wrong", "wrong", {"problem": problem, "remedy": remedy, "key": key, "value": value})


def choice(
    key: str, known: Sequence[str], later: Sequence[str] = (), usual: str | None = None
) -> tuple[Discriminator, BeforeValidator]:
    """Annotations for a union of tables from which `key` chooses; tag each table with `<value of key>`.

    Args:
        key: The key that names the kind of table.
        known: Its values.
        later: Values that a later version will know.
        usual: Value where the key is missing; None where the key is required.
    """
    return form(lambda table: table[key]), BeforeValidator(lambda table: check_choice(table, key, known, later, usual))


def check_choice(
    table: Any, key: str, known: Sequence[str], later: Sequence[str] = (), usual: str | None = None
) -> dict[str, Any]:
    """A table whose key has one of the known values; raises otherwise. Arguments as for `choice`."""
    options = f"use {', '.join(known)}"
    if not isinstance(table, dict):
        raise validation_error("is not a table", f"write it as a section, with {key} = ...", value=table)
    if key not in table:
        if usual is None:
            raise validation_error("is missing", options, key)
        return {**table, key: usual}
    if table[key] in later:
        raise validation_error("is not supported yet", options, key, table[key])
    if table[key] not in known:
        close = difflib.get_close_matches(str(table[key]), known, n=1)
        raise validation_error("is unknown", f"did you mean {close[0]}?" if close else options, key, table[key])
    return table


def form(name: Callable[[Any], str]) -> Discriminator:
    """Chooses a member of a union by the form of the value; errors are then about that form alone."""
    return Discriminator(lambda value: f"<{name(value)}>")


def check_increasing(at: Sequence[float], key: str = "at") -> None:
    """Raises unless the numbers increase."""
    if any(right <= left for left, right in pairwise(at)):
        raise validation_error("does not increase", "sort the knots, and give each only once", key, list(at))


def validate[M: Table](model: type[M], data: dict[str, Any], file: str) -> M:
    """The data of a file as a model.

    Raises:
        InputError: For the first thing that is wrong with it.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = _input_error(error.errors(include_url=False)[0])
    raise replace(first, file=file, key=_with_names(first.key, data))


def _with_names(key: str, data: dict[str, Any]) -> str:
    """A key in which a table of a list is called by its name, where it has one: tool.plug.friction."""
    found = re.fullmatch(r"(\w+)\[(\d+)\]\.(.+)", key)
    if found is None or found[3] == "name":
        return key
    tables = data.get(found[1])
    table = tables[int(found[2])] if isinstance(tables, list) and int(found[2]) < len(tables) else None
    name = table.get("name") if isinstance(table, dict) else None
    return f"{found[1]}.{name}.{found[3]}" if isinstance(name, str) and name else key


def validate_part[M: Table](model: type[M], data: Any) -> M:
    """A table of a file as a model that is known only then; for validators: raises what these do."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = _input_error(error.errors(include_url=False)[0])
    raise validation_error(first.problem, first.remedy, first.key, first.value)


def _input_error(error: ErrorDetails) -> InputError:
    context = error.get("ctx", {})
    if error["type"] == "wrong":
        key = _dotted_key([*error["loc"], *([context["key"]] if context["key"] else [])])
        return InputError(context["problem"], context["remedy"], key, context["value"])
    problem, remedy = _WORDS.get(error["type"], (error["msg"], ""))
    key = _dotted_key(error["loc"])
    value = None if error["type"] == "missing" else error["input"]
    return InputError(problem.format(**context), remedy.format(**context), key, value)


def _dotted_key(location: Sequence[int | str]) -> str:
    """The key as text, such as parison.thickness.at[2]; the tags of unions left out."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        elif not part.startswith("<"):
            text += f".{part}" if text else part
    return text


def _suggestion(key: str, free: list[str], known: list[str]) -> str:
    close = difflib.get_close_matches(key, free, n=1)
    return f"did you mean {close[0]}?" if close else f"the keys are {', '.join(known)}"


_WORDS: dict[str, tuple[str, str]] = {
    "missing": ("is missing", "add it"),
    "finite_number": ("is not finite", "give a finite number"),
    "float_type": ("is not a number", "give one number, without quotes"),
    "int_type": ("is not a whole number", "give one whole number, without quotes"),
    "int_from_float": ("is not a whole number", "give one whole number"),
    "string_type": ("is not a string", "put it in quotes"),
    "bool_type": ("is neither true nor false", "write true or false, without quotes"),
    "list_type": ("is not a list", "put it in square brackets"),
    "model_type": ("is not a table", "give its keys"),
    "literal_error": ("is unknown", "use {expected}"),
    "greater_than": ("is too small", "give a number above {gt:g}"),
    "greater_than_equal": ("is too small", "give a number of at least {ge:g}"),
    "less_than_equal": ("is too large", "give a number of at most {le:g}"),
    "too_short": ("is too short", "give at least {min_length} entries, not {actual_length}"),
    "too_long": ("is too long", "give {max_length} entries, not {actual_length}"),
}
