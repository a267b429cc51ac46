"""Parts of a scene that a user may have written, checked and with arrays for numbers: laws, loadings and fields."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.core.errors import InputError, warn_of
from jaxform.core.pytree import as_real, is_registered, list_parameter_names, nodal_parameter_names, parameter_ranges
from jaxform.core.ranges import as_numbers, check, check_one
from jaxform.loads import (
    Interval,
    Loading,
    Pressure,
    RegionalLoad,
    TwoSidedLoad,
    first_pressure,
    list_gases,
    next_pressure,
)
from jaxform.materials import Cooling, Law, Modes, Shift
from jaxform.mesh import bisection
from jaxform.model.field import Field
from jaxform.model.scene import Parison, Refinement, Solver
from jaxform.tools.mold import Mold

_RESERVED = ("reference", "thickness", "initial_thickness", "contact_time", "slip_distance")  # in final.vtu


def validate_law(material: Law, count: int, forest: bisection.TriangleForest | None) -> Law:
    """The law of a scene with so many nodes, its zones with values at all nodes of its forest.

    Raises:
        InputError: It is none, or a number is not one number in its range, nor one at each node.
    """
    if not is_registered(material, Law):
        raise InputError(
            "is not a material model", "derive its class from jaxform.Law, decorated with jaxform.law", "material"
        )
    made = _replace_values(material, {"viscous": _modes(material.viscous), "shift": _shift(material.shift)})
    made = _convert_numbers(made, "material", nodes={count} if forest is None else {count, len(forest.positions)})
    made.verify()
    if made.tension_field and made.viscous is not None:
        problem, remedy = (
            "cannot be combined with Prony terms, whose stress may be compressive",
            "leave out one of the two",
        )
        raise InputError(problem, remedy, "material.tension_field", True)
    if forest is None:
        return made
    ends, depth = forest.ends, forest.depth
    return made.with_zones(
        {
            name: as_real(bisection.extend_values(np.asarray(values).T, ends, depth).T)
            for name, values in made.zones.items()
            if values.shape[-1] < len(forest.positions)
        }
    )


def _modes(modes: Modes | None) -> Modes | None:
    if modes is None:
        return None
    key = "material.viscous"
    if not is_registered(modes, Modes):
        raise InputError("are not Prony terms", "use jaxform.Christensen or jaxform.Maxwell", key)
    made = _convert_numbers(modes, key)
    if made.modulus.shape != made.time.shape:
        problem = f"has {made.time.size} entries, modulus has {made.modulus.size}"
        raise InputError(problem, "give one for each Prony term", f"{key}.time")
    return made


def _shift(shift: Shift | None) -> Shift | None:
    if shift is not None and not is_registered(shift, Shift):
        raise InputError(
            "is not a time-temperature shift", "use jaxform.Wlf, Arrhenius or ArrheniusStiffness", "material.shift"
        )
    return None if shift is None else _convert_numbers(shift, "material.shift", nodes=set())


_LEAST_WALL = 0.3  # of the initial thickness, of a wall that windows are planned for
_ON_MOLD = 2 / 3  # of an element, that touches the mold while it still moves


def validate_cooling(given: Cooling | None, fields: Collection[str], surfaces: Sequence[Mold]) -> Cooling | None:
    """The cooling of a scene, with arrays for numbers.

    Raises:
        InputError: It is none, a number is out of its range, or a field has the name of the temperature.
    """
    if given is None:
        return None
    if not isinstance(given, Cooling):
        raise InputError("is not a cooling model", "use jaxform.Cooling", "cooling")
    names = [name for name in parameter_ranges(given) if getattr(given, name) is not None]
    for name in names:
        check_one(f"cooling.{name}", getattr(given, name))
    if "temperature" in fields:
        problem = "has the name of the sheet's temperature, which the scene computes"
        raise InputError(problem, "give it another name", "fields.temperature")
    if float(given.mold) > 0.0 and not surfaces:
        warn_of("there is no mold to cool the sheet", "give [mold], or leave it out", key="cooling.mold")
    return _replace_values(given, {name: as_real(getattr(given, name)) for name in names})


def check_temperature(material: Law, parison: Parison, cooling: Cooling | None, tools: Sequence[Mold]) -> None:
    """Raises InputError where a shift and the temperature do not go together; warns where that changes nothing."""
    shift, temperature = material.shift, parison.temperature
    rubs = any(tool.contact.needs_temperature for tool in tools)
    if rubs and temperature is None:
        remedy = "give the sheet's temperature, which a friction over the temperature needs, or make that one number"
        raise InputError("is missing", remedy, "parison.temperature")
    if shift is None and cooling is None:
        if rubs:
            return
        if temperature is not None:
            remedy = "give [material.shift], or leave the temperature out"
            warn_of(
                "the temperature has no effect: the material does not depend on it",
                remedy,
                key="parison.temperature",
            )
        return
    if temperature is None:
        asking = "[material.shift]" if cooling is None else "[cooling]"
        raise InputError("is missing", f"give the sheet's temperature, which {asking} needs", "parison.temperature")
    if shift is None:
        return
    lowest, coldest = float(np.min(np.asarray(temperature))), float(shift.coldest())
    for name in ("air", "mold") if cooling is not None else ():
        # It is glass there, as `Shift.factor` has it.
        value = float(getattr(cooling, f"{name}_temperature"))
        if float(getattr(cooling, name)) > 0.0 and value <= coldest < lowest:
            problem = f"is below {coldest:g} degC, where the shift is not defined: below it the sheet no longer relaxes"
            warn_of(
                problem,
                "make sure that the sheet is formed before it gets there",
                key=f"cooling.{name}_temperature",
                value=value,
            )
    if lowest <= coldest:
        problem = f"is not above {coldest:g} degC, where the shift is not defined"
        raise InputError(problem, "check material.shift and the units", "parison.temperature", lowest)
    if material.viscous is None and not shift.stiffens:
        problem = "has no effect: it shifts the times of Prony terms, and there are none"
        warn_of(problem, "give [material.viscous], or leave it out", key="material.shift")


def coldest_temperature(
    parison: Parison, cooling: Cooling | None, solver: Solver, material: Law, tools: Sequence[Mold] = ()
) -> tuple[jax.Array | None, float]:
    """The temperature (n_node,) [degC] that windows are planned for, and by how much the sheet cools at most [K].

    They are computed for a thin wall at the end, in the air and beside the mold or any of the tools.
    """
    temperature = parison.temperature
    if cooling is None or temperature is None:
        return temperature, 0.0
    thin, rest = (temperature, _LEAST_WALL * parison.thickness), (material.density, solver.end_time)
    free = cooling.cooled(*thin, as_real(0.0), *rest)
    beside = [cooling.cooled(*thin, as_real(_ON_MOLD), *rest)]
    for tool in tools:
        numbers = {
            "mold": cooling.mold if tool.heat_transfer is None else tool.heat_transfer,
            "mold_temperature": cooling.mold_temperature if tool.temperature is None else tool.temperature,
        }
        beside.append(_replace_values(cooling, numbers).cooled(*thin, as_real(_ON_MOLD), *rest))
    most = max(float(np.abs(np.asarray(temperature - each)).max()) for each in (free, *beside))
    return jnp.minimum(temperature, free), most


_IN_PLANE = 1e-9  # of the size of sheet and tool: what is as near to a symmetry plane is in it


def check_motion(mold: Mold, parison: Parison) -> None:
    """Refuses a mold that moves through a symmetry plane of the parison, or away from it after it touched it.

    A mold half may close: it moves towards the plane, with all of it on the side of the parison, and rests in the end.

    Raises:
        InputError: If it moves otherwise.
    """
    if mold.motion is None:
        return
    fixed = np.asarray(parison.fixed) & ~np.asarray(parison.clamped)[:, None]
    direction = np.asarray(mold.motion.direction, float)
    for axis in np.flatnonzero(fixed.any(0) & (direction != 0.0)):
        if not _closes_on_plane(mold, parison, int(axis), fixed[:, axis]):
            problem = f"{mold.describe()} moves across a symmetry plane (normal to {'xyz'[axis]}), or back from it"
            remedy = "move it within the plane, or towards it up to the plane, or give the whole parison"
            raise InputError(problem, remedy, "mold.motion.direction", direction.tolist())


def _closes_on_plane(mold: Mold, parison: Parison, axis: int, fixed: np.ndarray) -> bool:
    """True if a mold moves on the parison's side of a symmetry plane, and stays where it first touches that."""
    assert mold.motion is not None
    places = np.asarray(parison.positions, float)[:, axis]
    times = np.asarray(mold.motion.time, float).tolist()
    gaps = np.array([mold.vertices_at(time)[np.unique(np.asarray(mold.triangles)), axis] for time in times])
    near = _IN_PLANE * max(np.ptp(places), np.ptp(gaps))
    if np.ptp(places[fixed]) > near:
        return False  # as of a tube whose ends are guided
    level = places[fixed].mean()
    side = 1.0 if places.mean() > level else -1.0
    gap = (side * (gaps - level)).min(1)
    touched = np.maximum.accumulate(gap <= near)
    return bool(np.all(side * (places - level) >= -near) and np.all(gap >= -near) and np.all(gap[touched] <= near))


