"""The paper's three scenes as functions: the built-in scene files with other numbers.

    scene = jaxform.scenes.dish(depth=0.1, elements=600)

What is not given is as in the scene file beside this module (`dish.toml`, `box-insert.toml`, `soap-bottle.toml`), so
that without arguments each function is `jaxform.load` of the same name. Where a whole table of the file can be given
(`material`, `pressure`, `refinement`), its keys are those of the file; those left out stay as they are.

Geometry is built here, on the host. What is to be differentiated (thickness, pressure, material) is put in afterwards
by `jaxform.replace`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jax.core import Tracer
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.core.ranges import current_keys
from jaxform.io import files
from jaxform.mesh.shapes import Symmetry
from jaxform.model.scene import Scene

Keys = Mapping[str, Any]
"""Keys and values of a table of a scene file."""

__all__ = ["box_insert", "dish", "exact_wall", "soap_bottle"]


def dish(
    *,
    radius: float | None = None,
    depth: float | None = None,
    wall_angle: float | None = None,
    elements: int | None = None,
    element_size: float | Keys | None = None,
    symmetry: Symmetry | None = None,
    thickness: float | Keys | None = None,
    material: Keys | None = None,
    pressure: float | Keys | None = None,
    end_time: float | None = None,
    damping: float | None = None,
    refinement: Keys | Literal[False] | None = None,
) -> Scene:
    """Thermoforming of a round sheet into a cup with a flat bottom (paper, 4.1).

    The file's element count puts a ring of nodes where the file's cup has its corner; with other proportions, refine.

    Args:
        radius: Radius of the sheet and of the cup's opening [m].
        depth: Depth of the cup [m].
        wall_angle: Angle of the cup's wall to the sheet [degrees], 90 for a cylinder.
        elements: Approximate initial number of triangles of the modelled part; or
        element_size: Length of the edges [m], a number or a profile {along = "radius", at, value}.
        symmetry: Symmetry of the model: 'none', 'half' or 'quarter' of the sheet.
        thickness: Thickness of the sheet [m], a number or a profile {along, at, value}.
        material: Keys of [material]: model and its constants [Pa], density [kg/m^3].
        pressure: The last value [Pa], the others in proportion; or keys of [pressure].
        end_time: End of the simulation [s].
        damping: Mass-proportional damping [1/s].
        refinement: Keys of [refinement]; False for none.

    Returns:
        The scene, with all host work done.

    Raises:
        InputError: A number is out of range or they do not fit together; it names argument or key, value and remedy.
    """
    changes = {"parison.radius": radius, "parison.symmetry": symmetry, "parison.thickness": thickness}
    document = files.read_scene("dish")
    data = _table(document, changes, material, pressure, end_time, damping, refinement)
    _set_fineness(data, elements, element_size)
    if (radius, depth, wall_angle) != (None, None, None):
        data["mold"]["profile"] = _cup(data["mold"]["profile"], radius, depth, wall_angle)
    return _build("dish", document, data)


def box_insert(
    *,
    size: Sequence[float] | None = None,
    depth: float | None = None,
    insert_size: Sequence[float] | None = None,
    insert_height: float | None = None,
    draft: float | None = None,
    elements: int | None = None,
    element_size: float | None = None,
    symmetry: Symmetry | None = None,
    thickness: float | Keys | None = None,
    material: Keys | None = None,
    pressure: float | Keys | None = None,
    end_time: float | None = None,
    damping: float | None = None,
    refinement: Keys | Literal[False] | None = None,
) -> Scene:
    """Thermoforming of a rectangular sheet into a box with a raised block in its middle (paper, 4.2).

    Args:
        size: Sides of the sheet and of the box's opening [m], two numbers.
        depth: Depth of the box [m].
        insert_size: Sides of the block where it stands on the bottom [m], two numbers.
        insert_height: Height of the block [m], less than the depth.
        draft: Draft angle of the walls from the vertical [degrees].
        elements: Approximate initial number of triangles of the modelled part; or
        element_size: Length of the sides of its cells [m].
        symmetry: Symmetry of the model: 'none', 'half' or 'quarter' of the sheet.
        thickness: Thickness of the sheet [m], a number or a profile {along, at, value}.
        material: Keys of [material]: model and its constants [Pa], density [kg/m^3].
        pressure: The last value [Pa], the others in proportion; or keys of [pressure].
        end_time: End of the simulation [s].
        damping: Mass-proportional damping [1/s].
        refinement: Keys of [refinement]; False for none.

    Returns:
        The scene, with all host work done.

    Raises:
        InputError: A number is out of range or they do not fit together; it names argument or key, value and remedy.
    """
    changes = {
        "parison.size": size,
        "parison.symmetry": symmetry,
        "parison.thickness": thickness,
        "mold.size": size,
        "mold.depth": depth,
        "mold.insert_size": insert_size,
        "mold.insert_height": insert_height,
        "mold.draft": draft,
    }
    document = files.read_scene("box-insert")
    data = _table(document, changes, material, pressure, end_time, damping, refinement)
    _set_fineness(data, elements, element_size)
    return _build("box_insert", document, data)


def soap_bottle(
    *,
    height: float | None = None,
    radius: float | None = None,
    neck_radius: float | None = None,
    hole: Sequence[float] | None = None,
    swell: float | None = None,
    neck_swell: float | None = None,
    inset: float | None = None,
    element_size: float | None = None,
    mold_element_size: float | None = None,
    thickness: float | Keys | None = None,
    material: Keys | None = None,
    pressure: float | Keys | None = None,
    end_time: float | None = None,
    damping: float | None = None,
    refinement: Keys | Literal[False] | None = None,
) -> Scene:
    """Blow moulding of half a soap bottle with a handle from a flattened parison (paper, 4.3).

    Args:
        height: Height from bottom to neck [m].
        radius: Radius of the body [m].
        neck_radius: Radius of the neck [m].
        hole: Half width and half height of the handle's hole [m].
        swell: Inflation of the parison before the pressure is applied: 0 is flat, 1 the bottle.
        neck_swell: Inflation at the neck, where the blow pin holds it.
        inset: Distance of the parison's clamped edge inside the bottle's outline [m].
        element_size: Length of the parison's edges [m], halved where the bottle is narrow.
        mold_element_size: Length of the mold's edges [m].
        thickness: Thickness of the parison [m], a number or a profile {along, at, value}; y runs from bottom to neck.
        material: Keys of [material]: model and its constants [Pa], density [kg/m^3].
        pressure: The last value [Pa], the others in proportion; or keys of [pressure].
        end_time: End of the simulation [s].
        damping: Mass-proportional damping [1/s].
        refinement: Keys of [refinement]; the file has none. False for none.

    Returns:
        The scene, with all host work done.

    Raises:
        InputError: A number is out of range or they do not fit together; it names argument or key, value and remedy.
    """
    shape = {"height": height, "radius": radius, "neck_radius": neck_radius, "hole": hole}
    changes = {f"{part}.{key}": value for part in ("mold", "parison") for key, value in shape.items()}
    changes |= {"parison.swell": swell, "parison.neck_swell": neck_swell, "parison.inset": inset}
    changes |= {
        "parison.thickness": thickness,
        "parison.element_size": element_size,
        "mold.element_size": mold_element_size,
    }
    document = files.read_scene("soap-bottle")
    data = _table(document, changes, material, pressure, end_time, damping, refinement)
    return _build("soap_bottle", document, data)


def exact_wall(name: str = "dish") -> dict[str, NDArray[np.float64]]:
    """The exact solution that stands beside a built-in scene, of an independent computation along the meridian.

    Args:
        name: Name of the built-in scene.

    Returns:
        Arrays (n,): `initial_radius` [m], `arc` [m] from the axis in the formed part, `thickness_ratio` h/h0.

    Raises:
        InputError: If there is no such scene, or no exact solution of it.
    """
    found = files.read_reference(files.read_scene(name))
    if found is None:
        raise InputError("has no exact solution", "take dish or dish-coarse", "name", name)
    return found


def _table(
    document: files.SceneDocument,
    changes: Keys,
    material: Keys | None,
    pressure: float | Keys | None,
    end_time: float | None,
    damping: float | None,
    refinement: Keys | Literal[False] | None,
) -> dict[str, Any]:
    """The tables of a scene file with changes at dotted keys; what is None stays."""
    data = copy.deepcopy(document.data)
    changes = {**changes, "solver.end_time": end_time, "solver.damping": damping}
    for key, value in changes.items():
        if value is not None:
            table, _, last = key.partition(".")
            data[table][last] = _plain(key, value)
    if isinstance(material, Mapping) and "model" in material:
        # Another material model has other constants; of the file's only the density keeps its meaning.
        data["material"] = {"density": data["material"]["density"]}
    data["material"] = _merge("material", data["material"], material)
    data["pressure"] = _pressure(data["pressure"], pressure)
    if refinement is False:
        data.pop("refinement", None)
    elif refinement is not None:
        data["refinement"] = _merge("refinement", data.get("refinement", {}), refinement)
    return data


def _merge(key: str, table: dict[str, Any], keys: Any) -> dict[str, Any]:
    if keys is None:
        return table
    if not isinstance(keys, Mapping):
        raise InputError("is not a table", f"give keys of [{key}] and their values", key, keys)
    return table | {name: _plain(f"{key}.{name}", value) for name, value in current_keys(key, keys).items()}


def _pressure(table: dict[str, Any], pressure: Any) -> dict[str, Any]:
    if pressure is None or isinstance(pressure, Mapping):
        return _merge("pressure", table, pressure)
    last = _plain("pressure", pressure)
    if isinstance(last, bool) or not isinstance(last, int | float) or not math.isfinite(last):
        raise InputError("is neither a pressure nor a table", "give Pa, or keys of [pressure]", "pressure", pressure)
    return table | {"value": [value * last / table["value"][-1] for value in table["value"]]}


def _plain(key: str, value: Any) -> Any:
    """The value as a scene file could have it."""
    if isinstance(value, Tracer):
        problem = "is traced, but a scene is built on the host"
        raise InputError(problem, "build the scene first, then set the value with `jaxform.replace`", key)
    if isinstance(value, Mapping):
        return {name: _plain(f"{key}.{name}", item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(key, item) for item in value]
    return np.asarray(value).tolist() if hasattr(value, "dtype") else value


def _set_fineness(data: dict[str, Any], elements: Any, element_size: Any) -> None:
    """The one that is given takes the place of the file's; both are an error that the schema's users know."""
    given = {"elements": elements, "element_size": element_size}
    given = {key: _plain(f"parison.{key}", value) for key, value in given.items() if value is not None}
    if given:
        kept = {key: value for key, value in data["parison"].items() if key not in ("elements", "element_size")}
        data["parison"] = kept | given


def _cup(profile: list[list[float]], radius: Any, depth: Any, wall_angle: Any) -> list[list[float]]:
    """The cup's meridian, from the axis outwards, with other dimensions [m, m, degrees]."""
    (_, old_depth), (corner, _), (old_radius, _) = profile
    old_angle = math.degrees(math.atan2(old_depth, old_radius - corner))
    r = _check_range("radius", radius, old_radius, 0.0, math.inf)
    z = _check_range("depth", depth, old_depth, 0.0, math.inf)
    angle = _check_range("wall_angle", wall_angle, old_angle, 0.0, 90.0)
    # A right angle's tangent is finite in floating point: the wall is set upright.
    bottom = r if angle == 90 else r - z / math.tan(math.radians(angle))
    if bottom <= 0:
        least = math.degrees(math.atan2(z, r))
        remedy = f"reduce the depth, or give a wall_angle above {least:.3g} degrees"
        raise InputError(
            f"leaves no bottom: the side walls meet at {r * math.tan(math.radians(angle)):.4g} m", remedy, "depth", z
        )
    return [[0.0, z], [bottom, z], [r, 0.0]]


def _check_range(key: str, value: Any, otherwise: float, least: float, most: float) -> float:
    """The number, if it is above the least and not above the most."""
    number = otherwise if value is None else _plain(key, value)
    good = isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number)
    if not (good and least < number <= most):
        remedy = f"give a number above {least:g}" + (f", at most {most:g}" if math.isfinite(most) else "")
        raise InputError("is out of range", remedy, key, value)
    return float(number)


def _build(name: str, document: files.SceneDocument, data: dict[str, Any]) -> Scene:
    file = f"jaxform.scenes.{name}"
    return files.build(files.validate_scene(data, file, document.folder))
