"""Solutions that owe nothing to the simulator: shooting, a spectral method and closed forms. Lengths over the size.

Laws are W = c [(I1 - 3) + alpha (I2 - 3)], pressures in c h0 over the length that the solution is scaled with.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

Array = np.ndarray


class Disc(NamedTuple):
    """A clamped disc of radius 1 under pressure: the meridian over the initial radius (n,), from the pole.

    Attributes:
        pressure: P a / (c h0).
        radius: Initial radius.
        height: Above the rim.
        thickness: h / h0.
    """

    pressure: float
    radius: Array
    height: Array
    thickness: Array


def free_disc(alpha: float, pole_stretch: float) -> Disc:
    """A free disc by integration from the pole outwards, until the hoop stretch is 1: there is the rim.

    Meridian stretch s, hoop stretch h and slope p of the meridian over the initial radius R obey d(R W_s)/dR =
    cos(p) W_h, R dh/dR = s cos(p) - h and, across the membrane, k_s T_s + k_h T_h = P (unknowns scaled so that P = 1).
    """

    def slopes(s: float, h: float) -> tuple[float, float, float, float]:
        """First derivatives of W by s and h, then W_ss and W_sh."""
        a, b = 1 + alpha * h * h, 1 + alpha * s * s
        ws = 2 * (s - 1 / (s**3 * h * h)) * a
        wh = 2 * (h - 1 / (h**3 * s * s)) * b
        return ws, wh, 2 * (1 + 3 / (s**4 * h * h)) * a, 4 / (s * h) ** 3 * a + 4 * alpha * h * (s - 1 / (s**3 * h * h))

    def rates(radius: float, y: Array) -> list[float]:
        s, h, p, _ = y
        ws, wh, wss, wsh = slopes(s, h)
        hoop = (s * np.cos(p) - h) / radius
        turn = (s * h - np.sin(p) * wh / radius) / ws
        return [((np.cos(p) * wh - ws) / radius - wsh * hoop) / wss, hoop, turn, -s * np.sin(p)]

    def rim(_: float, y: Array) -> float:
        return y[1] - 1.0

    rim.terminal = True
    start, curvature = 1e-6, 0.5 * pole_stretch**2 / slopes(pole_stretch, pole_stretch)[0]
    begun = [pole_stretch, pole_stretch, curvature * start, 0.0]
    course = solve_ivp(
        rates, (start, 100.0), begun, events=rim, rtol=1e-11, atol=1e-12, method="DOP853", dense_output=True
    )
    end = float(course.t_events[0][0])
    radius = np.linspace(start, end, 2001)
    s, h, _, drop = course.sol(radius)
    return Disc(end, radius / end, (drop - drop[-1]) / end, 1 / (s * h))


def limit_point(alpha: float = 0.0) -> float:
    """The largest pressure that a disc bears; NaN where there is none below a pole stretch of 3."""
    found: Any = minimize_scalar(
        lambda stretch: -free_disc(alpha, stretch).pressure, bounds=(1.5, 3.0), method="bounded"
    )
    return -float(found.fun)


class Rectangle(NamedTuple):
    """A clamped rectangle [0, r] x [0, 1] under pressure.

    Attributes:
        height: Height of the middle, over the short side.
        thickness: h / h0 at points (n, 2), as a function.
    """

    height: float
    thickness: Any


def rectangle(pressure: float, alpha: float, ratio: float, degree: int = 10, points: int = 32) -> Rectangle:
    """A clamped rectangle by Ritz's method: the potential energy of polynomials is stationary.

    Displacements are (1 - x^2) (1 - y^2) times Legendre polynomials over [-1, 1]^2 that are even or odd, as symmetry
    asks; Newton's method from a flat sheet with the pressure in parts. The pressure's potential is minus P V.

    Args:
        pressure: P L / (c h0), L the short side.
        alpha: Parameter of the law.
        ratio: Long over short side.
        degree: Polynomials up to twice this degree along each side.
        points: Number of Gauss points along half a side.
    """
    at, weight = np.polynomial.legendre.leggauss(points)
    at, weight = 0.5 * (at + 1), 0.5 * weight
    even, odd = (_along(at, [2 * k + first for k in range(degree)]) for first in (0, 1))
    fields = [(odd, even), (even, odd), (even, even)]
    area = np.outer(weight, weight)

    def gradients(free: jax.Array, fields: Any) -> Any:
        """Value and derivatives of the three displacements."""
        parts = free.reshape(3, degree, degree)
        return [
            [jnp.einsum("ip,ij,jq->pq", x[a], part, y[b]) for a, b in ((0, 0), (1, 0), (0, 1))]
            for part, (x, y) in zip(parts, fields, strict=True)
        ]

    def potential(free: jax.Array, pressure: jax.Array) -> jax.Array:
        (u, ux, uy), (v, vx, vy), (w, wx, wy) = gradients(free, fields)
        ux, vx, wx = ux / ratio, vx / ratio, wx / ratio
        trace, determinant = _strain((1 + ux, vx, wx), (uy, 1 + vy, wy))
        energy = trace + 1 / determinant - 3 + alpha * (determinant + trace / determinant - 3)
        px, py = ratio * jnp.asarray(at)[:, None] + u, jnp.asarray(at)[None, :] + v
        normal = (vx * wy - wx * (1 + vy), wx * uy - (1 + ux) * wy, (1 + ux) * (1 + vy) - vx * uy)
        volume = (px * normal[0] + py * normal[1] + w * normal[2]) / 3
        # Over half sides of length 1, so that the pressure is in c h0 over half a side.
        return jnp.sum(area * (energy - 0.5 * pressure * volume))

    slope, bend = jax.jit(jax.grad(potential)), jax.jit(jax.hessian(potential))
    free = np.zeros(3 * degree**2)
    # A flat sheet has no stiffness across: the first guess is a bulge.
    free[2 * degree**2] = 0.3
    for part in pressure * np.linspace(0.25, 1.0, 4):
        for _ in range(60):
            way = np.linalg.solve(np.asarray(bend(free, part)), np.asarray(slope(free, part)))
            free = free - way * min(1.0, 0.2 / np.abs(way).max())
            if np.abs(way).max() < 1e-12:
                break

    def thickness(places: Array) -> Array:
        x, y = np.abs(2 * np.asarray(places).T / np.array([[ratio], [1.0]]) - 1)
        total = np.zeros((3, 2, x.size))
        for k, kinds in enumerate(((1, 0), (0, 1), (0, 0))):
            bx, by = (_along(p, [2 * n + first for n in range(degree)]) for p, first in zip((x, y), kinds, strict=True))
            part = free.reshape(3, degree, degree)[k]
            total[k] = [np.einsum("in,ij,jn->n", bx[a], part, by[b]) for a, b in ((1, 0), (0, 1))]
        (ux, uy), (vx, vy), (wx, wy) = total / np.array([[[ratio], [1.0]]])
        return 1 / np.sqrt(np.asarray(_strain((1 + ux, vx, wx), (uy, 1 + vy, wy))[1]))

    middle = _along(np.zeros(1), [2 * k for k in range(degree)])[0, :, 0]
    return Rectangle(0.5 * float(middle @ free[2 * degree**2 :].reshape(degree, degree) @ middle), thickness)


def _along(at: Array, degrees: list[int]) -> Array:
    """Values and derivatives (2, k, n) of (1 - x^2) times Legendre polynomials of degrees (k,) at places (n,)."""
    series = [
        np.polynomial.Legendre.basis(k) * np.polynomial.Polynomial([1, 0, -1]).convert(kind=np.polynomial.Legendre)
        for k in degrees
    ]
    return np.array([[part(at) for part in series], [part.deriv()(at) for part in series]])


def _strain(first: Any, second: Any) -> tuple[Any, Any]:
    """Trace and determinant of the metric of two tangents."""
    a, b, d = (
        sum(p * q for p, q in zip(*pair, strict=True)) for pair in ((first, first), (first, second), (second, second))
    )
    return a + d, a * d - b * b
