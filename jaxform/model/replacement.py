"""`replace`, which changes numbers of a scene, and the handling of traced numbers that are out of range."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxform.core.compilation import with_standard_promotion
from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, parameter_ranges
from jaxform.core.ranges import BITS, DESIGNABLE, RANGES, WORDS, Range, as_numbers, check, declared_ranges
from jaxform.loads import Loading, RegionalLoad
from jaxform.materials import Law, Modes, Shift
from jaxform.model.field import Field
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW

_SIDES = ("pressure.inside.", "pressure.trapped.")  # where the loads of a `TwoSidedLoad` are
_DECLARING = (Law, Modes, Shift, Loading, Field)  # parts that declare their numbers


@with_standard_promotion
def replace(scene: Scene, changes: Mapping[str, ArrayLike]) -> Scene:
    """A scene with other numbers at dotted paths, such as {"pressure.value": new}; the way to differentiate.

    A new value has the shape of the old one, or is broadcast to it; a material parameter may have a value at each node
    of the parison instead, (..., n_node). Meshes cannot be replaced: build a new scene. Traced values are not checked
    here: if one is out of its range, `simulate` simulates nothing and its status has `INPUT`.

    Raises:
        InputError: If a path does not exist or does not fit the scene, or a value is not a real number, has another
            shape or, if it is not traced, is not finite or out of its range.
    """
    check_scene(scene)
    before = scene
    if not isinstance(changes, Mapping):
        raise InputError("is not a mapping of paths to values", 'give {"pressure.value": new}', "changes", changes)
    for path, value in changes.items():
        old = _designable(scene, str(path))
        scene = _replace_at(scene, str(path), _convert_value(str(path), value, old, scene))
    return _keep_window_count(scene, before) if "solver.end_time" in changes else scene


def _keep_window_count(scene: Scene, before: Scene) -> Scene:
    """Shortens the windows of a run that ends sooner: checks, such as of kinetic energy, are at their ends."""
    longest, ends = scene.tables.longest_window, (before.solver.end_time, scene.solver.end_time)
    if any(isinstance(number, Tracer) or np.ndim(number) for number in (longest, *ends)):
        return scene
    shorter, most = int(longest), int(longest) * float(ends[1]) / float(ends[0])
    while shorter > max(most, SHORT_WINDOW):
        shorter //= 2
    return dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, longest_window=np.int32(shorter)))


def check_scene(scene: Any) -> None:
    """Raises InputError unless it is a scene of the precision that JAX computes in."""
    if not isinstance(scene, Scene):
        raise InputError("is not a scene", "use jaxform.load or jaxform.build_scene", "scene", scene)
    built, now = scene.parison.positions.dtype, jnp.result_type(float)
    if built != now:
        problem = f"was built in {built}, and JAX computes in {now}: x64 was switched since"
        raise InputError(problem, "load or build the scene again, or switch jax_enable_x64 back", "scene")


def _replace_at(scene: Scene, path: str, values: Any) -> Scene:
    """A scene with other values at a path."""
    part, _, name = path.rpartition(".")
    owner: Any = dataclasses.replace(_owner(scene, part), **{name: values})
    if (place := _region_number(scene, part)) is not None:
        loads = tuple(owner if k == place else load for k, load in enumerate(scene.pressure.loads))
        return dataclasses.replace(scene, pressure=dataclasses.replace(scene.pressure, loads=loads))
    if part.startswith("fields."):
        return dataclasses.replace(scene, fields={**scene.fields, part.removeprefix("fields."): owner})
    if part.startswith("tools.") and part.count(".") == 1:
        place = _tool_number(scene, part.removeprefix("tools."))
        return dataclasses.replace(
            scene, tools=tuple(owner if k == place else tool for k, tool in enumerate(scene.tools))
        )
    return _replace_at(scene, part, owner) if "." in part else dataclasses.replace(scene, **{part: owner})


def _owner(scene: Scene, part: str) -> Any:
    """The part of a scene that paths such as "material.viscous" and "fields.hot" name; None where there is none."""
    if part.startswith("fields."):
        return scene.fields.get(part.removeprefix("fields."))
    if (place := _region_number(scene, part)) is not None:
        return scene.pressure.loads[place]
    owner: Any = scene
    names = part.split(".")
    if names[0] == "tools":
        place = _tool_number(scene, names[1]) if len(names) > 1 else None
        owner, names = None if place is None else scene.tools[place], names[2:]
    for name in names:
        owner = getattr(owner, name, None)
    return owner


def _tool_number(scene: Scene, name: str) -> int | None:
    """The number of a tool of this name, or with this number as text; None where there is none."""
    names = [tool.name for tool in scene.tools]
    if name in names:
        return names.index(name)
    return int(name) if name.isdecimal() and int(name) < len(names) else None


def _region_number(scene: Scene, part: str) -> int | None:
    """The number of the load of a region that a path such as "pressure.left" names; None of any other part."""
    section, _, name = part.partition(".")
    regional = section == "pressure" and isinstance(scene.pressure, RegionalLoad)
    return scene.pressure.index(name) if regional else None


def check_numbers(scene: Scene) -> None:
    """Raises InputError unless every number of a scene, none of them traced, is in its range."""
    for path, values in _designable_numbers(scene).items():
        check(path, values, _range(path, scene))


def sanitize_parameters(scene: Scene) -> tuple[Scene, jax.Array]:
    """A scene with all parameters in their ranges, and the bits of those of `DESIGNABLE` that were out of range.

    If any was, the scene has no pressure, so that the sheet stays at rest: under `vmap` its windows are computed beside
    others, and neither they nor their derivatives overflow.
    """
    found, bits = {}, jnp.zeros(WORDS, jnp.int32)
    for path, values in _designable_numbers(scene).items():
        allowed = _range(path, scene)
        good = allowed.contains(jax.lax.stop_gradient(values))
        if allowed.increasing:
            good = jnp.broadcast_to(jnp.all(good) & jnp.all(jnp.diff(values) > 0), values.shape)
        bits |= jnp.where(jnp.all(good), 0, _bit(DESIGNABLE.index(_key(path))))
        found[path] = jnp.where(good, values, _substitute(path, values, good, scene))
    for path in found:
        if _key(path) == "pressure.value":
            found[path] = jnp.where(jnp.all(bits == 0), found[path], 0.0)
    for path, values in found.items():
        scene = _replace_at(scene, path, values)
    return scene, bits


def _bit(place: int) -> np.ndarray:
    """One of `DESIGNABLE`, as bits (WORDS,)."""
    bits = np.zeros(WORDS, np.int32)
    bits[place // BITS] = 1 << place % BITS
    return bits


def describe_out_of_range(bits: np.ndarray) -> str:
    """The numbers that are out of range, each with its admissible range, as text."""
    paths = [path for k, path in enumerate(DESIGNABLE) if np.any(bits & _bit(k))]
    return ", ".join(f"{path} {' or '.join(map(_rule, declared_ranges(path)))}" for path in paths)


def _rule(allowed: Range) -> str:
    rule, unit = allowed.rule, f"[{allowed.unit}] " if allowed.unit else ""
    whole = rule if "finite" in rule else f"must be finite and {rule.removeprefix('must ').removeprefix('be ')}"
    return f"{unit}{whole}"


def _substitute(path: str, values: jax.Array, good: jax.Array, scene: Scene) -> jax.Array | float:
    if path == "parison.thickness":
        count, usual = jnp.sum(good), 0.01 * scene.tables.size
        mean = jnp.sum(jnp.where(good, jax.lax.stop_gradient(values), 0.0)) / jnp.maximum(count, 1)
        return jnp.where(count > 0, mean, usual)
    if path == "parison.temperature":
        shift = scene.material.shift
        return 20.0 if shift is None else jax.lax.stop_gradient(shift.reference)
    if _key(path) in ("pressure.time", "mold.motion.time"):
        return jnp.arange(values.size, dtype=values.dtype)
    allowed = _range(path, scene)
    if allowed.above is None:
        return allowed.least or 0.0
    return 1.0 + allowed.above if allowed.most is None else 0.5 * (allowed.above + allowed.most)


def _range(path: str, scene: Scene) -> Range:
    part, _, name = path.rpartition(".")
    owner = _owner(scene, part)
    return parameter_ranges(owner)[name] if isinstance(owner, _DECLARING) else RANGES[_key(path)]


def _key(path: str) -> str:
    """A path as `DESIGNABLE` has it.

    Fields' numbers are without the field's name, those of tools as the mold's, of several loads as those of one.
    """
    if path.startswith("tools."):
        return f"mold.{path.split('.', 2)[-1]}"
    if path.startswith("pressure."):
        return f"pressure.{path.rpartition('.')[2]}"
    return f"fields.{path.rpartition('.')[2]}" if path.startswith("fields.") else path


def _designable_numbers(scene: Scene) -> dict[str, jax.Array]:
    """Those of `DESIGNABLE` that the scene has; a declared part may have a method of the name of another's number."""
    field_paths = [f"fields.{name}.{key}" for name, field in scene.fields.items() for key in parameter_ranges(field)]
    of_molds = [path.removeprefix("mold.") for path in DESIGNABLE if path.startswith("mold.")]
    tool_paths = [f"tools.{k}.{path}" for k in range(len(scene.tools)) for path in of_molds]
    sides = (
        [f"pressure.{k}." for k in range(len(scene.pressure.loads))]
        if isinstance(scene.pressure, RegionalLoad)
        else _SIDES
    )
    side_paths = [side + path.removeprefix("pressure.") for side in sides for path in _load_paths()]
    paths = (*DESIGNABLE, *field_paths, *tool_paths, *side_paths)
    found = {path: number_at(scene, path) for path in paths if _is_declared(scene, path)}
    return {path: values for path, values in found.items() if values is not None}


