"""Frozen dataclasses as JAX pytrees: arrays are leaves, choices are static."""

from __future__ import annotations

import dataclasses
import functools
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, dataclass_transform

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.ranges import Range, declare


def static(**kwargs: Any) -> Any:
    """A dataclass field that is a choice, not data: part of the tree's structure, known before tracing."""
    return field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(field, static))
def pytree[T](cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass whose fields are leaves, but for those declared with `static`.

    Its `repr` is one line: arrays by type and shape, parts by the names of their classes.
    """
    made = dataclass(frozen=True, eq=False, repr=False)(cls)
    if made.__repr__ is object.__repr__:
        made.__repr__ = _describe  # pyright: ignore[reportAttributeAccessIssue]
    return jax.tree_util.register_dataclass(made)


def _describe(tree: Any) -> str:
    """A tree in one line, without empty fields."""
    values = {part.name: getattr(tree, part.name, None) for part in dataclasses.fields(tree)}
    inside = ", ".join(f"{name}={abbreviate(value)}" for name, value in values.items() if value is not None)
    return f"{type(tree).__name__}({inside})"


def abbreviate(value: Any) -> str:
    """A number unchanged, an array as its type and shape, a tree as the name of its class, for a line of text."""
    if isinstance(value, (jax.Array, np.ndarray)):
        if value.ndim or isinstance(value, Tracer):
            return f"{value.dtype}[{','.join(map(str, value.shape))}]"
        return f"{value.item():.6g}" if np.issubdtype(value.dtype, np.floating) else str(value.item())
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {abbreviate(one)}" for key, one in value.items()) + "}"
    if dataclasses.is_dataclass(value) or (isinstance(value, tuple) and hasattr(value, "_fields")):
        return f"{type(value).__name__}(...)"
    return repr(value)


def check_untraced() -> None:
    """Refuses to build a scene inside a function that JAX traces, where no array has values.

    Raises:
        InputError: It is called inside such a function.
    """
    if isinstance(as_real(0.0), Tracer):
        raise InputError(
            "a scene is built inside a function that JAX traces (`jit`, `scan`), where arrays have no values",
            "load or build it before, and change its numbers inside by `replace`",
        )


def row_count(array: Any) -> str:
    """The rows of an array (..., n, k), for a line of text; "?" where a tree has something else in its place."""
    shape = getattr(array, "shape", ())
    return str(shape[-2]) if len(shape) > 1 else "?"


def memoize[T, R](function: Callable[[T], R]) -> Callable[[T], R]:
    """The function of a frozen tree, whose result is cached as long as that tree object exists."""
    results: weakref.WeakKeyDictionary[T, R] = weakref.WeakKeyDictionary()

    @functools.wraps(function)
    def look_up(tree: T) -> R:
        if tree not in results:
            results[tree] = function(tree)
        return results[tree]

    return look_up


def marked_field_names(parts: Any, mark: dict[str, Any]) -> list[str]:
    """The names of a dataclass' fields whose metadata have what `mark` has."""
    return [part.name for part in dataclasses.fields(parts) if mark.items() <= part.metadata.items()]


def is_internal(tree: Any) -> bool:
    """True where all classes in a tree are this package's or Python's: only such programs are kept in files.

    Only this package's source is part of the name of such a file.
    """
    node = tree.node_data()
    return node is None or (is_internal_class(node[0]) and all(map(is_internal, tree.children())))


def is_internal_class(cls: type) -> bool:
    """True for a class of this package or of Python."""
    return cls.__module__.partition(".")[0] in ("jaxform", "builtins")


def as_real(value: ArrayLike) -> jax.Array:
    """The value as an array of JAX's default floating type (float64 where x64 is enabled, else float32)."""
    return _convert(value, jnp.result_type(float))


def cast_to_precision[T](part: T) -> T:
    """The part itself, or one like it where real arrays of it are not of JAX's default floating type."""
    kind = jnp.result_type(float)

    def differs(leaf: Any) -> bool:
        return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype != kind

    if not any(map(differs, jax.tree.leaves(part))):
        return part
    return jax.tree.map(lambda leaf: as_real(leaf) if differs(leaf) else leaf, part)


def as_index(value: ArrayLike) -> jax.Array:
    """The value as an array of int32."""
    return _convert(value, jnp.int32)


def _convert(value: ArrayLike, kind: Any) -> jax.Array:
    # Converted by NumPy where it can be: JAX would compile a program for it, for every shape.
    return jnp.asarray(value if isinstance(value, jax.Array) else np.asarray(value, kind), dtype=kind)


# Parts of a scene that declare their numbers: laws, loadings and fields, jaxform's own and a user's.


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
        unit: Unit of the number; empty where it has none.
        above: It is greater than this.
        least: It is not less than this.
        most: It is not greater than this.
        nodal: True if it has a value at each node of the parison, (n_node,).
        listed: True if it is a list of numbers (n,), such as one for each term of a law.
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
