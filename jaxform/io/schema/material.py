"""Tables of the material models, made from the classes that declare them; each parameter may vary over the sheet."""

from __future__ import annotations

import functools
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PlainValidator, SerializeAsAny, Tag, create_model, model_validator

from jaxform.core.pytree import file_defaults, list_parameter_names, parameter_ranges
from jaxform.io.schema.quantities import Zoned
from jaxform.io.validation import (
    Table,
    allow_range,
    check_choice,
    choice,
    declared_range,
    validate_part,
    validation_error,
)
from jaxform.materials import LAWS, Law

_MOST_TERMS = 6
_MOST_MODES = 12
Density = Zoned[Annotated[float, declared_range("material.density")]]


class Viscous(Table):
    """Prony terms, whose stress is added to that of the material model, which is then the long-term response.

    Attributes:
        kind: "christensen", which follows the strain, for sheets of thermoplastic; or "maxwell", upper-convected
            Maxwell modes, for melts.
        modulus: Modulus of each branch [Pa].
        time: Relaxation time of each branch [s].
    """

    kind: Literal["christensen", "maxwell"]
    modulus: Annotated[
        list[Annotated[float, declared_range("material.viscous.modulus")]], Field(min_length=1, max_length=_MOST_MODES)
    ]
    time: Annotated[
        list[Annotated[float, declared_range("material.viscous.time")]], Field(min_length=1, max_length=_MOST_MODES)
    ]

    @model_validator(mode="after")
    def _check(self) -> Viscous:
        if len(self.time) != len(self.modulus):
            problem = f"has {len(self.time)} entries, modulus has {len(self.modulus)}"
            raise validation_error(problem, "give one for each Prony term", "time", self.time)
        return self


class WlfShift(Table):
    """Relaxation times by temperature: log10 a = -c1 (T - reference) / (c2 + T - reference).

    Attributes:
        kind: The kind of shift.
        reference: Temperature [degC] at which the material parameters hold.
        c1: Dimensionless constant; 17.44 where the reference is the glass transition.
        c2: Constant [K]; 51.6 where the reference is the glass transition.
    """

    kind: Literal["wlf"]
    reference: Annotated[float, declared_range("material.shift.reference")]
    c1: Annotated[float, declared_range("material.shift.c1")]
    c2: Annotated[float, declared_range("material.shift.c2")]


class ArrheniusShift(Table):
    """Relaxation times by temperature: ln a = E / R (1 / T - 1 / reference), in kelvin.

    Attributes:
        kind: "arrhenius" shifts times alone, "arrhenius-stiffness" all moduli as well.
        reference: Temperature [degC] at which the material parameters hold.
        activation_energy: Activation energy E [J/mol].
    """

    kind: Literal["arrhenius", "arrhenius-stiffness"]
    reference: Annotated[float, declared_range("material.shift.reference")]
    activation_energy: Annotated[float, declared_range("material.shift.activation_energy")]


_SHIFTS = ["wlf", "arrhenius", "arrhenius-stiffness"]
Shift = Annotated[
    Annotated[WlfShift, Tag("<wlf>")]
    | Annotated[ArrheniusShift, Tag("<arrhenius>")]
    | Annotated[ArrheniusShift, Tag("<arrhenius-stiffness>")],
    *choice("kind", _SHIFTS),
]


class MaterialTable(Table):
    """Keys that all material models share.

    Attributes:
        model: Name of the material model.
        model_file: A Python file that declares the model, relative to the scene file; for models that are not built in.
        density: Mass per volume [kg/m^3].
        viscous: Prony terms; without them the sheet has no memory.
        shift: Time-temperature shift; without it the sheet's temperature has no effect on its stress.
        tension_field: True if the sheet goes slack and wrinkles where it would otherwise be compressed.
    """

    law: ClassVar[type[Law]] = Law
    """The class of the material model."""

    model: str
    model_file: str | None = None
    density: Density
    viscous: Viscous | None = None
    shift: Shift | None = None
    tension_field: bool = False


@functools.cache
def material_table(name: str, law: type[Law]) -> type[MaterialTable]:
    """The table of a material model, with a key for each parameter that its class declares.

    Args:
        name: Name of the model.
        law: Its class.
    """
    listed, defaults = list_parameter_names(law), file_defaults(law)
    keys: dict[str, Any] = {"model": (Literal[name], ...)}
    for key, allowed in parameter_ranges(law).items():
        if key != "density":
            kind: Any = Zoned[Annotated[float, allow_range(allowed)]]
            if key in listed:
                kind = Annotated[list[kind], Field(min_length=1, max_length=_MOST_TERMS)]
            keys[key] = (kind, defaults.get(key, ...))
    made = create_model(f"{law.__name__}Table", __base__=MaterialTable, __doc__=law.__doc__, **keys)
    made.law = law
    return made


def material_tables() -> list[type[MaterialTable]]:
    """The tables of all registered material models."""
    return [material_table(name, law) for name, law in LAWS.items()]


def _validate_material(given: Any) -> MaterialTable:
    """The table of the material model that the key `model` names."""
    name = check_choice(given, "model", list(LAWS))["model"]
    return validate_part(material_table(name, LAWS[name]), given)


Material = Annotated[SerializeAsAny[MaterialTable], PlainValidator(_validate_material)]