_BEHIND = 256  # roundings of its size, that a plate in a symmetry plane lies behind it: four times what is a touch


def set_behind_plane(tool: Mold, parison: Parison) -> Mold:
    """A tool at rest that lies in a symmetry plane of the parison, as a parting plane does, a rounding behind it.

    There nodes that the symmetry holds in the plane do not touch it; others that come to the plane do. Any other tool
    is returned as it is.
    """
    if tool.motion is not None:
        return tool
    places, fixed = (
        np.asarray(parison.positions, float),
        np.asarray(parison.fixed) & ~np.asarray(parison.clamped)[:, None],
    )
    vertices = np.array(tool.vertices)
    size = np.abs(vertices).max() + np.ptp(vertices, axis=0).max()
    for axis in np.flatnonzero(fixed.any(0)):
        level = places[fixed[:, axis], axis].mean()
        if np.ptp(places[fixed[:, axis], axis]) <= _IN_PLANE * size >= np.abs(vertices[:, axis] - level).max():
            side = 1.0 if places[:, axis].mean() > level else -1.0
            vertices[:, axis] = level - side * _BEHIND * np.finfo(vertices.dtype).eps * size
            return dataclasses.replace(tool, vertices=as_real(vertices))
    return tool


def validate_tools(tools: Sequence[Mold]) -> list[Mold]:
    """The tools besides the mold, each with a name.

    Raises:
        InputError: If one is no tool, or two have the same name.
    """
    made: list[Mold] = []
    for number, tool in enumerate(tools, 1):
        if not isinstance(tool, Mold):
            raise InputError("is not a tool", "use make_mold", f"tools[{number - 1}]")
        name = tool.name or f"tool{number}"
        if name == "mold" or name in [other.name for other in made] or not name.replace("-", "_").isidentifier():
            remedy = "give each tool a name of its own, in letters, digits and -, other than mold"
            raise InputError("cannot be this tool's name", remedy, "tool.name", name)
        made.append(dataclasses.replace(tool, name=name))
    return made