def _load_paths() -> list[str]:
    """Those of `DESIGNABLE` that are numbers of loads."""
    return [path for path in DESIGNABLE if path.startswith("pressure.")]


def _is_declared(scene: Scene, path: str) -> bool:
    """False where a path's part declares its numbers, and none of that name."""
    part, _, name = path.rpartition(".")
    owner = _owner(scene, part)
    return not isinstance(owner, _DECLARING) or name in parameter_ranges(owner)


def number_at(scene: Scene, path: str) -> Any:
    """The number of a scene at a path, or another value there; None if there is none."""
    part, _, name = path.rpartition(".")
    return getattr(_owner(scene, part), name, None)


def _designable(scene: Scene, path: str) -> jax.Array:
    old = number_at(scene, path) if _is_declared(scene, path) else None
    if _key(path) in DESIGNABLE and old is not None:
        return old
    if old is not None:
        raise InputError("the scene's tables depend on it", "build a new scene with `build_scene` or `load`", path)
    known = list(_designable_numbers(scene))
    close = difflib.get_close_matches(path, known, n=1)
    remedy = f"did you mean {close[0]}?" if close else f"choose one of {', '.join(known)}"
    raise InputError("this scene has no such parameter", remedy, path)


def _convert_value(path: str, value: ArrayLike, old: jax.Array, scene: Scene) -> jax.Array:
    arrays = [leaf for leaf in jax.tree.leaves(value) if isinstance(leaf, jax.Array)]
    new = _as_array(path, value) if arrays else as_real(as_numbers(path, value))
    shapes = _shapes(path, old, scene)
    if new.shape not in shapes:
        try:
            new = jnp.broadcast_to(new, old.shape)
        except ValueError:
            raise InputError(f"has shape {new.shape}", f"give shape {' or '.join(map(str, shapes))}", path) from None
    if not isinstance(new, Tracer):
        check(path, new, _range(path, scene))
    return new


def _shapes(path: str, old: jax.Array, scene: Scene) -> list[tuple[int, ...]]:
    """The shapes that a number may have; a number of the law may also have one value per node, for zones."""
    part, _, name = path.rpartition(".")
    if part != "material":
        return [old.shape]
    shape = old.shape[:-1] if name in scene.material.zones else old.shape
    return [shape, (*shape, len(scene.parison.thickness))]


def _as_array(path: str, value: Any) -> jax.Array:
    try:
        new = jnp.asarray(value)
    except (ValueError, TypeError):
        raise InputError("is not an array of numbers", "give real numbers", path) from None
    if not (jnp.issubdtype(new.dtype, jnp.floating) or jnp.issubdtype(new.dtype, jnp.integer)):
        raise InputError(f"has type {new.dtype}", "give real numbers", path)
    return as_real(new)
