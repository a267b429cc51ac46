"""Discs that a sticking plug pushes and a pressure blows then, against their exact meridian.

The reference is independent of the simulation: the equilibrium of an axisymmetric membrane (Mooney-Rivlin, thin,
incompressible) as an ordinary differential equation along the meridian, solved by shooting. Each ring of the sheet
keeps the stretches at which it comes to the plug. Units: radius, thickness and c of the sheet are 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq, root

import jaxform
from benchmarks.accuracy.cases import THICKNESS, mooney, rms
from jaxform import molds
from jaxform.mesh.shapes import Sheet
from jaxform.mesh.volumes import areas

Array = NDArray[np.float64]
Wall = Callable[[Array], Array]
"""h/h0 at initial radii (n,)."""

_ALPHA, PLUG = 0.1, 0.3  # of the law; the plug's radius
_STEPS = 40  # of Runge and Kutta's method along the meridian


def _slopes(log_radius: float, state: Array, pressure: float) -> Array:
    """Derivatives of radius, height, angle and meridional stretch by the logarithm of the initial radius."""
    initial = np.exp(log_radius)
    radius, _, angle, along = state
    hoop = radius / initial
    thin = (along * hoop) ** -2.0
    tension = 2 / (along * hoop) * (along**2 - thin) * (1 + _ALPHA * hoop**2)
    across = 2 / (along * hoop) * (hoop**2 - thin) * (1 + _ALPHA * along**2)
    stiff = 2 * (1 / hoop + 3 / (along**4 * hoop**3)) * (1 + _ALPHA * hoop**2)
    by_hoop = 2 * (3 / (along**3 * hoop**4) - along / hoop**2) * (1 + _ALPHA * hoop**2)
    by_hoop += 4 * _ALPHA * hoop * (along / hoop - (along * hoop) ** -3.0)
    cosine, sine = np.cos(angle), np.sin(angle)
    stretching = (across - tension) * cosine * along / radius - by_hoop * (along * cosine - hoop) / initial
    turning = along * (pressure - across * sine / radius) / tension
    return initial * np.array([along * cosine, -along * sine, turning, stretching / stiff])


def _meridian(begin: float, radius: float, angle: Array, along: Array, pressure: float) -> Array:
    """States (_STEPS + 1, 4, n) from an initial radius to the rim, for angles and stretches (n,); NaN beyond sense."""
    state = np.array(np.broadcast_arrays(radius, 0.0, angle, along), float)
    place, step, states = np.log(begin), -np.log(begin) / _STEPS, [state]
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            one = _slopes(place, state, pressure)
            two = _slopes(place + step / 2, state + step / 2 * one, pressure)
            three = _slopes(place + step / 2, state + step / 2 * two, pressure)
            four = _slopes(place + step, state + step * three, pressure)
            state, place = state + step / 6 * (one + 2 * two + 2 * three + four), place + step
            bad = (state[3] <= 0) | (state[3] > 30) | (state[0] <= 0) | (state[0] > 5)
            state = np.where(bad, np.nan, state)
            states.append(state)
    return np.array(states)


def _stretch_at_contact(begin: float, angle: float, near: float, width: float) -> float:
    """The stretch at which a sheet leaves the plug at an initial radius and angle, so that it ends at the rim."""

    def misses(logs: Array) -> Array:
        ends = _meridian(begin, PLUG * np.sin(angle), np.full_like(logs, angle), 1 + np.exp(logs), 0.0)
        return ends[-1, 0] - 1.0

    low, high = np.log(near - 1) - width, np.log(near - 1) + width
    for _ in range(4):
        logs = np.linspace(low, high, 16)
        beyond = misses(logs) > 0.0  # not where it breaks off
        place = int(np.argmax(beyond[1:] & ~beyond[:-1]))
        assert beyond[place + 1] and not beyond[place]
        low, high = logs[place], logs[place + 1]
        if np.isfinite(misses(np.array([low, high]))).all():
            break
    found: Any = brentq(lambda log: float(misses(np.array([log]))[0]), low, high, xtol=1e-9)
    return 1 + np.exp(found)


class Landing(NamedTuple):
    """Initial radius, angle on the plug and meridional stretch of the rings as they land, and the depth (n,) then."""

    begin: Array
    angle: Array
    along: Array
    depth: Array


def push_hemisphere(count: int = 14, first: float = 0.02, last: float = 0.22) -> Landing:
    """The landing of all rings up to an initial radius, in steps of Runge and Kutta's method: a d(angle) = l1 dR."""
    ratio, begin, angle, width = (last / first) ** (1 / count), first, first / PLUG, 5.0
    along, rows = 1 + angle**2 / 4, []
    for _ in range(count + 1):
        along = _stretch_at_contact(begin, angle, along, width)
        free = _meridian(begin, PLUG * np.sin(angle), np.array([angle]), np.array([along]), 0.0)
        rows.append((begin, angle, along, PLUG * (1 - np.cos(angle)) - free[-1, 1, 0]))
        step, width = begin * (ratio - 1), 1.2
        one = along / PLUG
        two = _stretch_at_contact(begin + step / 2, angle + step / 2 * one, along, width) / PLUG
        three = _stretch_at_contact(begin + step / 2, angle + step / 2 * two, along, width) / PLUG
        four = _stretch_at_contact(begin + step, angle + step * three, along, width) / PLUG
        begin, angle = begin + step, angle + step / 6 * (one + 2 * two + 2 * three + four)
    return Landing(*np.array(rows).T)