def validate_loading(pressure: Loading) -> Loading:
    """The loading of a scene.

    Raises:
        InputError: It is none, a number is out of its range, or the pressure of a moment is not one number.
    """
    if not is_registered(pressure, Loading):
        remedy = "use make_pressure, or derive its class from jaxform.Loading, decorated with jaxform.loading"
        raise InputError("is not a loading", remedy, "pressure")
    made = _convert_numbers(pressure, "pressure")
    if isinstance(made, TwoSidedLoad):
        made = _replace_values(made, {name: validate_loading(getattr(made, name)) for name in ("inside", "trapped")})
    shape = ()
    if isinstance(made, RegionalLoad):
        made, shape = _replace_values(made, {"loads": tuple(map(validate_loading, made.loads))}), (len(made.loads),)
    none, time = as_real(np.zeros(shape)), as_real(0.0)
    first = _shapes("pressure", first_pressure, made, none)
    if first.pressure.shape != shape:
        raise InputError(f"gives pressures of shape {first.pressure.shape}", "let `at` return one number", "pressure")
    later = _shapes("pressure", next_pressure, made, first, Interval(time, time, none, none))
    if _kinds(later) != _kinds(first):
        shapes = f"{_words(later.state)}, than at first, {_words(first.state)}"
        problem = f"has another state after a step, {shapes}"
        raise InputError(problem, "let `after` return arrays of the same shapes as `start`", "pressure")
    return made


