"""A clamped disc that is inflated slowly, at given heights of its pole: Ritz's method, with derivatives.

The meridian is r = R + R (1 - R^2) a(R), z = (1 - R^2) b(R) over the initial radius R (in radii of the disc), a and b
polynomials in R^2. In equilibrium the virtual work of the stress, which the simulator's own elements have, is that of
the pressure. The height is given and the pressure is found, not the reverse: beyond the largest pressure that a disc
bears, where real tests go, a pressure names two heights or none.

Derivatives are those of the equilibrium: Newton's method finds it, and one more step of it is differentiated.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import Law
from jaxform.extend import (
    Overstress,
    ViscousMemory,
    advance_memory,
    initial_overstress,
    principal_nominal_stress,
    principal_overstress,
)
from optimize.fitting import states

_TERMS, _POINTS = 10, 30  # of each polynomial; of Gauss along the radius
_LONGEST = 0.1  # radii: a step of the height
_MOST, _ENOUGH = 40, 1e-11  # of Newton's steps; what is left of the forces, relative to the scale of the stress


def plan(height: np.ndarray, time: np.ndarray | None) -> states.Path:
    """Steps to heights (n,) in radii, at times (n,) [s] from 0 or none at all, from a flat sheet on."""
    times = np.arange(1.0, len(height) + 1.0) if time is None else np.maximum(time, 1e-12)
    return states.split_path(height, times, 0.0, _LONGEST)


def inflate_bubble(law: Law, plan: states.Path, scale: float, viscous: bool) -> tuple[jax.Array, jax.Array]:
    """Pressure times radius over the sheet's thickness (n,) [Pa], and the pole's wall over the sheet's (n,).

    Args:
        law: The material model.
        plan: Steps to the heights.
        scale: The size of the stress [Pa].
        viscous: True if the Prony terms count; without them each height is by itself.

    Both are NaN where no equilibrium is found.
    """
    modes = law.viscous if viscous else None

    def step(carry: Any, now: tuple[jax.Array, jax.Array]) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        found, past = carry
        height, passed = now
        memory = None if modes is None or past is None else advance_memory(modes, past, passed)
        made = _equilibrium(law, memory, found, height, scale)
        one, two = _stretches(made[:-1])
        past = None if memory is None else principal_overstress(memory, one, two)
        radial, hoop = _stretches_at(made[:-1], jnp.zeros(1))
        # Without modes a height that has no equilibrium must not spoil the search at the next one.
        found = jnp.where(jnp.all(jnp.isfinite(made)), made, found) if modes is None else made
        return (found, past), (scale * made[-1], 1.0 / (radial * hoop)[0])

    past: Overstress | None = None if modes is None else initial_overstress(modes, _POINTS)
    heights, lengths, rows = plan
    first = jnp.zeros(2 * _TERMS + 1).at[_TERMS].set(heights[0]).at[-1].set(4.0 * heights[0])
    _, (pressure, wall) = jax.lax.scan(step, (first, past), (jnp.asarray(heights), jnp.asarray(lengths)))
    return pressure[rows], wall[rows]


def _equilibrium(
    law: Law, memory: ViscousMemory | None, begin: jax.Array, height: jax.Array, scale: float
) -> jax.Array:
    """Coefficients and scaled pressure (2 n_term + 1,) at a height."""

    def forces(found: jax.Array, law: Law, memory: ViscousMemory | None) -> jax.Array:
        return _forces(found, law, memory, height, scale)

    fixed = jax.lax.stop_gradient((law, memory))
    # The polynomials of a higher bubble are about as much larger.
    begin = jax.lax.stop_gradient(begin)
    begin = begin.at[_TERMS:-1].multiply(height / _pole(begin))

    def step(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        found, _, count = carry
        left = forces(found, *fixed)
        change = jnp.linalg.solve(jax.jacfwd(forces)(found, *fixed), left)
        # No stretch may become none or less.
        share = jnp.minimum(1.0, 0.5 / jnp.maximum(jnp.max(jnp.abs(change[:-1])), 1e-30))
        return found - share * change, jnp.max(jnp.abs(left)), count + 1

    def go_on(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[1] > _ENOUGH) & (carry[2] < _MOST)

    found, left, _ = jax.lax.while_loop(go_on, step, (begin, jnp.asarray(1.0), jnp.asarray(0)))
    found = jnp.where(left < 1e3 * _ENOUGH, found, jnp.nan)
    matrix = jax.jacfwd(forces)(found, *fixed)
    return found - jnp.linalg.solve(matrix, forces(found, law, memory))


def _forces(found: jax.Array, law: Law, memory: ViscousMemory | None, height: jax.Array, scale: float) -> jax.Array:
    """Residual forces (2 n_term + 1,), in units of the scale; the last one is the height's."""
    coefficients = found[:-1]
    (one, two), back = jax.vjp(_stretches, coefficients)
    stress = principal_nominal_stress(law, one, two, memory)
    weight = 2.0 * _WEIGHT * _RADIUS / scale
    inside = back((weight * stress[0], weight * stress[1]))[0]
    return jnp.append(inside - found[-1] * jax.grad(_volume)(coefficients), _pole(found) - height)


def _chebyshev(radius: Any) -> jax.Array:
    """The polynomials (n_term, n) in R^2 at radii (n,)."""
    at = 2.0 * radius * radius - 1.0
    rows = [jnp.ones_like(at), at]
    while len(rows) < _TERMS:
        rows.append(2.0 * at * rows[-1] - rows[-2])
    return jnp.stack(rows)


def _shapes(radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(1 - R^2) times the polynomials, and its derivative along R, (n_term, n) each."""
    shape = lambda r: (1.0 - r * r) * _chebyshev(r)  # noqa: E731
    return jax.jvp(shape, (radius,), (jnp.ones_like(radius),))


def _stretches_at(coefficients: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Stretches along the meridian and around (n,), at initial radii (n,)."""
    value, slope = _shapes(radius)
    out, up = coefficients[:_TERMS], coefficients[_TERMS:]
    hoop = 1.0 + out @ value
    radial = hoop + radius * (out @ slope)
    return jnp.sqrt(jnp.square(radial) + jnp.square(up @ slope)), hoop


_AT, _GAUSS = np.polynomial.legendre.leggauss(_POINTS)
_RADIUS, _WEIGHT = 0.5 * (_AT + 1.0), 0.5 * _GAUSS


def _stretches(coefficients: jax.Array) -> tuple[jax.Array, jax.Array]:
    return _stretches_at(coefficients, jnp.asarray(_RADIUS))


def _volume(coefficients: jax.Array) -> jax.Array:
    """Enclosed volume over pi, in radii cubed."""
    radius = jnp.asarray(_RADIUS)
    value, slope = _shapes(radius)
    out, up = coefficients[:_TERMS], coefficients[_TERMS:]
    return -jnp.sum(_WEIGHT * jnp.square(radius * (1.0 + out @ value)) * (up @ slope))


def _pole(found: jax.Array) -> jax.Array:
    """The pole's height, in radii."""
    signs = (-1.0) ** np.arange(_TERMS)
    return jnp.sum(signs * found[_TERMS : 2 * _TERMS])
