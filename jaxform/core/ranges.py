"""Ranges of the numbers of a scene: declared once, for files, constructors, `replace` and traced values.

A material model declares the ranges of its parameters in its class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxform.core.errors import InputError, warn_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

DEEPEST = 14  # level of refinement
MOST, LEAST = 1e30, 1e-30  # of any number, and of one that must be positive: with others they can be computed with
MOST_STEPS = 20_000_000


@dataclass(frozen=True)
class Range:
    """The allowed range of a number; always finite.

    Attributes:
        unit: Unit of the number; empty where it has none.
        above: It is greater than this.
        least, most: It is not less than the one and not greater than the other.
        increasing: True if several values must increase.
        count: True if it is a whole number.
    """

    unit: str = ""
    above: float | None = None
    least: float | None = None
    most: float | None = None
    increasing: bool = False
    count: bool = False

    def contains(self, values: Any) -> Any:
        """Mask of the values in the range, of the shape of the values (a number, or an array of NumPy or JAX)."""
        good = abs(values) <= MOST
        if self.above is not None:
            good = good & (values > self.above)
        if self.above == 0.0:
            good = good & (values >= LEAST)
        if self.least is not None:
            good = good & (values >= self.least)
        return good if self.most is None else good & (values <= self.most)

    @property
    def rule(self) -> str:
        """The requirement on the number, in words."""
        if self.most is not None:
            low = f"({self.above:g}" if self.above is not None else f"[{self.least:g}"
            return f"must be in {low}, {self.most:g}]"
        if self.above == 0.0:
            return "must be positive"
        if self.least is not None:
            return "must not be negative" if self.least == 0.0 else f"must be at least {self.least:g}"
        return "must increase" if self.increasing else "must be finite"

    @property
    def remedy(self) -> str:
        """The remedy for a number out of range, in words."""
        kind = "whole numbers" if self.count else "finite numbers"
        limits = [f"> {self.above:g}"] if self.above is not None else []
        limits += [f">= {self.least:g}"] if self.least is not None else []
        limits += [f"<= {self.most:g}"] if self.most is not None else []
        text = " and ".join(limits)
        return " ".join(part for part in (f"give {kind}", text, f"[{self.unit}]" if self.unit else "") if part)


RANGES: dict[str, Range] = {
    "parison.thickness": Range("m", above=0.0),
    "parison.pre_stretch": Range(least=1.0, most=10.0),
    "parison.clamp_until": Range("s", above=0.0),
    "pressure.time": Range("s", increasing=True),
    "pressure.value": Range("Pa"),
    "gas.time": Range("s", increasing=True),
    "gas.mass_flow": Range("kg/s"),
    "gas.temperature": Range("K", above=0.0, most=3300.0),
    "gas.gas_constant": Range("J/(kg K)", above=0.0),
    "gas.ambient_pressure": Range("Pa", least=0.0),
    "gas.dead_volume": Range("m^3", least=0.0),
    "gas.supply_pressure": Range("Pa"),
    "gas.valve": Range(least=0.0, most=1.0),
    "gas.orifice_area": Range("m^2", least=0.0),
    "gas.vent": Range(least=0.0, most=1.0),
    "gas.vent_area": Range("m^2", least=0.0),
    "gas.discharge_coefficient": Range(above=0.0, most=1.0),
    "gas.heat_capacity_ratio": Range(above=1.0, most=2.0),
    "mold.motion.time": Range("s", increasing=True),
    "mold.motion.displacement": Range("m"),
    "mold.contact.friction": Range(least=0.0),
    "mold.contact.temperature": Range("degC", above=-273.15, most=3000.0, increasing=True),
    "mold.temperature": Range("degC", above=-273.15, most=3000.0),
    "mold.heat_transfer": Range("W/(m^2 K)", least=0.0),
    "material.density": Range("kg/m^3", above=0.0),
    "parison.temperature": Range("degC", above=-273.15, most=3000.0),
    "material.shift.reference": Range("degC", above=-273.15, most=3000.0),
    "material.shift.c1": Range(least=0.0),
    "material.shift.c2": Range("K", above=0.0),
    "material.shift.activation_energy": Range("J/mol", least=0.0),
    "material.viscous.modulus": Range("Pa", above=0.0),
    "material.viscous.time": Range("s", above=0.0),
    "cooling.heat_capacity": Range("J/(kg K)", above=0.0),
    "cooling.air": Range("W/(m^2 K)", least=0.0),
    "cooling.air_temperature": Range("degC", above=-273.15, most=3000.0),
    "cooling.mold": Range("W/(m^2 K)", least=0.0),
    "cooling.mold_temperature": Range("degC", above=-273.15, most=3000.0),
    "cooling.conductivity": Range("W/(m K)", above=0.0),
    "solver.end_time": Range("s", above=0.0),
    "solver.damping": Range("1/s", least=0.0),
    "solver.gravity": Range("m/s^2", least=-1e4, most=1e4),
    "solver.safety": Range(above=0.0, most=1.0),
    "solver.max_steps": Range("steps", least=1, most=MOST_STEPS, count=True),
    "refinement.angle": Range("degrees", above=0.0, most=180.0),
    "refinement.min_area": Range("m^2", least=0.0),
    "refinement.interval": Range("steps", least=1, most=MOST_STEPS, count=True),
    "refinement.max_level": Range(least=0, most=DEEPEST, count=True),
    "refinement.base_level": Range(least=0, most=DEEPEST, count=True),
    "refinement.proximity_factor": Range(above=0.0),
    "refinement.mass_scaling_levels": Range(least=0, most=DEEPEST, count=True),
    "refinement.jump": Range(above=0.0),
    "refinement.elements": Range(least=1, count=True),
}

DESIGNABLE = [
    "parison.thickness",
    "parison.temperature",
    "pressure.time",
    "pressure.value",
    "material.c",
    "material.alpha",
    "material.a01",
    "material.a02",
    "material.density",
    "cooling.heat_capacity",
    "cooling.air",
    "cooling.air_temperature",
    "cooling.mold",
    "cooling.mold_temperature",
    "cooling.conductivity",
    "solver.end_time",
    "solver.damping",
    "solver.gravity",
    "mold.motion.time",
    "mold.motion.displacement",
    "mold.contact.friction",
    "mold.temperature",
    "mold.heat_transfer",
]
"""Paths that `replace` may set; the index of each is its bit in `Result.out_of_range`. A law may add to it."""
WORDS, BITS = 4, 31  # integers whose bits mark the numbers out of range, and bits used of each
_declared: dict[str, list[Range]] = {}


RENAMED = {
    "refinement.base_reach": "refinement.proximity_factor",
    "refinement.scaled_levels": "refinement.mass_scaling_levels",
}
"""Older names of keys, accepted in version 0.1 with a warning."""


def current_keys(section: str, given: Mapping[str, Any], file: str = "") -> dict[str, Any]:
    """Keys of a section and their values, older names replaced by the current ones.

    Args:
        section: The section, such as "refinement".
        given: Its keys and values.
        file: Name of the scene file in messages.

    Raises:
        InputError: A key is given under both names.

    Warns:
        InputWarning: A key has its older name.
    """
    named = {}
    for key, value in given.items():
        old = f"{section}.{key}"
        new = RENAMED.get(old, old)
        name = new.rpartition(".")[2]
        if new != old and name in given:
            raise InputError(f"is the older name of {new}, which is given, too", "leave it out", old, value, file)
        if new != old:
            warn_of(f"is the older name of {new}", "use the new name", key=old, value=value, file=file)
        named[name] = value
    return named


def declare(key: str, allowed: Range) -> None:
    """Makes a number designable; laws may have numbers of one name with ranges of their own.

    Raises:
        InputError: There is no bit left for another number.
    """
    if key not in DESIGNABLE:
        if len(DESIGNABLE) == WORDS * BITS:
            raise InputError(
                "is more parameters than can be declared",
                "reuse the parameter names of other material models",
                key,
            )
        DESIGNABLE.append(key)
    _declared.setdefault(key, []).append(allowed)


def declared_ranges(key: str) -> list[Range]:
    """The different ranges that numbers of one name have."""
    return list(dict.fromkeys(_declared.get(key) or [RANGES[key]]))


def check(key: str, given: ArrayLike, allowed: Range | None = None) -> None:
    """Raises InputError unless a number of a scene, or each of several, is in its range; `given` is not traced."""
    import numpy as np  # not needed where files are refused

    values, allowed = as_numbers(key, given), allowed or RANGES[key]
    shown = values.tolist() if values.ndim else None
    if not np.all(np.isfinite(values)):
        raise InputError("is not finite", allowed.remedy, key, _first_bad_value(values, ~np.isfinite(values)))
    if allowed.count and values.dtype.kind == "f" and np.any(values != np.floor(values)):
        raise InputError(
            "is not a whole number", allowed.remedy, key, _first_bad_value(values, values != np.floor(values))
        )
    good = np.asarray(allowed.contains(values))
    if not np.all(good):
        raise InputError(allowed.rule, allowed.remedy, key, _first_bad_value(values, ~good))
    if allowed.increasing and np.any(np.diff(values) <= 0):
        raise InputError("the knots do not increase", "sort the times and drop repeats", key, shown)


def check_one(key: str, given: ArrayLike, allowed: Range | None = None) -> None:
    """Raises InputError unless the value is one number in its range; as `check`."""
    if as_numbers(key, given).ndim:
        raise InputError("is not one number", (allowed or RANGES[key]).remedy, key, given)
    check(key, given, allowed)


def as_numbers(key: str, given: ArrayLike) -> Any:
    """An array of whole or floating numbers (NumPy) of what was given for a key, or its rows.

    Raises:
        InputError: If it holds anything but real numbers, or rows of different lengths.
    """
    import numpy as np

    remedy = "give real numbers, in rows of the same length"
    try:
        values = np.asarray(given)
    except (ValueError, TypeError) as error:
        uneven = "inhomogeneous" in str(error)
        problem = "has rows of different lengths" if uneven else "is not an array of numbers"
        raise InputError(problem, remedy, key, given) from None
    if values.dtype.kind not in "iuf":
        kinds = {"c": "is complex", "U": "is a string", "S": "is a string", "b": "is true or false, not a number"}
        raise InputError(kinds.get(values.dtype.kind, "is not an array of numbers"), remedy, key, given)
    return values


def _first_bad_value(values: Any, bad: Any) -> float:
    return float(values[bad].flat[0]) if values.ndim else float(values)
