"""The exact wall of a disc that sticks in a cup, at any pressure, by integration along the meridian.

The disc has radius 1, its clamped rim is the mouth of a truncated cone with a flat bottom. The sheet sticks where it
touches: first along the wall, from the mouth down, then on the bottom too. In between it is a free membrane of
revolution that is tangent to both. What comes into contact keeps the meridian stretch that the free part has there, so
that the material radius R of a place s of the mold obeys dR/ds = 1/stretch.

Laws are W = (I1 - 3) + alpha (I2 - 3) + beta (I2 - 3)^2; pressures are in c h0/a, or in A01 h0/a of the paper's law.
Nothing here is shared with the simulator. Checked against reference tables at two pressures, to 1e-4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq, root

Array = np.ndarray


class Law(NamedTuple):
    """Coefficients of W = (I1 - 3) + alpha (I2 - 3) + beta (I2 - 3)^2."""

    alpha: float = 0.0
    beta: float = 0.0

    def slopes(self, s: float, h: float) -> tuple[float, float, float, float]:
        """First derivatives of W by the two stretches, then W_ss and W_sh."""
        s2, h2 = s * s, h * h
        two = s2 * h2 + 1 / s2 + 1 / h2 - 3
        first, second = self.alpha + 2 * self.beta * two, 2 * self.beta
        one_s, one_h = 2 * (s - 1 / (s2 * s * h2)), 2 * (h - 1 / (h2 * h * s2))
        two_s, two_h = 2 * (s * h2 - 1 / (s2 * s)), 2 * (h * s2 - 1 / (h2 * h))
        one_ss, one_sh = 2 + 6 / (s2 * s2 * h2), 4 / (s2 * s * h2 * h)
        two_ss, two_sh = 2 * h2 + 6 / (s2 * s2), 4 * s * h
        return (
            one_s + first * two_s,
            one_h + first * two_h,
            one_ss + first * two_ss + second * two_s * two_s,
            one_sh + first * two_sh + second * two_s * two_h,
        )


class Wall(NamedTuple):
    """The wall at a pressure.

    Attributes:
        pressure: The pressure.
        radius: Initial radii (n,), ascending from the pole to the rim.
        thickness: h/h0 there (n,).
        edges: Initial radii of the inner and the outer edge of what is free.
    """

    pressure: float
    radius: Array
    thickness: Array
    edges: tuple[float, float]

    def at(self, radius: Array) -> Array:
        """h/h0 at initial radii."""
        return np.interp(radius, self.radius, self.thickness)

    @property
    def thinnest(self) -> float:
        """The least h/h0."""
        return float(self.thickness.min())


_STEPS = 240  # of Runge and Kutta along the free part


def _march(law: Law, pressure: float, begin: tuple[float, ...], end: float, keep: list | None = None) -> tuple:
    """Stretches s and h, slope p and height z at initial radius `end`, from those at another: (R, s, h, p, z).

    As in `membranes.free_disc`, with the pressure given. Steps are equal in the root of the radius's share, since a
    free part is thinnest and changes fastest near its inner edge.
    """
    radius, s, h, p, z = begin
    slopes, sin, cos = law.slopes, math.sin, math.cos

    def rates(radius: float, s: float, h: float, p: float) -> tuple[float, float, float, float]:
        ws, wh, wss, wsh = slopes(s, h)
        sine, cosine = sin(p), cos(p)
        hoop = (s * cosine - h) / radius
        turn = (pressure * s * h - sine * wh / radius) / ws
        return ((cosine * wh - ws) / radius - wsh * hoop) / wss, hoop, turn, -s * sine

    share = np.linspace(0.0, 1.0, _STEPS + 1)
    places = radius + (end - radius) * share * share if keep is None else radius + (end - radius) * share
    for place in places[1:].tolist():
        d = place - radius
        a = rates(radius, s, h, p)
        b = rates(radius + d / 2, s + d / 2 * a[0], h + d / 2 * a[1], p + d / 2 * a[2])
        c = rates(radius + d / 2, s + d / 2 * b[0], h + d / 2 * b[1], p + d / 2 * b[2])
        e = rates(place, s + d * c[0], h + d * c[1], p + d * c[2])
        s, h, p, z = (value + d / 6 * (a[k] + 2 * b[k] + 2 * c[k] + e[k]) for k, value in enumerate((s, h, p, z)))
        radius = place
        if keep is not None:
            keep.append((radius, 1 / (s * h)))
    return s, h, p, z


class Cup(NamedTuple):
    """A truncated cone of mouth radius 1 with a flat bottom; its depth, and the angle of its wall [rad]."""

    depth: float
    angle: float = math.radians(80.0)

    def wall(self, place: float) -> tuple[float, float]:
        """Radius and height above the mouth at a distance along the wall from the mouth."""
        return 1 - place * math.cos(self.angle), place * math.sin(self.angle)


def stick_in_cup(law: Law, cup: Cup, pressures: Sequence[float], steps: int = 160) -> list[Wall]:
    """The walls of a disc that a slowly rising pressure blows into a cup, the part that is still free included.

    Args:
        law: The material.
        cup: The mold.
        pressures: At which the wall is wanted, ascending; high enough for the sheet to touch the bottom.
        steps: Along the wall until the bottom is touched, and as many for each factor of 12 in the distance to the
            corner from then on; the error is of second order in their length.
    """
    contact = _Contact(law, cup)
    contact.reach_bottom(steps)
    walls = []
    for pressure in pressures:
        contact.fill_corner(pressure, math.log(12.0) / steps)
        walls.append(contact.wall())
    return walls


class _Contact:
    """The edges of the free part: on the wall, and from the bottom's contact on there too."""

    def __init__(self, law: Law, cup: Cup) -> None:
        self.law, self.cup = law, cup
        self.place, self.bottom = 0.0, 0.0  # of the edges: along the wall, and the radius on the bottom
        self.outer, self.inner = 1.0, 0.0  # their initial radii
        # Meridian stretches at the edges, and the pressure, before anything sticks: guesses to begin with.
        self.outer_stretch, self.inner_stretch, self.pressure = 1.2, 2.0, 3.7
        self.on_wall: list[tuple[float, float]] = []
        self.on_bottom: list[tuple[float, float]] = []

    def reach_bottom(self, steps: int) -> None:
        """Advances along the wall until the pole is at the bottom."""
        stretch, pressure, _ = self._solve_cap(0.0, self.outer, self._guess_first_cap())
        self._keep_outer(0.0, 1.0, stretch[1])
        guess, height = (stretch[0], pressure), 0.0
        length = self.cup.depth / math.sin(self.cup.angle) / steps
        while True:
            (pole, edge, material), pressure, height = self._advance_cap(length, guess)
            if height >= self.cup.depth:
                break
            self.place += length
            self._keep_outer(self.place, material, edge)
            guess = pole, pressure
        last: Any = brentq(lambda step: self._advance_cap(step, guess)[2] - self.cup.depth, 0.0, length, xtol=1e-10)
        (pole, edge, material), pressure, _ = self._advance_cap(last, guess)
        self.place += last
        self._keep_outer(self.place, material, edge)
        self.inner_stretch, self.pressure = pole, pressure
        self.on_bottom.append((0.0, pole**-2))

    def _guess_first_cap(self) -> tuple[float, float]:
        """Pole stretch and pressure of about the free disc whose rim is as steep as the wall."""
        stretch, pressure, slope = 1.2, 2.0, 0.0
        while slope < self.cup.angle:
            stretch += 0.02

            def ends(free: Array, stretch: float = stretch) -> tuple[float, ...]:
                return _march(self.law, free[0], _at_pole(self.law, stretch, free[0]), 1.0)

            (pressure,) = _solve(lambda free: [ends(free)[1] - 1.0], (pressure,))
            slope = ends(np.array([pressure]))[2]
        return stretch, pressure

    def _solve_cap(self, place: float, material: float, guess: tuple[float, float]) -> Any:
        """Stretches at pole and edge, pressure, and height of the pole, of a cap whose edge is at a place."""
        radius, _ = self.cup.wall(place)

        def end(free: Array) -> tuple[float, ...]:
            return _march(self.law, free[1], _at_pole(self.law, *free), material)

        def misses(free: Array) -> list[float]:
            _, hoop, slope, _ = end(free)
            return [hoop * material - radius, slope - self.cup.angle]

        free = _solve(misses, guess)
        s, _, _, drop = end(free)
        return (free[0], s), free[1], self.cup.wall(place)[1] - drop

    def _advance_cap(self, length: float, guess: tuple[float, float]) -> Any:
        """The next cap, a length further: its stretches at pole and edge, the edge's material, pressure, height."""
        edge = self.outer_stretch
        for _ in range(30):
            material = self.outer - 0.5 * length * (1 / self.outer_stretch + 1 / edge)
            (pole, new), pressure, height = self._solve_cap(self.place + length, material, guess)
            guess = pole, pressure
            if abs(new - edge) < 1e-11:
                break
            edge = new
        return (pole, new, material), pressure, height

    def _keep_outer(self, place: float, material: float, stretch: float) -> None:
        self.outer, self.outer_stretch = material, stretch
        self.on_wall.append((material, material / self.cup.wall(place)[0] / stretch))

    def fill_corner(self, pressure: float, share: float) -> None:
        """Advances along wall and bottom, by shares of the distance that is left to the corner, up to a pressure."""
        corner = self.cup.depth / math.sin(self.cup.angle)
        begun = min(1e-3, share * (corner - self.place))
        length, last = begun, None
        while True:
            free = self._advance_both(length, None)
            if free[1] >= pressure:
                free = self._advance_both(None, pressure, length)
            self._keep_both(free)
            if free[1] >= pressure * (1 - 1e-12):
                return
            last = length
            length = min(share * (corner - self.place), 1.3 * last)

    def _advance_both(self, length: float | None, pressure: float | None, guess_length: float = 0.0) -> Array:
        """Inner stretch, pressure, bottom radius, outer material, and length along the wall, of the next state.

        One of length and pressure is given.
        """
        law, cup = self.law, self.cup

        def unpack(free: Array) -> tuple[Any, ...]:
            stretch, one, bottom, material = free
            step, load = (length, one) if length is not None else (one, pressure)
            inner = self.inner + 0.5 * (bottom - self.bottom) * (1 / self.inner_stretch + 1 / stretch)
            return stretch, load, bottom, material, step, inner

        def misses(free: Array) -> list[float]:
            stretch, load, bottom, material, step, inner = unpack(free)
            radius, height = cup.wall(self.place + step)
            s, hoop, slope, z = _march(law, load, (inner, stretch, bottom / inner, 0.0, cup.depth), material)
            moved = 0.5 * step * (1 / self.outer_stretch + 1 / s)
            return [hoop * material - radius, slope - cup.angle, z - height, material - self.outer + moved]

        step = length if length is not None else guess_length
        one = self.pressure * 1.01 if length is not None else guess_length
        start = [self.inner_stretch, one, self.bottom + step, self.outer - step / self.outer_stretch]
        return np.array(unpack(_solve(misses, start)))

    def _keep_both(self, free: Array) -> None:
        stretch, self.pressure, self.bottom, material, step, self.inner = map(float, free)
        self.inner_stretch = stretch
        self.place += step
        begin = (self.inner, stretch, self.bottom / self.inner, 0.0, self.cup.depth)
        edge = _march(self.law, self.pressure, begin, material)[0]
        self._keep_outer(self.place, material, edge)
        self.on_bottom.append((self.inner, self.inner / self.bottom / stretch))

    def wall(self) -> Wall:
        """The wall as it is now."""
        free: list[tuple[float, float]] = []
        begin = (self.inner, self.inner_stretch, self.bottom / self.inner, 0.0, self.cup.depth)
        _march(self.law, self.pressure, begin, self.outer, free)
        radius, thickness = np.array([*self.on_bottom, *free[:-1], *self.on_wall[::-1]]).T
        return Wall(self.pressure, radius, thickness, (self.inner, self.outer))


_POLE = 1e-5  # initial radius from which a cap is integrated


def _at_pole(law: Law, stretch: float, pressure: float) -> tuple[float, ...]:
    """Beginning of the integration over a cap."""
    curvature = 0.5 * pressure * stretch**2 / law.slopes(stretch, stretch)[0]
    return _POLE, stretch, stretch, curvature * _POLE, 0.0


def _solve(misses: Callable[[Array], Sequence[float]], guess: Sequence[float]) -> Array:
    """The root of a few equations near a guess."""
    found = root(misses, guess, tol=1e-12)
    if np.abs(found.fun).max() > 1e-9:
        raise RuntimeError(f"the membrane's equations have no solution near {guess}: {found.message}")
    return found.x
