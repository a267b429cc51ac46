"""Unit of length of a mold file, guessed; warnings of likely errors in other units. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import warn_of
from jaxform.io.tool_checks import motion_key, words_of
from jaxform.materials import Cooling
from jaxform.materials.shift import Wlf
from jaxform.model.scene import Scene

_WEAK_MODES = 1e-3  # of the model's stiffness, Prony terms altogether
_KELVIN = 273.15
_APART = 120.0  # K, between a sheet's temperature and the shift's reference: where one is in kelvin, they are
_BELOW, _ABOVE = 60.0, 150.0  # K, by which a sheet may be below or above that reference in the same unit
_LIKE_KELVIN = 253.15  # degC of air or mold: as hot is hardly any, and 253 K is as cold
_IDLE_ENERGY = 500.0  # J/mol: plastics have 2e4 to 5e5
_WAVE = 8.0  # times c over the density: the square of the speed of a wave along the sheet


def warn_of_units(scene: Scene, file: str = "") -> None:
    """Warns of likely unit errors in numbers of the material, of temperatures and of motion."""
    _warn_of_modes(scene, file)
    _warn_of_shift(scene, file)
    if scene.cooling is not None and scene.parison.temperature is not None:
        _warn_of_surroundings(scene.cooling, np.asarray(scene.parison.temperature, float), file)
    _warn_of_motion(scene, file)


def _warn_of_modes(scene: Scene, file: str) -> None:
    modes = scene.material.viscous
    if modes is None:
        return
    elastic, viscous = float(scene.law.elastic.stiffness().mean()), float(modes.stiffness().mean())
    if viscous < _WEAK_MODES * elastic:
        modulus = np.asarray(modes.modulus, float)
        problem = f"the Prony terms are {viscous / elastic:.1g} times as stiff as the elastic model: modulus is in Pa"
        remedy = "if they are relative moduli, as in Abaqus and Ansys, multiply them by the instantaneous shear modulus"
        warn_of(problem, remedy, key="material.viscous.modulus", value=modulus.tolist(), file=file)


def _warn_of_shift(scene: Scene, file: str) -> None:
    shift, temperature = scene.material.shift, scene.parison.temperature
    if shift is None or temperature is None:
        return
    reference, warmest = float(shift.reference), float(np.max(np.asarray(temperature)))
    if warmest > max(reference + _APART, _KELVIN) and -_BELOW <= warmest - _KELVIN - reference <= _ABOVE:
        problem = f"is {warmest - reference:.3g} K above the reference of the shift: is it in kelvin?"
        remedy = f"give degC: {warmest - _KELVIN:.4g}"
        warn_of(problem, remedy, key="parison.temperature", value=warmest, file=file)
    elif reference > max(warmest + _APART, _KELVIN) and -_BELOW <= warmest + _KELVIN - reference <= _ABOVE:
        problem = f"is {reference - warmest:.3g} K above the sheet's temperature: is it in kelvin?"
        remedy = f"give degC: {reference - _KELVIN:.4g}"
        warn_of(problem, remedy, key="material.shift.reference", value=reference, file=file)
    energy = None if isinstance(shift, Wlf) else getattr(shift, "activation_energy", None)
    if energy is not None and 0.0 < float(energy) < _IDLE_ENERGY:
        problem, remedy = "has almost no effect: is it in J/mol?", f"give {1e3 * float(energy):.4g} if it is in kJ"
        warn_of(problem, remedy, key="material.shift.activation_energy", value=float(energy), file=file)


def _warn_of_surroundings(cooling: Cooling, temperature: np.ndarray, file: str) -> None:
    """Warns of air or a mold that is warmer than the sheet, or whose temperature looks like kelvin."""
    for name in ("air", "mold"):
        value, key = float(getattr(cooling, f"{name}_temperature")), f"cooling.{name}_temperature"
        if float(getattr(cooling, name)) == 0.0:
            continue
        hot, kelvin = value > temperature.min(), value > _LIKE_KELVIN
        if not (hot or kelvin):
            continue
        problem = (
            f"is above the sheet's temperature of {temperature.min():.4g} degC"
            if hot
            else f"is high for {name}"
            if name == "air"
            else "is high for a mold"
        )
        problem += ": is it in kelvin?" if kelvin else ""
        remedy = f"give degC: {value - _KELVIN:.4g}" if kelvin else "check that this is intended"
        warn_of(problem, remedy, key=key, value=value, file=file)


def _warn_of_motion(scene: Scene, file: str) -> None:
    """Warns of a mold or tool that is faster than waves in the sheet."""
    for tool in (surface.mold for surface in scene.surfaces):
        if tool.motion is None:
            continue
        speed = tool.motion.mean_speeds().max()
        wave = float(np.sqrt(_WAVE * scene.law.stiffness_at_once().mean() / scene.material.density.mean()))
        if speed > wave:
            problem = f"{words_of(tool)[0]} moves at {speed:.3g} m/s, faster than waves in the sheet ({wave:.3g} m/s)"
            remedy = "give s and m, or move it more slowly"
            time = np.asarray(tool.motion.time, float).tolist()
            warn_of(problem, remedy, key=motion_key(tool, "time"), value=time, file=file)


# The unit of length of a mold's file, guessed from its size.

METRES, INCHES = 1.2, 18.0
"""Largest sizes of a part, as numbers, that are taken for metres, and for inches or centimetres."""
_CENTIMETRES = 60.0  # the same, up to which a part of so many millimetres may be one of so many centimetres
_ROUND, _OFF = 0.5, 1e-4  # of sides in centimetres, that are multiples of a half


Units = tuple[float, str, str]
"""A unit of length: in metres, its name, and other units that a file may have, as `--scale` says them; "" for none."""


_IN_MM = "--scale 0.001 where it is in millimetres"
_IN_CM = "--scale 0.01 where it is in centimetres"
_IN_INCHES = "--scale 0.0254 where it is in inches"


def guess_units(box: NDArray[np.float64], scale: float | None = None) -> Units:
    """The unit of a part whose box is so many units (3,) large; the given one [m], where one is given."""
    guessed = _guess(box)
    if scale is None:
        return guessed
    return scale, guessed[1] if scale == guessed[0] else f"units of {scale:g} m", ""


def _guess(box: NDArray[np.float64]) -> Units:
    size = float(box.max())
    if size <= METRES:
        return 1.0, "metres", ""
    if size <= INCHES:
        halves = box / _ROUND
        # A part of 12 x 8 x 5 is drawn in centimetres, one of 4.72 x 3.15 x 1.97 is drawn in inches or converted.
        if np.all(np.abs(halves - np.round(halves)) <= _OFF * np.maximum(halves, 1.0)):
            return 0.01, "centimetres", f"give {_IN_MM}, {_IN_INCHES}"
        return 0.0254, "inches", f"give {_IN_MM}, {_IN_CM}"
    return 0.001, "millimetres", f"give {_IN_CM}" if size <= _CENTIMETRES else ""
