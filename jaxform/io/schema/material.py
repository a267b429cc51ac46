"""Tables of the laws."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Tag

from jaxform.io.validation import Table, choice, within, wrong


def _one_number(value: Any) -> Any:
    if isinstance(value, dict) or (isinstance(value, str) and value.startswith("field:")):
        raise wrong("stiffness zones are not there yet", "give one number", value=value)
    return value


_OneNumber = BeforeValidator(_one_number)
Density = Annotated[float, within("material.density")]


class NeoHookean(Table):
    """W = c (I1 - 3).

    Attributes:
        model: The law.
        c: Half the shear modulus [Pa].
        density: Mass per volume [kg/m^3].
    """

    model: Literal["neo-hookean"]
    c: Annotated[float, within("material.c"), _OneNumber]
    density: Density


class MooneyRivlin(Table):
    """W = c [(I1 - 3) + alpha (I2 - 3)].

    Attributes:
        model: The law.
        c: First coefficient [Pa].
        alpha: Ratio of the second coefficient to the first.
        density: Mass per volume [kg/m^3].
    """

    model: Literal["mooney-rivlin"]
    c: Annotated[float, within("material.c"), _OneNumber]
    alpha: Annotated[float, within("material.alpha"), _OneNumber]
    density: Density


class ModifiedMooneyRivlin(Table):
    """W = a01 (I1 - 3) + a02 (I2 - 3)^2.

    Attributes:
        model: The law.
        a01: Coefficient of I1 - 3 [Pa].
        a02: Coefficient of (I2 - 3)^2 [Pa].
        density: Mass per volume [kg/m^3].
    """

    model: Literal["modified-mooney-rivlin"]
    a01: Annotated[float, within("material.a01"), _OneNumber]
    a02: Annotated[float, within("material.a02"), _OneNumber]
    density: Density


Material = Annotated[
    Annotated[NeoHookean, Tag("<neo-hookean>")]
    | Annotated[MooneyRivlin, Tag("<mooney-rivlin>")]
    | Annotated[ModifiedMooneyRivlin, Tag("<modified-mooney-rivlin>")],
    *choice("model", ["neo-hookean", "mooney-rivlin", "modified-mooney-rivlin"], later=["ogden"]),
]
