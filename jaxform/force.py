"""The nodal force of the sheet and its hand-written derivative, forward and reverse.

The force is a JAX primitive of its own. Plain automatic differentiation would store every intermediate of every
element at every step; here the derivative needs the positions alone and works the rest out again. A `custom_vjp`
would shut out forward mode, which least-squares columns and power iteration need; the primitive has a tangent
(linear in its perturbations), the transpose of that tangent, and batching.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxform.materials import Material
from jaxform.membrane import Metric, cross, dot, edges, metric, stress


class Sheet(NamedTuple):
    """What the force needs of the initial mesh; no derivative is taken with respect to it.

    Attributes:
        triangles: Node numbers (3, n_element).
        inverse_metric: Inverse of the initial metric (3, n_element) [1/m^2].
        area: Initial area (n_element,) [m^2].
        origin: A point (3,) [m] on every symmetry plane, from which the enclosed volume is counted.
    """

    triangles: jax.Array
    inverse_metric: jax.Array
    area: jax.Array
    origin: jax.Array


class Load(NamedTuple):
    """What the force depends on smoothly.

    Attributes:
        positions: (3, n_node) [m].
        thickness: Initial thickness (n_element,) [m].
        pressure: A number [Pa].
        material: The law with its parameters.
    """

    positions: jax.Array
    thickness: jax.Array
    pressure: jax.Array
    material: Material


def force(load: Load, sheet: Sheet) -> tuple[jax.Array, jax.Array]:
    """Nodal force (3, n_node) [N], internal and pressure together, and the enclosed volume [m^3].

    The volume is what the pressure works on: its derivative with respect to the positions of nodes that can move,
    times the pressure, is the nodal force of the pressure.
    """
    leaves, structure = jax.tree.flatten((load, sheet))
    smooth = len(jax.tree.leaves(load))
    nodal, volume = _force_p.bind(*leaves, structure=structure, smooth=smooth)
    return nodal, volume


def _weighted_stress(g: Metric, sheet: Sheet, thickness: jax.Array, material: Material) -> Metric:
    """A0 h0 S^ab (n_element,): what multiplies the edges in the nodal forces."""
    s = stress(g, sheet.inverse_metric, material)
    weight = sheet.area * thickness
    return weight * s[0], weight * s[1], weight * s[2]


def _scatter(first: jax.Array, second: jax.Array, third: jax.Array, triangles: jax.Array, like: jax.Array) -> jax.Array:
    """Sum to the nodes (3, n_node) of the three corners' (3, n_element)."""
    nodal = jnp.zeros_like(like)
    for corner, values in zip(triangles, (first, second, third), strict=True):
        nodal = nodal.at[:, corner].add(values, mode="promise_in_bounds")
    return nodal


def _force(load: Load, sheet: Sheet) -> tuple[jax.Array, jax.Array]:
    first, edge1, edge2 = edges(load.positions, sheet.triangles)
    # The barriers keep XLA from working the element out anew for each of the nine components.
    edge1, edge2 = jax.lax.optimization_barrier((edge1, edge2))
    s = _weighted_stress(metric(edge1, edge2), sheet, load.thickness, load.material)
    s11, s12, s22 = jax.lax.optimization_barrier(s)
    normal = cross(edge1, edge2)
    push = (load.pressure / 6.0) * normal
    internal2, internal3 = s11 * edge1 + s12 * edge2, s12 * edge1 + s22 * edge2
    nodal = _scatter(push + internal2 + internal3, push - internal2, push - internal3, sheet.triangles, load.positions)
    volume = jnp.sum(dot(first - sheet.origin[:, None], normal)) / 6.0
    return nodal, volume


def _tangent(load: Load, sheet: Sheet, change: Load) -> tuple[jax.Array, jax.Array]:
    """Derivative of `_force` along `change`, linear in it; a missing part of `change` is None."""
    first, edge1, edge2 = edges(load.positions, sheet.triangles)
    edge1, edge2 = jax.lax.optimization_barrier((edge1, edge2))
    normal = cross(edge1, edge2)
    arm = first - sheet.origin[:, None]
    g = metric(edge1, edge2)
    internal2 = internal3 = push = jnp.zeros_like(edge1)
    volume = jnp.zeros_like(load.pressure)
    s_change = None
    if change.positions is not None:
        w0, w1, w2 = edges(change.positions, sheet.triangles)
        w1, w2 = jax.lax.optimization_barrier((w1, w2))
        s = _weighted_stress(g, sheet, load.thickness, load.material)
        internal2, internal3 = s[0] * w1 + s[1] * w2, s[1] * w1 + s[2] * w2
        normal_change = cross(w1, edge2) + cross(edge1, w2)
        push = (load.pressure / 6.0) * normal_change
        volume = volume + jnp.sum(dot(w0, normal) + dot(arm, normal_change)) / 6.0
        g_change = (2.0 * dot(edge1, w1), dot(edge1, w2) + dot(w1, edge2), 2.0 * dot(edge2, w2))
        s_change = _stress_change(load, sheet, g, g_change)
    for part in _parameter_changes(load, sheet, g, change):
        s_change = part if s_change is None else tuple(a + b for a, b in zip(s_change, part, strict=True))
    if s_change is not None:
        d11, d12, d22 = jax.lax.optimization_barrier(s_change)
        internal2 = internal2 + d11 * edge1 + d12 * edge2
        internal3 = internal3 + d12 * edge1 + d22 * edge2
    if change.pressure is not None:
        push = push + (change.pressure / 6.0) * normal
    nodal = _scatter(push + internal2 + internal3, push - internal2, push - internal3, sheet.triangles, load.positions)
    return nodal, volume


