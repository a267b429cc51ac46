"""The length of the steps of a window: piecewise constant in the design, so it carries no gradient.

The limit of the central difference is 2 over the square root of the largest eigenvalue of the inverse mass times the
tangent stiffness. Element by element it is bounded from below, by a half on the meshes of the built-in scenes; Lanczos'
method with the force's own tangent measures it to a percent. The mode is kept from window to window, so that few
products with the tangent suffice.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import ArraySlice, lax_cond_once, materialize, over_blocks
from jaxform.loads import RegionalLoad
from jaxform.mechanics import constitutive, membrane
from jaxform.mechanics.constitutive import instantaneous_memory
from jaxform.mechanics.corners import Load, corner_force_changes
from jaxform.mechanics.elements import Corners, allocate_corner_forces, gather_shares, gather_table, highest_speed
from jaxform.model.scene import Scene
from jaxform.model.tables import MOST_COOLING, RANGE_PER_STEP, SHORT_WINDOW, SLACK, UNDAMPED
from jaxform.sheet.active_set import ActiveSet, Workspace
from jaxform.sheet.discretization import element_law
from jaxform.sheet.energy_balance import energy_rounding, present_pressure
from jaxform.sheet.state import PackedState, can_move, clamp_is_open, immobile_nodes, next_stop, noise_vector

LEVELS_PER_OCTAVE = 16
_FEW, _MANY = 2, 12  # products with the tangent, where the mode is known and where it is not
_NOISE = 0.1  # of what a thorough search begins with: else it is blind for modes that the last one lacks
_MARGIN = 0.98  # for a mode that was missed: larger errors are covered by the safety (docs/stability.md)
_ROUNDING = 1e-3  # of the elements' bound: it is exact where there is one element
_SQUARINGS = 30  # of a small matrix: they separate eigenvalues a billionth apart
_MOST_SHARPENING = 4.0  # how far beyond the elements' bound the step may go
_RISE = 1.02  # of that from one window to the next: where it seems to be more, the mode may have been lost
_WEAK_DAMPING = 5e-4, 2e-3  # of a velocity in a step: with less the step is that without damping, with more the whole
_SWINGING = 5.0  # over damping: time until a sheet released by a clamp has less than 1 % of its kinetic energy
_GAIN, _MOST_SHORTENING = 1e-3, 4.0  # of the largest work: gained beyond that, the step is shorter in proportion
_RISE_LEVELS = 15.5  # by how many the step rises again where nothing damps: between two, so that rounding decides none
LEAST_LEFT = 0.01  # of a velocity after a window's damping: from less it could not be found again
_MOST_GROWTH = 0.7  # by what factor the step is shortened for the stiffness that grows


StepLimit = tuple[jax.Array | None, jax.Array, jax.Array, jax.Array]
"""Data of the stable step, kept for the next window: `mode`, as in `Nodes`, and `bound`, `sharpness`, `base_length`, as
in `Control`."""


StepChoice = tuple[jax.Array, jax.Array, StepLimit, Workspace | None]
"""Step length of a window [s], largest number of steps, data of the stable step, and the workspace that was used.