def _kinds(tree: Any) -> Any:
    return jax.tree.structure(tree), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]


def _words(state: Any) -> str:
    kinds = [f"{leaf.dtype}{list(leaf.shape)}" for leaf in jax.tree.leaves(state)]
    return ", ".join(kinds) or "none"


def validate_field(name: str, given: Field, count: int, forest: bisection.TriangleForest | None) -> Field:
    """A field of a parison with so many nodes, with values at all nodes of its forest.

    Raises:
        InputError: It is none, cannot have that name, or its numbers or first values do not fit the mesh.
    """
    key = f"fields.{name}"
    if not is_registered(given, Field):
        raise InputError("is not a field", "derive its class from jaxform.Field, decorated with jaxform.field", key)
    if name in _RESERVED or name.startswith("contact_duration_") or not name.isidentifier():
        raise InputError("cannot be a field's name", f"give a name in letters, none of {', '.join(_RESERVED)}", key)
    made, new = _convert_numbers(given, key), {}
    whole = count if forest is None else len(forest.positions)
    for part in nodal_parameter_names(made):
        values = np.asarray(getattr(made, part))
        if values.ndim and values.shape != (count,):
            problem = f"needs one number, or one at each node: {count}, not {values.shape}"
            raise InputError(problem, "match the mesh", f"{key}.{part}")
        if forest is not None and values.ndim and len(values) < whole:
            values = bisection.extend_values(values, forest.ends, forest.depth)
        new[part] = as_real(np.broadcast_to(values, (whole,)))
    made = _replace_values(made, new)
    shape = _shapes(key, made.start, as_real(np.zeros((whole, 3)))).shape
    if shape != (whole,):
        raise InputError(f"starts with values of shape {shape}", f"let `start` return ({whole},)", key)
    return made


def _convert_numbers[T](part: T, section: str, nodes: set[int] | None = None) -> T:
    """A part whose numbers are arrays, each in its range: where `nodes` are given one number, or so many."""
    lists = list_parameter_names(part)
    ranges = {name: allowed for name, allowed in parameter_ranges(part).items() if getattr(part, name) is not None}
    for name, allowed in ranges.items():
        key, given = f"{section}.{name}", getattr(part, name)
        check(key, given, allowed)
        shape, listed = as_numbers(key, given).shape, name in lists
        if listed and (len(shape) == 0 or shape[0] == 0 or len(shape) > 1 + (nodes is not None)):
            raise InputError("is not a list of numbers", "give one for each term", key, given)
        if nodes is not None and len(shape) > int(listed) and (len(shape) > 1 + listed or shape[-1] not in nodes):
            many = " or ".join(map(str, sorted(nodes)))
            problem = f"has shape {shape}, is not one number, nor one at each node ({many})"
            raise InputError(problem, allowed.remedy, key)
    return _replace_values(part, {name: as_real(as_numbers(name, getattr(part, name))) for name in ranges})


def _replace_values[T](part: T, values: dict[str, Any]) -> T:
    return dataclasses.replace(part, **values)  # pyright: ignore[reportArgumentType, reportReturnType]