def _stress_change(load: Load, sheet: Sheet, g: Metric, g_change: Metric) -> Metric:
    return jax.jvp(lambda g: _weighted_stress(g, sheet, load.thickness, load.material), (g,), (g_change,))[1]


def _parameter_changes(load: Load, sheet: Sheet, g: Metric, change: Load) -> list[Metric]:
    """Changes of the weighted stress by thickness and by each parameter of the material that changes."""
    parts = []
    if change.thickness is not None:
        parts.append(_weighted_stress(g, sheet, change.thickness, load.material))
    parameters, structure = jax.tree.flatten(load.material)
    for k, tangent in enumerate(_flat(change.material, structure)):
        if tangent is not None:

            def along(value: jax.Array, k: int = k) -> Metric:
                material = jax.tree.unflatten(structure, [*parameters[:k], value, *parameters[k + 1 :]])
                return _weighted_stress(g, sheet, load.thickness, material)

            parts.append(jax.jvp(along, (parameters[k],), (tangent,))[1])
    return parts


def _flat(tree: Any, structure: Any) -> list[Any]:
    """Leaves of a tree in which a leaf may be None."""
    return structure.flatten_up_to(tree)


def _cotangent(load: Load, sheet: Sheet, wanted: list[bool], nodal: Any, volume: Any) -> list[jax.Array | None]:
    """Transpose of `_tangent`: from cotangents of force and volume to those of the leaves of the load."""
    first, edge1, edge2 = edges(load.positions, sheet.triangles)
    edge1, edge2 = jax.lax.optimization_barrier((edge1, edge2))
    normal = cross(edge1, edge2)
    g = metric(edge1, edge2)
    results = _Cotangents(load)
    if nodal is not None:
        w0, w1, w2 = edges(nodal, sheet.triangles)
        w1, w2 = jax.lax.optimization_barrier((w1, w2))
        total = 3.0 * w0 + w1 + w2
        g_change = (2.0 * dot(edge1, w1), dot(edge1, w2) + dot(w1, edge2), 2.0 * dot(edge2, w2))
        if wanted[0]:
            results.add_positions(*_position_cotangents(load, sheet, (edge1, edge2), (w1, w2, total), g, g_change))
        if wanted[2]:
            results.pressure = jnp.sum(dot(normal, total)) / 6.0
        results.add_parameters(load, sheet, g, g_change, wanted)
    if volume is not None and wanted[0]:
        arm = (volume / 6.0) * (first - sheet.origin[:, None])
        results.add_positions(cross(edge2, arm), cross(arm, edge1), (volume / 6.0) * normal)
    return results.leaves(sheet, wanted)


def _position_cotangents(
    load: Load,
    sheet: Sheet,
    e: tuple[jax.Array, jax.Array],
    w: tuple[jax.Array, jax.Array, jax.Array],
    g: Metric,
    g_change: Metric,
) -> tuple[jax.Array, jax.Array]:
    """Cotangents of the two edges; the internal part is symmetric, since it comes from an energy."""
    s, s_change = jax.jvp(lambda g: _weighted_stress(g, sheet, load.thickness, load.material), (g,), (g_change,))
    s11, s12, s22, d11, d12, d22 = jax.lax.optimization_barrier((*s, *s_change))
    total = (load.pressure / 6.0) * w[2]
    cotangent1 = cross(e[1], total) - (d11 * e[0] + d12 * e[1] + s11 * w[0] + s12 * w[1])
    cotangent2 = cross(total, e[0]) - (d12 * e[0] + d22 * e[1] + s12 * w[0] + s22 * w[1])
    return cotangent1, cotangent2