The workspace is None where none is kept.
"""


def choose_step(state: PackedState, scene: Scene, active: ActiveSet) -> StepChoice:
    """The step of the next window: a value 2^(k/16) s, or one that divides the remaining time evenly.

    The state is in packed order.
    """
    state, scene, active = jax.lax.stop_gradient((state, scene, active))
    longest, limit, workspace = _limit(state, scene, active)
    longest = scene.solver.safety * longest
    damped = damped_share(longest, scene)
    if scene.parison.clamp_until is not None:
        damped = jnp.where(_swings_from_clamp(state, scene), 0.0, damped)
    shorter = UNDAMPED / _gain_factor(state, scene, active)
    longest = (shorter + (1.0 - shorter) * damped) * longest
    end = next_stop(state, scene)
    for mold, grid, _ in scene.surfaces:
        # In one step no node passes more of its list's range than the checks of the broad phase allow.
        range_per_step = RANGE_PER_STEP * grid.farthest
        speed = highest_speed(state.nodes.velocities, active.packed.elements.node_block_count)
        if mold.motion is not None:
            # The window ends where the tool becomes faster.
            fastest, until = mold.motion.speed_from(state.time)
            speed, end = speed + fastest, jnp.minimum(end, until)
        longest = jnp.minimum(longest, range_per_step / jnp.maximum(speed, 1e-30))
    base_length = jnp.exp2(jnp.floor(jnp.log2(longest) * LEVELS_PER_OCTAVE) / LEVELS_PER_OCTAVE)
    held = jnp.where(damped < 1.0, _hold_length(base_length, state, scene), base_length)
    limit, base_length = (*limit[:3], held), held * jnp.exp2(-state.control.retries)
    rest = end - state.time
    most = jnp.minimum(state.control.window_steps, max_step_count(base_length, scene))
    if state.control.cooling_rate is not None:
        cooling = jnp.maximum(state.control.cooling_rate * base_length, jnp.finfo(base_length.dtype).tiny)
        most = jnp.clip(MOST_COOLING / cooling, 1, most).astype(most.dtype)
    left = rest / base_length
    shared = _share_rest(rest, base_length, most)
    base_length, most = (
        jnp.where(damped < 1.0, own, whole) for own, whole in zip(shared, (base_length, most), strict=True)
    )
    most = jnp.clip(jnp.ceil(left), jnp.minimum(most, SHORT_WINDOW), most).astype(state.control.window_steps.dtype)
    return jax.lax.stop_gradient((jnp.minimum(base_length, rest / most), most, limit, workspace))


def _gain_factor(state: PackedState, scene: Scene, active: ActiveSet) -> jax.Array:
    """Factor, 1 to 4, by which the step is shortened because the run has gained energy by errors of the scheme.

    In nonlinear motion the fast modes gain energy at steps at which a linear mode is stable, unless damping takes it.
    """
    account = state.account
    gained = account.imbalance - energy_rounding(scene, active.material_volume)
    share = gained / jnp.maximum(account.peak_work, jnp.finfo(gained.dtype).tiny)
    return jnp.clip(share / _GAIN, 1.0, _MOST_SHORTENING)


def damped_share(length: jax.Array, scene: Scene) -> jax.Array:
    """From 0, where damping takes too little in a step [s] to keep fast modes from gaining energy, to 1."""
    damping = scene.solver.damping
    if damping is None:
        return jnp.zeros_like(length)
    taken = jnp.maximum(jax.lax.stop_gradient(damping) * length, jnp.finfo(length.dtype).tiny)
    weak, strong = (math.log(taken) for taken in _WEAK_DAMPING)
    return jnp.clip((jnp.log(taken) - weak) / (strong - weak), 0.0, 1.0)


def _swings_from_clamp(state: PackedState, scene: Scene) -> jax.Array | bool:
    """True from the opening of the clamp on, until damping has taken the energy of the fast modes that it excites.

    As long as there is such energy, every change of the step changes it.
    """
    until, damping = scene.parison.clamp_until, scene.solver.damping
    if until is None or damping is None:
        return False
    last = jnp.maximum(damping, jnp.finfo(damping.dtype).tiny)
    return clamp_is_open(state, scene) & (state.time < until + _SWINGING / last)


def _share_rest(rest: jax.Array, step: jax.Array, most: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Step [s] and largest number of steps of a window where the last two share the rest of the time [s] evenly.

    Otherwise the steps of the last window would be much shorter than those before.
    """
    left = jnp.ceil(rest / step - SLACK)
    shared = left < most + SHORT_WINDOW
    count = jnp.where(left > most, left - jnp.minimum(most, SHORT_WINDOW), left)
    return jnp.where(shared, rest / jnp.maximum(left, 1), step), jnp.where(shared, count, most)