def free_wall(begin: float, radius: float, height: float, start: tuple[float, float], pressure: float) -> Wall:
    """Thickness of the free sheet beyond the ring at a radius and height, by its initial radius."""

    def misses(unknown: Array, pressure: float) -> Array:
        end = _meridian(begin, radius, unknown[1:], unknown[:1], pressure)[-1, :, 0]
        return np.nan_to_num(np.array([end[0] - 1.0, height + end[1]]), nan=9.0)

    unknown = np.array(start)
    for now in np.linspace(0.0, pressure, 1 + round(pressure / 0.25)):
        found = root(misses, unknown, args=(now,), tol=1e-10)
        assert np.abs(found.fun).max() < 1e-7
        unknown = found.x
    states = _meridian(begin, radius, unknown[1:], unknown[:1], pressure)[:, :, 0]
    rings = np.exp(np.linspace(np.log(begin), 0.0, _STEPS + 1))
    return CubicSpline(rings, rings / (states[:, 0] * states[:, 3]))


def hemisphere_wall(landing: Landing, depth: float, pressure: float) -> Wall:
    """Thickness by the initial radius, of a sheet that was pushed to a depth and then blown."""
    begin, angle, along = (float(CubicSpline(landing.depth, each)(depth)) for each in landing[:3])
    free = free_wall(begin, PLUG * np.sin(angle), depth - PLUG * (1 - np.cos(angle)), (along, angle), pressure)
    ring = CubicSpline(np.append(0.0, landing.begin), np.append(0.0, landing.angle))

    def thickness(initial: Array) -> Array:
        on = np.clip(initial, 1e-6, begin)
        held = on / (PLUG * np.sin(ring(on)) * PLUG * ring(on, 1))
        return np.where(initial < begin, held, free(np.maximum(initial, begin)))

    return thickness


_FLAT_STARTS = {0.4: (1.3, 0.9), 0.6: (1.61, 1.0), 1.0: (2.6, 1.1)}  # stretch and angle at the edge, by the depth


def flat_wall(depth: float, pressure: float) -> Wall:
    """Thickness by the initial radius, of a sheet that a flat plug has pushed to a depth: all under it is as before."""
    free = free_wall(PLUG, PLUG, depth, _FLAT_STARTS[depth], pressure)
    return lambda initial: np.where(initial < PLUG, 1.0, free(np.maximum(initial, PLUG)))


def plug_scene(sheet: Sheet, profile: molds.MoldShape, depth: float, pressure: float) -> jaxform.Scene:
    """A disc of radius 1 that a plug of a shape pushes slowly, and a pressure blows then."""
    pushes, blows = 25.0, 35.0 if pressure else 0.0
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, THICKNESS, sheet.clamped, sheet.fixed),
        material=mooney(_ALPHA),
        pressure=jaxform.make_pressure([0.0, pushes, pushes + 35.0], [0.0, 0.0, pressure * THICKNESS]),
        solver=jaxform.make_solver(end_time=pushes + blows, damping=2.0),
        tools=[
            jaxform.make_mold(
                profile.vertices,
                profile.triangles,
                name="plug",
                motion=jaxform.make_motion([0, 0, 1], [0.0, pushes], [0.0, depth]),
            )
        ],
        fill=False,
    )


_REACH = PLUG / np.cos(np.pi / 96) ** 0.5  # of facets that are as often within the plug's circle as beyond


def flat_plug() -> molds.MoldShape:
    """A rod with a flat end and a sharp edge."""
    return molds.revolved(profile=[[0.0, 0.0], [_REACH, 0.0], [_REACH, -1.5]], segments=96)


def round_plug() -> molds.MoldShape:
    """A rod with a hemispherical end."""
    return molds.rod(radius=_REACH, length=1.5, segments=96)


class WallErrors(NamedTuple):
    """Relative errors of the elements' thickness (n_element,), their initial radius and area (n_element,)."""

    error: Array
    radius: Array
    area: Array

    @property
    def rms(self) -> float:
        """Root of the mean square by initial area, of all elements."""
        return rms(self.error, self.area)


_PARTS = 12  # into which a side of an element is cut, for a mean over it


def wall_errors(scene: jaxform.Scene, result: jaxform.Result, wall: Wall) -> WallErrors:
    """Errors of the elements, which have the mean of the sheet's area stretch over them, against an exact wall."""
    corners = np.asarray(scene.parison.positions)[np.asarray(result.triangles)]
    area = areas(np.asarray(scene.parison.positions), np.asarray(result.triangles))
    i, j = np.mgrid[:_PARTS, :_PARTS]
    inside = [np.stack([i + share, j + share])[:, i + j < _PARTS - k] for k, share in enumerate((1 / 3, 2 / 3))]
    two = np.concatenate(inside, axis=1) / _PARTS
    places = np.einsum("kp,nkc->npc", np.concatenate([1.0 - two.sum(0, keepdims=True), two]), corners)
    expected = 1.0 / np.mean(1.0 / wall(np.linalg.norm(places[..., :2], axis=2)), axis=1)
    error = np.asarray(result.element_thickness) / THICKNESS / expected - 1.0
    return WallErrors(error, np.linalg.norm(corners.mean(1), axis=1), area)