class _Cotangents:
    """Collects the cotangents of a load's leaves."""

    def __init__(self, load: Load) -> None:
        self.like = load.positions
        self.edge1: Any = 0.0
        self.edge2: Any = 0.0
        self.first: Any = 0.0
        self.moved = False
        self.pressure: jax.Array | None = None
        self.parameters: list[jax.Array | None] = [None] * (1 + len(jax.tree.leaves(load.material)))

    def add_positions(self, edge1: jax.Array, edge2: jax.Array, first: Any = 0.0) -> None:
        self.edge1, self.edge2, self.first = self.edge1 + edge1, self.edge2 + edge2, self.first + first
        self.moved = True

    def add_parameters(self, load: Load, sheet: Sheet, g: Metric, g_change: Metric, wanted: list[bool]) -> None:
        """Thickness and material: minus half the metric's change against the derivative of the stress."""
        if not any((wanted[1], *wanted[3:])):
            return
        halves = (-0.5 * g_change[0], -g_change[1], -0.5 * g_change[2])
        _, pull = jax.vjp(lambda h, m: _weighted_stress(g, sheet, h, m), load.thickness, load.material)
        self.parameters = jax.tree.leaves(pull(halves))

    def leaves(self, sheet: Sheet, wanted: list[bool]) -> list[jax.Array | None]:
        positions = None
        if wanted[0] and self.moved:
            own = self.first - self.edge1 - self.edge2
            positions = _scatter(own, self.edge1, self.edge2, sheet.triangles, self.like)
        thickness, *material = self.parameters
        found = [positions, thickness, self.pressure, *material]
        return [value if want else None for value, want in zip(found, wanted, strict=True)]


# How the functions above become primitives. Leaves of (load, sheet) are flat arguments; `structure` and `smooth`
# (the number of leaves of the load) are static; `present` says which of the load's leaves have a tangent.


def _force_flat(*leaves: Any, structure: Any, smooth: int) -> tuple[jax.Array, jax.Array]:
    return _force(*jax.tree.unflatten(structure, leaves))


def _tangent_flat(*leaves: Any, structure: Any, smooth: int, present: tuple[bool, ...]) -> tuple[jax.Array, jax.Array]:
    count = structure.num_leaves
    load, sheet = jax.tree.unflatten(structure, leaves[:count])
    given = iter(leaves[count:])
    changes = [next(given) if here else None for here in present]
    return _tangent(load, sheet, jax.tree.unflatten(jax.tree.structure(load), changes))


def _force_jvp(primals: Any, tangents: Any, *, structure: Any, smooth: int) -> tuple[Any, Any]:
    value = _force_p.bind(*primals, structure=structure, smooth=smooth)
    moving = [not isinstance(t, ad.Zero) for t in tangents]
    if any(moving[smooth:-1]):
        raise TypeError("the force has no derivative with respect to the initial mesh")
    given = [t for t, here in zip(tangents[:smooth], moving, strict=False) if here]
    present = tuple(moving[:smooth])
    change = _tangent_p.bind(*primals, *given, structure=structure, smooth=smooth, present=present)
    return value, change


def _tangent_transpose(
    cotangents: Any, *leaves: Any, structure: Any, smooth: int, present: tuple[bool, ...]
) -> list[Any]:
    count = structure.num_leaves
    load, sheet = jax.tree.unflatten(structure, leaves[:count])
    nodal, volume = (None if isinstance(c, ad.Zero) else c for c in cotangents)
    given = iter(leaves[count:])
    wanted = [here and ad.is_undefined_primal(next(given)) for here in present]
    found = _cotangent(load, sheet, wanted, nodal, volume)
    return [None] * count + [value for value, here in zip(found, present, strict=True) if here]


def _batch(function: Callable[..., Any], arguments: Any, axes: Any, **static: Any) -> tuple[Any, Any]:
    return jax.vmap(partial(function, **static), axes)(*arguments), (0, 0)


def _primitive(name: str, function: Callable[..., Any]) -> Primitive:
    """A primitive with two results that does what the function does, under jit and vmap."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *leaves, **static: jax.jit(partial(function, **static))(*leaves))
    primitive.def_abstract_eval(lambda *leaves, **static: _abstract(function, leaves, static))
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=True))
    batching.primitive_batchers[primitive] = partial(_batch, function)
    return primitive


def _abstract(function: Callable[..., Any], leaves: Any, static: dict[str, Any]) -> list[Any]:
    shaped = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    results = jax.eval_shape(partial(function, **static), *shaped)
    return [ShapedArray(result.shape, result.dtype) for result in results]


_force_p = _primitive("membrane_force", _force_flat)
_tangent_p = _primitive("membrane_force_tangent", _tangent_flat)
ad.primitive_jvps[_force_p] = _force_jvp
ad.primitive_transposes[_tangent_p] = _tangent_transpose
ad.primitive_jvps[_tangent_p] = lambda primals, tangents, **static: jax.jvp(
    partial(_tangent_flat, **static), primals, jax.tree.map(ad.instantiate_zeros, tangents)
)