def _hold_length(base_length: jax.Array, state: PackedState, scene: Scene) -> jax.Array:
    """The base length [s] for an undamped sheet: it falls with the limit, and rises by several levels at once.

    Every change of the step changes the energy of the fast modes, which nothing takes away; and since the step falls
    where the sheet is stiff and rises where it is soft, a sheet that swings would gain energy in every period. So as
    long as nothing sticks to a tool and no tool moves, the step never rises. Where a gas fills a sheet that is damped,
    it rises, since a gas of small volume is much stiffer than the same gas in the inflated sheet.
    """
    before = state.control.base_length
    longer = (base_length > before) & (before > 0.0)
    rises = base_length > jnp.exp2(_RISE_LEVELS / LEVELS_PER_OCTAVE) * before
    if scene.moves or (scene.pressure.follows_volume and scene.solver.damping is not None):
        longer &= ~rises
    elif scene.surfaces:
        longer &= ~(rises & jnp.any(state.nodes.stuck & (state.nodes.wall != 0)))
    return jnp.where(longer, before, base_length)


def max_step_count(length: jax.Array, scene: Scene) -> jax.Array:
    """Maximum number of steps of a length [s] in a window: beyond a short one, no more than can be inverted."""
    longest, damping = jnp.int32(scene.tables.longest_window), scene.solver.damping
    if damping is None or scene.tables.step_capacity <= SHORT_WINDOW:
        return longest
    half = 0.5 * jax.lax.stop_gradient(damping) * length
    taken = jnp.log1p(half) - jnp.log1p(-jnp.minimum(half, 0.5))  # of a velocity's logarithm, in a step
    most = -math.log(LEAST_LEFT) / jnp.maximum(taken, jnp.finfo(taken.dtype).eps)
    return jnp.clip(most, jnp.minimum(SHORT_WINDOW, longest), longest).astype(longest.dtype)


def _limit(state: PackedState, scene: Scene, active: ActiveSet) -> tuple[jax.Array, StepLimit, Workspace | None]:
    """The longest stable step [s], its data for the next window, and the workspace that was used.

    How much sharper the measured step is than the elements' bound depends on shapes and changes slowly. A search that
    begins with the last window's mode may miss another that has become the highest, and finds a step that is too long:
    where the step seems to rise, the search is repeated from noise, as where no mode is known; a smaller rise is
    ignored.
    """
    bound, begin = element_step_bound(state, scene, active), state.nodes.mode
    if begin is None:
        return bound, (None, bound, state.control.sharpness, bound), active.workspace

    def search(found: tuple[jax.Array, jax.Array, jax.Array, jax.Array, tuple[Corners, jax.Array]]) -> Any:
        thorough = found[2]
        mode, (least, square), own = _highest_mode(state, begin, scene, active, thorough, found[4])
        sharpness = _MARGIN * 2.0 / (bound * jnp.sqrt(square))
        # The elements' bound counts as well, unless there is a mode that proves it wrong.
        wrong = bound * jnp.sqrt(jnp.maximum(least, 0.0)) > 2.0 * (1.0 + _ROUNDING)
        sharpness = jnp.where(wrong, sharpness, jnp.clip(sharpness, 1.0, _MOST_SHARPENING))
        lost = ~thorough & (sharpness > _RISE * state.control.sharpness)
        sharpness = jnp.where(thorough, sharpness, jnp.minimum(sharpness, state.control.sharpness))
        return mode, sharpness, lost, lost, own

    known = state.control.sharpness > 0.0
    workspace, elements = active.workspace, active.packed.elements
    if workspace is None or workspace.basis is None:
        own = allocate_corner_forces(state.nodes.positions, elements), allocate_basis(begin.shape[1], begin.dtype)
    else:
        own = workspace.corners, workspace.basis
    initial = begin, state.control.sharpness, ~known, jnp.asarray(True), own
    mode, sharpness, _, _, (corners, basis) = jax.lax.while_loop(lambda found: found[3], search, initial)
    # Growth of the stiffness so far stands for growth within the window, which may take more steps than the last.
    before, windows = (
        state.control.sharpness * state.control.bound,
        state.control.window_steps / jnp.maximum(state.control.last_count, 1),
    )
    growth = (sharpness * bound / before) ** jnp.where(state.control.last_count > 0, windows, 1.0)
    growth = jnp.where(known, jnp.clip(growth, _MOST_GROWTH, 1.0), 1.0)
    workspace = None if workspace is None else dataclasses.replace(workspace, corners=corners, basis=basis)
    longest = jnp.maximum(growth * sharpness, jnp.minimum(sharpness, 1.0)) * bound
    return longest, (mode, bound, sharpness, longest), workspace