def _shapes(key: str, function: Any, *arguments: Any) -> Any:
    """The shapes of the output of a user's function, which is not evaluated."""
    try:
        return jax.eval_shape(function, *arguments)
    except (TypeError, ValueError, AttributeError) as error:
        reason = str(error).strip().split("\n")[0]
        raise InputError(f"cannot be traced by JAX ({reason})", "use jax.numpy, and return one array", key) from error


def check_gas(pressure: Loading, volume: Any) -> None:
    """Raises InputError where a gas has no volume [m^3] at first; the sheet encloses one, or its regions (n_load,)."""
    for key, gas in list_gases(pressure).items():
        under = volume
        if isinstance(pressure, RegionalLoad):
            under = pressure.own_volumes(volume)[pressure.names.index(key.removeprefix("gas."))]
        if (first := float(gas.gas_volume(as_real(under)))) > 0.0:
            continue
        key = f"{key if isinstance(pressure, RegionalLoad) else 'gas'}.dead_volume"
        remedy = f"give {key}, or a sheet that encloses a volume along its normals"
        if gas.closed_by == "mold":
            remedy = f"give the volume of the mold's cavity, above the {float(under):.3g} m^3 under the sheet"
        raise InputError(f"the gas has a volume of {first:.3g} m^3 at first", remedy, key)


def check_clamp_opening(parison: Parison, pressure: Loading, solver: Solver, surfaces: Sequence[Mold]) -> None:
    """Raises InputError where a clamp opens before the end that closes a gas.

    Warns where it opens after the end, and where a pressure then goes on that blows the sheet away.
    """
    until, end = float(np.asarray(parison.clamp_until)), float(solver.end_time)
    key = "parison.clamp_until"
    if until >= end:
        remedy = "let it open earlier, or leave it out"
        warn_of(f"the clamp does not open before the end at {end:g} s", remedy, key=key, value=until)
    elif pressure.follows_volume:
        remedy = "leave it out, or give [pressure] instead of the gas"
        raise InputError("lets out the gas that the clamped sheet encloses", remedy, key, until)
    elif isinstance(pressure, Pressure) and _pushes_on(pressure, until, end, held=bool(surfaces)):
        problem = "the pressure still rises after the clamp has opened, and blows away what does not touch a tool yet"
        if not surfaces:
            problem = "the pressure goes on after the clamp has opened, and nothing holds the sheet"
        warn_of(problem, "let the pressure end with the clamp, or open it later", key=key, value=until)


def _pushes_on(pressure: Pressure, begin: float, end: float, held: bool) -> bool:
    """True if a pressure rises between two times [s] or, where no tool holds the sheet, acts at the later one."""
    time, value = np.asarray(pressure.time, float), np.asarray(pressure.value, float)
    # Between its knots a pressure rises or falls all the way.
    size = np.abs(np.interp([begin, *time[(time > begin) & (time < end)], end], time, value))
    return bool(size.max() > (1.0 + 1e-6) * size[0] or (not held and size[-1] > 0.0))


def check_smooth_landing(solver: Solver, surfaces: Sequence[Mold]) -> None:
    """Raises InputError where nodes would land on curved paths on tools that move or that they do not stick to.

    Warns where there are no tools.
    """
    if not solver.smooth_landing:
        return
    key = "solver.smooth_landing"
    if solver.edge_contact:
        raise InputError("cannot be combined with solver.edge_contact", "leave one of the two out", key, True)
    if any(surface.motion is not None or not surface.contact.sticks for surface in surfaces):
        problem = "needs tools at rest that the sheet sticks to"
        raise InputError(problem, 'leave it out, or use contact = "stick" and no motion', key, True)
    if not surfaces:
        warn_of("has no effect: there is no tool to land on", "leave it out", key=key, value=True)


def check_weight(solver: Solver, refinement: Refinement | None) -> None:
    """Raises InputError where gravity would act on the added mass of mass scaling."""
    if solver.gravity is None or refinement is None or not int(refinement.mass_scaling_levels):
        return
    remedy = "leave out refinement.mass_scaling_levels, or solver.gravity"
    raise InputError("would act on the mass that mass scaling adds", remedy, "solver.gravity")
