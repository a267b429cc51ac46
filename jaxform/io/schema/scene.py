"""The scene file, and its table that selects the part."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, Tag, model_validator

from jaxform.core.ranges import MOST_STEPS
from jaxform.io.schema.material import Material
from jaxform.io.schema.mold import Mold, Tools, check_names, tool_name
from jaxform.io.schema.parison import Parison
from jaxform.io.schema.quantities import Triple
from jaxform.io.validation import (
    Coordinate,
    Number,
    Table,
    declared_range,
    form,
    validation_error,
)

# The table that selects the part from the formed sheet.


class TrimTable(Table):
    """A plane across an axis at which the part is cut off.

    Attributes:
        axis: Axis normal to the plane.
        at: Position of the plane along the axis [m], in formed positions.
        keep: Side that is the part.
    """

    axis: Literal["x", "y", "z"]
    at: Coordinate
    keep: Literal["above", "below"]


class PartTable(Table):
    """Selection of the part from the formed sheet: the elements that all keys hold for.

    Statistics, the thinnest place, mass, objectives, pictures and exports are then those of the part alone, without the
    sheet on clamp frame, platen, flanges and covers.

    Attributes:
        box: Lowest and highest corner [[x0, y0, z0], [x1, y1, z1]] [m] of the box for an element's centroid, in
            formed positions.
        trim: A plane at which the part is cut off.
        molds: Files of `mold.path`, by name, that the part touches: more of an element's nodes stick to these than to
            others. An element without contact belongs to its neighbours, a clamped node to no file.
        flash: True if the flash, which lies on the land of a mold half, counts as part.
    """

    box: Annotated[list[Triple], Field(min_length=2, max_length=2)] | None = None
    trim: TrimTable | None = None
    molds: Annotated[list[str], Field(min_length=1)] | None = None
    flash: bool = False

    @model_validator(mode="after")
    def _check(self) -> PartTable:
        if self.box is None and self.trim is None and self.molds is None and not self.flash:
            raise validation_error("is empty", "give box, trim, molds or flash, or leave [part] out", "", {})
        return self


class PressureTable(Table):
    """Pressure difference over time, held before the first and after the last knot.

    Attributes:
        time: Knots [s], increasing.
        value: Pressure difference [Pa], one per knot; it pushes to +z, or outwards.
        interpolation: Linear between the knots, or rising as the cube of the time elapsed since the last knot.
    """

    time: Annotated[list[Number], Field(min_length=1)]
    value: Annotated[list[Number], Field(min_length=1)]
    interpolation: Literal["linear", "cubic-ramp"] = "linear"


_Opening = Annotated[float, declared_range("gas.valve")]
_SupplyPressure = Annotated[float, declared_range("gas.supply_pressure")]
_N = TypeVar("_N")
AtKnots = Annotated[
    Annotated[_N, Tag("<number>")] | Annotated[list[_N], Tag("<list>")],
    form(lambda value: "list" if isinstance(value, list) else "number"),
]
"""A number, or one for each knot."""


class RegionTable(Table):
    """A part of the initial sheet: the elements whose centroid is between two places.

    Attributes:
        along: Place in the initial sheet: distance from the z axis, or a coordinate.
        between: The two places [m].
    """

    along: Literal["radius", "x", "y", "z"]
    between: Annotated[list[Coordinate], Field(min_length=2, max_length=2)]

    @model_validator(mode="after")
    def _check(self) -> RegionTable:
        if self.between[1] <= self.between[0]:
            raise validation_error("does not increase", "give the lower place first", "between", self.between)
        return self


def _region_form(value: Any) -> str:
    return "several" if isinstance(value, list) else "field" if isinstance(value, str) else "one"


def _field_name(text: str) -> str:
    if not re.fullmatch(r"field:[^=]+(=.+)?", text):
        raise validation_error("is not a region", _REGION, value=text)
    _, _, number = text.partition("=")
    try:
        float(number or 0.0)
    except ValueError:
        raise validation_error("does not end with a number", _REGION, value=text) from None
    return text


_REGION = 'give { along = "x", between = [0.0, 0.1] }, a list of such, or "field:NAME=1" of a mesh file'
Region = Annotated[
    Annotated[RegionTable, Tag("<one>")]
    | Annotated[Annotated[list[RegionTable], Field(min_length=1)], Tag("<several>")]
    | Annotated[Annotated[str, AfterValidator(_field_name)], Tag("<field>")],
    form(_region_form),
]
"""The elements that a gas pushes: between two places, several such conditions together, or by a field of the mesh."""


class GasTable(Table):
    """A gas that is blown into the sheet, or that the sheet traps in the mold; its pressure is a result.

    It has a mass flow, a supply behind a valve, a vent, or several of them; see `jaxform.Gas`. A gas in the mold may be
    given together with [pressure] or, as a second [[gas]], with one inside the sheet. Gases of several cavities are
    sections [[gas]] with a region each; the sheet is clamped along the borders of regions.

    Attributes:
        name: Name of the gas of a region, for keys and results; by default gas1, gas2, ... in their order.
        region: The elements of the initial sheet that it pushes: { along = "x", between = [0.0, 0.1] }, a list of such
            conditions that all hold, or "field:NAME=1", where that field of the mesh of `shape = "file"` has this
            value. All of them by default.
        time: Knots [s], increasing; values at them are linear between and held before and after. One at 0 is enough
            for a gas in the mold with constant values.
        mass_flow: Mass flow into the modelled part [kg/s], one per knot.
        supply_pressure: Gauge pressure of a supply behind a valve [Pa], a number or one per knot.
        orifice_area: Area of the open valve [m^2], of the modelled part: of a quarter a quarter.
        valve: Opening of the valve, 0 to 1, one per knot; open by default.
        vent_area: Area of the open vent to the outside [m^2], of the modelled part.
        vent: Opening of the vent, 0 to 1, one per knot; open by default.
        discharge_coefficient: Discharge coefficient of valve and vent.
        heat_capacity_ratio: Ratio of the heat capacities of the gas, for the flow through valve and vent, and where it
            is adiabatic.
        temperature: Initial temperature of the gas, and that of the inflow [K].
        gas_constant: Specific gas constant [J/(kg K)].
        ambient_pressure: Absolute pressure outside, and initially inside [Pa].
        dead_volume: Volume of the gas beside that under the sheet [m^3]; a flat sheet needs it. Closed by the mold,
            the volume of the mold's cavity, of the modelled part, of which the sheet takes its share.
        adiabatic: True if the gas exchanges no heat, so that its temperature varies; by default it is constant.
        closed_by: The surface that closes the volume: the `clamp`, that is the plane or the rings in which the sheet is
            clamped, or the `mold`, for the gas between the sheet and the mold, which resists the sheet.
    """

    name: str | None = None
    region: Region | None = None
    time: Annotated[list[Number], Field(min_length=1)] = Field(default_factory=lambda: [0.0])
    mass_flow: Annotated[list[Number], Field(min_length=1)] | None = None
    supply_pressure: AtKnots[_SupplyPressure] | None = None
    orifice_area: Annotated[float, declared_range("gas.orifice_area")] | None = None
    valve: list[_Opening] | None = None
    vent_area: Annotated[float, declared_range("gas.vent_area")] | None = None
    vent: list[_Opening] | None = None
    discharge_coefficient: Annotated[float, declared_range("gas.discharge_coefficient")] | None = None
    heat_capacity_ratio: Annotated[float, declared_range("gas.heat_capacity_ratio")] | None = None
    temperature: Annotated[float, declared_range("gas.temperature")] = 293.15
    gas_constant: Annotated[float, declared_range("gas.gas_constant")] = 287.06
    ambient_pressure: Annotated[float, declared_range("gas.ambient_pressure")] = 101325.0
    dead_volume: Annotated[float, declared_range("gas.dead_volume")] = 0.0
    adiabatic: bool = False
    closed_by: Literal["clamp", "mold"] = "clamp"

    @model_validator(mode="after")
    def _check_volume(self) -> GasTable:
        if self.closed_by == "mold" and not self.dead_volume:
            remedy = "give the volume of the mold's cavity [m^3], of the modelled part"
            raise validation_error("is missing for a gas that is closed by the mold", remedy, "dead_volume", None)
        if self.closed_by == "clamp" and "time" not in self.model_fields_set:
            raise validation_error("is missing", "give the times of the knots [s]", "time", None)
        return self

    @model_validator(mode="after")
    def _check(self) -> GasTable:
        if self.mass_flow is None and self.supply_pressure is None and self.closed_by == "clamp":
            remedy = "give mass_flow, or supply_pressure with orifice_area"
            raise validation_error("is missing, and no supply is given", remedy, "mass_flow", None)
        needs = {"supply_pressure": "orifice_area", "orifice_area": "supply_pressure", "valve": "orifice_area"}
        for key, other in {**needs, "vent": "vent_area"}.items():
            if getattr(self, key) is not None and getattr(self, other) is None:
                raise validation_error(f"is missing, but {key} is given", "give both", other, None)
        for key in ("discharge_coefficient", "heat_capacity_ratio"):
            used = self.through_orifices or (self.adiabatic and key == "heat_capacity_ratio")
            if getattr(self, key) is not None and not used:
                remedy = "give supply_pressure and orifice_area or vent_area, or leave it out"
                raise validation_error("has no effect without valve and vent", remedy, key, getattr(self, key))
        return self

    @property
    def numbers(self) -> dict[str, Any]:
        """The keys of the gas itself that are given, without its name and region."""
        return self.model_dump(exclude={"name", "region"}, exclude_none=True)

    @property
    def through_orifices(self) -> bool:
        """True where the gas has a supply or a vent, through which its pressure drives it."""
        return self.supply_pressure is not None or self.vent_area is not None


Gases = Annotated[
    Annotated[GasTable, Tag("<one>")] | Annotated[Annotated[list[GasTable], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]
"""A gas, or a list of them."""


class RefinementTable(Table):
    """Criteria and limits of adaptive refinement; see `jaxform.Refinement`.

    Attributes:
        angle: Largest angle of an element's and its neighbours' normals to their mean [degrees].
        interval: Steps between two refinements of the mesh, rounded up to whole windows.
        max_level: Elements at this level are bisected only for conformity with their neighbours.
        min_area: Smallest initial area of a bisected element's halves [m^2].
        base_level: Elements near a bent part of the mold are bisected to this level before they touch it.
        proximity_factor: Distance that counts as near, in units of the element's longest side.
        mass_scaling_levels: Number of the finest levels with mass scaling, so that they do not shorten the step.
        at_rest: True if new nodes close to the mold start at rest.
        jump: Largest relative difference of neighbours' thicknesses, their ratio less 1; unlimited without it.
        elements: Initial capacity for elements; the run increases it as needed.
    """

    angle: Annotated[float, declared_range("refinement.angle")] = 4.0
    interval: Annotated[int, declared_range("refinement.interval")] = 100
    max_level: Annotated[int, declared_range("refinement.max_level")] = 6
    min_area: Annotated[float, declared_range("refinement.min_area")] = 0.0
    base_level: Annotated[int, declared_range("refinement.base_level")] = 0
    proximity_factor: Annotated[float, declared_range("refinement.proximity_factor")] = 1.0
    mass_scaling_levels: Annotated[int, declared_range("refinement.mass_scaling_levels")] = 0
    at_rest: bool = True
    jump: Annotated[float, declared_range("refinement.jump")] | None = None
    elements: Annotated[int, declared_range("refinement.elements")] | None = None


Gravity = Annotated[float, declared_range("solver.gravity")]


class SolverTable(Table):
    """Time integration; `quasi_static` marks a slow process: the run then warns of a quasi-static error.

    Attributes:
        end_time: End of the simulation [s]; it ends earlier when nothing can move any more.
        damping: Mass-proportional damping [1/s]; none by default.
        gravity: Acceleration of gravity [x, y, z] [m/s^2]; none by default.
        safety: Factor on the longest stable step.
        quasi_static: True for a slow process: the run then warns if inertia or damping affects the wall.
        self_contact: True if films stick to each other that meet back to back in a fold (a web), while the mold rests.
        edge_contact: True if sides of elements are held at sharp edges of tools that they would pass between two nodes.
        smooth_landing: True if nodes land on curved paths and stop at the time of impact, not at the end of a step.
            With short steps (a safety of 0.6 or less) derivatives of a run then follow the trend of its results. For
            tools at rest that the sheet sticks to.
        max_steps: Limit on the steps of a run.
    """

    end_time: Annotated[float, declared_range("solver.end_time")]
    damping: Annotated[float, declared_range("solver.damping")] | None = None
    gravity: Annotated[list[Gravity], Field(min_length=3, max_length=3)] | None = None
    safety: Annotated[float, declared_range("solver.safety")] = 0.9
    quasi_static: bool = False
    self_contact: bool = False
    edge_contact: bool = False
    smooth_landing: bool = False
    max_steps: Annotated[int, declared_range("solver.max_steps")] = MOST_STEPS


class CoolingTable(Table):
    """Cooling of the sheet, to the air on both sides and to the mold in contact; see `jaxform.Cooling`.

    Attributes:
        heat_capacity: Specific heat capacity of the sheet [J/(kg K)].
        air: Heat transfer coefficient to the air [W/(m^2 K)].
        air_temperature: Temperature of the air [degC].
        mold: Heat transfer coefficient to the mold [W/(m^2 K)].
        mold_temperature: Temperature of the mold [degC].
        conductivity: Thermal conductivity of the sheet [W/(m K)]: its surfaces are then colder than its middle.
    """

    heat_capacity: Annotated[float, declared_range("cooling.heat_capacity")]
    air: Annotated[float, declared_range("cooling.air")] = 0.0
    air_temperature: Annotated[float, declared_range("cooling.air_temperature")] = 20.0
    mold: Annotated[float, declared_range("cooling.mold")] = 0.0
    mold_temperature: Annotated[float, declared_range("cooling.mold_temperature")] = 20.0
    conductivity: Annotated[float, declared_range("cooling.conductivity")] | None = None

    @model_validator(mode="after")
    def _check(self) -> CoolingTable:
        if self.air == 0.0 == self.mold:
            raise validation_error("cools nothing", "give air or mold, or leave [cooling] out", "air", self.air)
        return self


class Output(Table):
    """Output beyond the result; `reference` is an exact solution that is drawn over the thickness picture.

    Attributes:
        frames: Number of times at which VTU files are written, besides the last.
        reference: A table (CSV) of an exact wall, drawn over the picture.
    """

    frames: Annotated[int, Field(ge=0, le=100_000)] = 0
    reference: str | None = None


class SceneFile(Table):
    """A scene file.

    Attributes:
        name: Name of the scene; by default that of the file.
        description: One line for the list of scenes.
        parison: The sheet.
        material: The material model.
        pressure: The pressure history; may be absent where a gas, gravity or a moving tool does the work.
        gas: A gas that is blown into the sheet, instead of the pressure history, or one that the sheet traps in the
            mold: a section [gas], or [[gas]] for each of the two, or for each of several cavities.
        mold: The mold; without it and without tools the sheet is inflated freely.
        tool: Tools besides the mold, such as plugs: a section [[tool]] for each.
        part: Selection of the part from the formed sheet; without it, all of it.
        refinement: Adaptive refinement; without it, the mesh does not change.
        cooling: Cooling of the sheet; without it, it keeps its temperature.
        solver: Time integration.
        output: Output beyond the result.
    """

    name: str | None = None
    description: str = ""
    parison: Parison
    material: Material
    pressure: PressureTable | None = None
    gas: Gases | None = None
    mold: Mold | None = None
    tool: Tools = Field(default_factory=list)
    part: PartTable | None = None
    refinement: RefinementTable | None = None
    cooling: CoolingTable | None = None
    solver: SolverTable
    output: Output = Output()

    @property
    def gases(self) -> list[GasTable]:
        """The gases, that inside the sheet first."""
        given = self.gas if isinstance(self.gas, list) else [] if self.gas is None else [self.gas]
        return sorted(given, key=lambda gas: gas.closed_by)

    @property
    def regional_gases(self) -> dict[str, GasTable]:
        """The gases by name, in their order, where one of them pushes a region of the sheet; else none."""
        given = self.gas if isinstance(self.gas, list) else [] if self.gas is None else [self.gas]
        if all(gas.region is None for gas in given):
            return {}
        return {gas_name(gas, number): gas for number, gas in enumerate(given, 1)}

    @model_validator(mode="after")
    def _check_regions(self) -> SceneFile:
        gases = self.gases
        if not self.regional_gases:
            for gas in gases:
                if gas.name is not None:
                    problem = "has no effect: no gas has a region"
                    raise validation_error(problem, "give each gas a region, or leave it out", "gas.name", gas.name)
            return self
        _check_gas_names(self.gas if isinstance(self.gas, list) else gases)
        for name, gas in self.regional_gases.items():
            key, beside = f"gas.{name}.region", [one for one in gases if one.closed_by == gas.closed_by]
            if gas.region is None and len(beside) > 1:
                raise validation_error("is missing, and there are other gases on its side", _REGION, key)
            if self.parison.shape not in _FLAT_SHAPES:
                problem, remedy = f"is not possible for a {self.parison.shape}", f"use {', '.join(_FLAT_SHAPES)}"
                raise validation_error(problem, remedy, key)
            if isinstance(gas.region, str) and self.parison.shape != "file":
                raise validation_error("is possible for a mesh file alone", _REGION, key, gas.region)
        if self.parison.adapt is not None:
            problem, remedy = "does not keep the borders of regions of gases", "leave it out, or refine the mesh"
            raise validation_error(problem, remedy, "parison.adapt", self.parison.adapt.model_dump())
        return self

    @model_validator(mode="after")
    def _check_gases(self) -> SceneFile:
        sides = [gas.closed_by for gas in self.gases]
        if self.pressure is not None and "clamp" in sides:
            remedy = 'give one of the two, or closed_by = "mold" for the gas between sheet and mold'
            raise validation_error(
                "is given together with [pressure], on the same side", remedy, "gas.closed_by", "clamp"
            )
        if len(set(sides)) < len(sides) and not self.regional_gases:
            remedy = 'give one with closed_by = "clamp" and one with "mold", or a region to the gas of each cavity'
            raise validation_error("has two gases on the same side of the sheet", remedy, "gas", sides)
        if "mold" in sides and (self.mold is None or self.mold.motion is not None):
            problem = "there is no mold that closes it" if self.mold is None else "the mold moves, so it is not closed"
            raise validation_error(f"is not possible: {problem}", "leave the gas out", "gas.closed_by", "mold")
        return self

    @model_validator(mode="after")
    def _check_drive(self) -> SceneFile:
        motions = [table.motion for table in (self.mold, *self.tool) if table is not None]
        moves = self.gas is not None or any(motion is not None for motion in motions)
        moves |= self.parison.clamp_until is not None and getattr(self.parison, "pre_stretch", None) is not None
        if self.pressure is None and self.solver.gravity is None and not moves:
            remedy = "give [pressure], [gas], solver.gravity, [mold.motion] or a [[tool]] that moves"
            raise validation_error("is missing, and nothing else moves the sheet", remedy, "pressure", None)
        return self

    @model_validator(mode="after")
    def _check_mesh(self) -> SceneFile:
        if self.parison.adapt is not None and self.refinement is not None:
            problem = "is given together with [refinement], which changes the mesh during the run"
            raise validation_error(problem, "give one of the two", "parison.adapt", self.parison.adapt.model_dump())
        return self

    @model_validator(mode="after")
    def _check_tools(self) -> SceneFile:
        check_names(self.tool)
        for number, table in enumerate(self.tool, 1):
            _check_thermal(table, tool_name(table, number), self.cooling)
        return self


_FLAT_SHAPES = ("disc", "rectangle", "outline", "file")  # of sheets that gases can push in regions


def gas_name(table: Any, number: int) -> str:
    """The name of a gas of a region, the number-th of a scene from 1 on; a table of a file, validated or not."""
    name = table.get("name") if isinstance(table, dict) else table.name
    return name if isinstance(name, str) else f"gas{number}"


def find_gas(tables: Any, step: str) -> int | None:
    """The index of the gas in the list of a scene file's gases that has this name, or is closed by it; or None."""
    tables = tables if isinstance(tables, list) else []
    names = [gas_name(table, number) for number, table in enumerate(tables, 1)]
    sides = [table.get("closed_by", "clamp") if isinstance(table, dict) else table.closed_by for table in tables]
    found = [k for k, own in enumerate(zip(names, sides, strict=True)) if step in own]
    return found[0] if len(found) == 1 else None


def _check_gas_names(gases: list[GasTable]) -> None:
    """Raises unless each gas has a name of its own that can be part of a key."""
    names: list[str] = []
    taken = {*GasTable.model_fields, "value", "inside", "trapped", "clamp", "mold"}
    for number, table in enumerate(gases, 1):
        name, key = gas_name(table, number), f"gas[{number - 1}].name"
        if name.casefold() in names:
            raise validation_error("is the name of another gas", "give each gas a name of its own", key, name)
        if not name.replace("-", "_").isidentifier() or len(name) > 50 or name in taken:
            remedy = "use letters, digits, - and _, such as left or cavity-2, and no key of a gas"
            raise validation_error("cannot be the name of a gas", remedy, key, name)
        names.append(name.casefold())


def _check_thermal(table: Any, name: str, cooling: CoolingTable | None) -> None:
    """Raises for a temperature or heat transfer of a tool where the sheet does not cool."""
    for key in ("temperature", "heat_transfer"):
        value = getattr(table, key)
        if value is not None and cooling is None:
            problem, remedy = "has no effect, for the sheet does not cool", "give [cooling], or leave it out"
            raise validation_error(problem, remedy, f"tool.{name}.{key}", value)