def element_step_bound(state: PackedState, scene: Scene, active: ActiveSet) -> jax.Array:
    """A step [s] that is stable for any neighbours of the elements, in tension. The state is in packed order."""
    rows, elements = membrane.unstack_rows(state.nodes.positions), active.packed.elements
    immobile = immobile_nodes(state, scene)

    def compute_block(own: tuple[jax.Array, ...], bound: jax.Array, zones: Any, memory: Any, modes: Any) -> Any:
        triangles, inverse, area = own
        # Where user-defined fields continue after all nodes stick, the steps keep their length.
        moving = can_move(immobile, triangles, area) if scene.rests else area > 0.0
        material = element_law(scene.material, zones, modes)
        return [], [constitutive.element_stiffness(rows, triangles, inverse, bound, moving, material, memory)]

    own = elements.triangles, elements.inverse_metric, elements.area
    inputs = own, active.bound, active.zones, state.memory, active.modes
    _, (largest,) = over_blocks(compute_block, elements.block_count, inputs, [], most=1)
    step = constitutive.stable_step(largest, scene.material)
    if not scene.pressure.follows_volume:
        return step
    # The largest eigenvalue of a sum is at most the sum of the largest ones.
    slope, rise, compliance = _pressure_slope(state, scene, active)
    if isinstance(scene.pressure, RegionalLoad):
        norms = jnp.maximum(-slope, 0.0) * jnp.sum(compliance * jnp.square(rise), axis=(1, 2))
        more = _add_sides(norms, scene.pressure)
    else:
        more = jnp.maximum(-slope, 0.0) * jnp.sum(compliance * jnp.square(rise))
    return 2.0 / jnp.sqrt(jnp.square(2.0 / step) + more)


def _pressure_slope(state: PackedState, scene: Scene, active: ActiveSet) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Slopes of pressure by volume [Pa/m^3] and of volume by nodes (3, place) [m^2], and compliance [1/kg].

    With loads of regions there are such of each (n_load, ...).
    """
    positions = state.nodes.positions
    if isinstance(scene.pressure, RegionalLoad):
        volume, rise = active.volume(positions), jax.jacrev(active.volume)(positions)
        slope = jax.grad(lambda volume: jnp.sum(present_pressure(state, scene, volume).pressure))(volume)
    else:
        volume, rise = jax.value_and_grad(active.volume)(positions)
        slope = jax.grad(lambda volume: present_pressure(state, scene, volume).pressure)(volume)
    return slope, rise, jnp.where(state.nodes.stuck, 0.0, active.compliance)


def _add_sides(norms: jax.Array, load: RegionalLoad) -> jax.Array:
    """Bound of the eigenvalues that loads of regions add, from those (n_load,) [1/s^2] that each adds by itself.

    The pressure of each adds a product of rank one. Regions on one side of the sheet have no free node in common: their
    products are orthogonal in the metric of the masses, and their sum has the largest of their norms.
    """
    return functools.reduce(jnp.add, [jnp.max(jnp.where(side, norms, 0.0)) for side in load.sides])


def _volume_force_change(falling: tuple[jax.Array, ...], moved: jax.Array) -> jax.Array:
    """Change of the nodal forces (3, place) by that of the pressures, from `_pressure_slope`, as nodes move."""
    slope, rise, _ = falling
    if slope.ndim == 0:
        return slope * jnp.sum(rise * moved) * rise
    return jnp.tensordot(slope * jnp.sum(rise * moved, axis=(1, 2)), rise, 1)


class _Lanczos(NamedTuple):
    """State of the Lanczos iteration.

    Attributes:
        vector: Next Lanczos vector (3, place), not normalized.
        size: Its norm.
        last: Last Lanczos vector (3, place), of norm 1.
        basis: All Lanczos vectors so far, one after the other (3, several places).
        diagonal, beside: Diagonals of the tridiagonal matrix.
        new: Workspace (3, place).
        corners: Workspace for corner forces.
    """

    vector: jax.Array
    size: jax.Array
    last: jax.Array
    basis: jax.Array
    diagonal: jax.Array
    beside: jax.Array
    new: jax.Array
    corners: list[jax.Array]


def allocate_basis(places: int, real: jnp.dtype) -> jax.Array:
    """Workspace for the vectors of a search, one after the other (3, several places)."""
    return jnp.zeros((3, _MANY * places), real)


def _highest_mode(
    state: PackedState,
    mode: jax.Array,
    scene: Scene,
    active: ActiveSet,
    thorough: jax.Array,
    workspace: tuple[Corners, jax.Array],
) -> tuple[jax.Array, tuple[jax.Array, jax.Array], tuple[Corners, jax.Array]]:
    """The mode (3, place), and its squared frequency [1/s^2] without the residual and with it, by Lanczos' method.

    The method approaches the frequency from below, so the residual is added for an upper estimate. `workspace` has
    workspaces for corner forces and Lanczos vectors, and is returned, too.
    """
    elements, places = active.packed.elements, active.mass.size
    compliance = jnp.where(state.nodes.stuck, 0.0, active.compliance)
    volume, falling = None, None
    if scene.pressure.follows_volume:
        volume, falling = active.volume(state.nodes.positions), _pressure_slope(state, scene, active)
    pressure = present_pressure(state, scene, volume).pressure
    modes = active.viscous(scene.material)
    memory = None if modes is None or state.memory is None else instantaneous_memory(state.memory, modes)
    load = Load(state.nodes.positions, active.thickness, pressure, *active.response(scene.material.stiffest, memory))

    def over_nodes(work: Callable[..., Any], inputs: Any, into: Any, **kinds: Any) -> Any:
        return over_blocks(work, elements.node_block_count, inputs, into, **kinds)

    def norm(vector: jax.Array) -> jax.Array:
        _, (square,) = over_nodes(lambda m, v: ([], [m * membrane.dot(v, v)]), (active.mass, vector), [], sums=1)
        return jnp.sqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))

    def add_noise(mode: jax.Array) -> jax.Array:
        there = jnp.zeros((3, active.packed.place.size), mode.dtype)
        noise = jnp.sqrt(compliance) * active.packed.pack(noise_vector(there))
        return mode / norm(mode) + _NOISE / norm(noise) * noise

    def multiply(k: jax.Array, iteration: _Lanczos) -> _Lanczos:
        corners, scale = corner_force_changes(load, elements, iteration.vector, iteration.corners), 1.0 / iteration.size

        inputs = gather_table(elements), active.mass, compliance, iteration.vector
        if falling is not None:
            # The change of a pressure with its volume adds a product of rank one.
            inputs = *inputs, _volume_force_change(falling, iteration.vector)

        def multiply_block(own: Any, mass: jax.Array, compliance: jax.Array, vector: jax.Array, *more: Any) -> Any:
            forces = membrane.vector(gather_shares(corners, own))
            for other in more:
                forces = membrane.plus(forces, other)
            new = membrane.vector(-scale * c * f for c, f in zip(compliance, forces, strict=True))
            return [new], [scale * mass * membrane.dot(vector, new)]

        (new,), (rate,) = over_nodes(multiply_block, inputs, [iteration.new], sums=1)
        before = jnp.where(k > 0, iteration.beside[k - 1], 0.0)

        def orthogonalize(old: Any, mass: jax.Array, new: jax.Array) -> Any:
            unit = [scale * v for v in old[0]]
            vector = membrane.vector(x - rate * v - before * w for x, v, w in zip(new, unit, old[1], strict=True))
            # Both are computed before either is written (docs/explanation/kernels.md).
            vector, unit = materialize((vector, unit))
            return [vector, unit, unit], [mass * membrane.dot(vector, vector)]

        into = [iteration.vector, iteration.last, ArraySlice(iteration.basis, k * places, places)]
        (vector, unit, basis), (square,) = over_nodes(orthogonalize, (active.mass, new), into, sums=1, update=2)
        size = jnp.sqrt(square)
        return _Lanczos(
            vector=vector,
            size=jnp.where(size > 0.0, size, 1.0),
            last=unit,
            basis=basis,
            diagonal=iteration.diagonal.at[k].set(rate),
            beside=iteration.beside.at[k].set(size),
            new=new,
            corners=corners,
        )

    start = lax_cond_once(thorough, add_noise, jnp.where(compliance > 0.0, mode, 0.0))
    none, nowhere = jnp.zeros(_MANY, start.dtype), jnp.zeros_like(start)
    count = jnp.where(thorough, _MANY, _FEW)
    corners, basis = workspace
    initial = _Lanczos(start, norm(start), nowhere, basis, none, none, nowhere, corners)
    done = jax.lax.fori_loop(0, count, multiply, initial)
    off = jnp.where(jnp.arange(1, _MANY) < count, done.beside[:-1], 0.0)
    square, share = _largest_of_few(done.diagonal, off)
    square, share = lax_cond_once(thorough, lambda _: _largest_of_many(done.diagonal, off), (square, share))

    def add(k: jax.Array, mode: jax.Array) -> jax.Array:
        def compute_block(old: Any, unit: jax.Array) -> Any:
            return [[x + share[k] * v for x, v in zip(old[0], unit, strict=True)]], []

        return over_nodes(compute_block, (ArraySlice(done.basis, k * places, places),), [mode], update=1)[0][0]

    mode = jax.lax.fori_loop(0, count, add, nowhere)
    missing = jnp.abs(done.beside[count - 1] * share[count - 1])
    return mode, (square, square + missing), (done.corners, done.basis)


def _largest_of_many(diagonal: jax.Array, off: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Largest eigenvalue of a symmetric matrix of three diagonals, and its vector (n,).

    The matrix, shifted so that none of its eigenvalues is negative, is squared until nothing else is left in it. A call
    of a library would keep XLA from compiling the search into one function.
    """
    diagonal, off = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (diagonal, off))
    small = jnp.diag(diagonal) + jnp.diag(off, 1) + jnp.diag(off, -1)
    bound = jnp.maximum(jnp.max(jnp.sum(jnp.abs(small), axis=1)), jnp.finfo(small.dtype).tiny)

    def square_scaled(_: jax.Array, power: jax.Array) -> jax.Array:
        power = power / jnp.max(jnp.abs(power))
        return jnp.sum(power[:, :, None] * power[None], axis=1)

    power = jax.lax.fori_loop(0, _SQUARINGS, square_scaled, small / bound + jnp.eye(len(small), dtype=small.dtype))
    vector = power[:, jnp.argmax(jnp.diag(power))]
    vector = vector / jnp.sqrt(jnp.sum(jnp.square(vector)))
    return jnp.sum(vector * jnp.sum(small * vector[None], axis=1)), vector


def _largest_of_few(diagonal: jax.Array, off: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Largest eigenvalue and vector of the first two rows, in closed form: cheap for a small sheet."""
    assert _FEW == 2
    first, second, beside = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (diagonal[0], diagonal[1], off[0]))
    half = 0.5 * (first - second)
    angle = 0.5 * jnp.arctan2(beside, half)
    vector = jnp.zeros_like(diagonal).at[0].set(jnp.cos(angle)).at[1].set(jnp.sin(angle))
    return 0.5 * (first + second) + jnp.hypot(half, beside), vector
