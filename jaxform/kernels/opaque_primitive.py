"""Functions that are traced by themselves: one operation for whatever is around, `shard_map` and derivatives included.

Under `shard_map` JAX types every value by the mesh axes along which it differs, and a loop whose carry starts with a
constant then has no valid type. A simulation speaks with no other device, so its inside needs no such types: inputs are
made to differ along all axes at once, and so do the results.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any

import jax

# Private, for want of a public way: such rules alone are told whether `jax.linearize` asks or `jax.vjp`.
from jax._src.interpreters.ad import fallback_linearize_rule, primitive_linearizations
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe
from jax.sharding import PartitionSpec

from jaxform.core.promotion import with_standard_promotion

_TWICE = (
    "the gradient of a simulation has no reverse derivative: take second derivatives forward over reverse, by "
    "jax.hessian(f) or jax.jvp(jax.grad(f), ...)"
)


@with_standard_promotion
def call_opaque(function: Callable[..., Any], *arguments: Any, name: Hashable = None) -> Any:
    """The function's result; forward derivatives pass through, reverse ones are refused.

    Args:
        function: Of trees of arrays; it may close over no traced value.
        arguments: What it is called with.
        name: What tells the function from all others; with one it is traced once for arguments alike. JAX asks for the
            derivatives of a loop's body several times.

    Raises:
        NotImplementedError: Where a reverse derivative is asked for.
    """
    leaves, structure = jax.tree.flatten(arguments)
    if name is None:
        flat = _Flat(function, structure)
    else:
        flat = _placeholder(name, structure)
        flat.function = function
    jaxpr = (
        jax.make_jaxpr(flat)(*_plain_shapes(leaves))
        if name is None
        else flat.jitted.trace(*_plain_shapes(leaves)).jaxpr
    )
    leaves = match_mesh_axes(leaves)
    results = _sealed_p.bind(*leaves, jaxpr=jaxpr)
    # What is handed on as it was given stays the same value for whoever looks at it, such as a loop.
    given = dict(zip(map(id, jaxpr.jaxpr.invars), leaves, strict=True))
    outgoing = map(id, jaxpr.jaxpr.outvars)
    return jax.tree.unflatten(flat.made, [given.get(*pair) for pair in zip(outgoing, results, strict=True)])


class _Flat:
    """A function of leaves, which gives leaves.

    Attributes:
        function: Of trees.
        structure: Of its arguments.
        made: The structure of its result, once it has been traced.
        jitted: The same, of which JAX keeps what it traced.
    """

    def __init__(self, function: Callable[..., Any], structure: Any) -> None:
        self.function, self.structure, self.made = function, structure, None
        self.jitted = jax.jit(self)

    def __call__(self, *leaves: jax.Array) -> list[jax.Array]:
        results, self.made = jax.tree.flatten(self.function(*jax.tree.unflatten(self.structure, leaves)))
        return results


@functools.lru_cache(maxsize=32)
def _placeholder(_: Hashable, structure: Any) -> _Flat:
    return _Flat(lambda: None, structure)


def manual_axes(leaves: Sequence[Any]) -> frozenset[str]:
    """The mesh axes of a `shard_map` around, along which any of these arrays differs."""
    return frozenset().union(*(jax.typeof(leaf).manual_axis_type.varying for leaf in leaves))


def match_mesh_axes(leaves: Sequence[Any]) -> list[Any]:
    """The arrays typed as if each differed along the axes along which any does; as they are outside of `shard_map`."""
    axes = manual_axes(leaves)
    if not axes:
        return list(leaves)
    missing = [tuple(sorted(axes - jax.typeof(leaf).manual_axis_type.varying)) for leaf in leaves]
    return [
        jax.lax.pcast(leaf, is_missing, to="varying") if is_missing else leaf
        for leaf, is_missing in zip(leaves, missing, strict=True)
    ]


def type_like(shape: tuple[int, ...], dtype: Any, example: Any) -> Any:
    """The type of a result of such a shape that differs along the same axes as an argument of the type `example`."""
    sharding = example.sharding.update(spec=PartitionSpec(*[None] * len(shape)))
    return example.update(shape=shape, dtype=dtype, weak_type=False, sharding=sharding)


def lower_without_axes(function: Callable[..., Any]) -> Any:
    """The lowering rule of a primitive from a function of flat arguments, without types of mesh axes."""
    lower = mlir.lower_fun(function, multiple_results=True)

    def rule(context: Any, *values: Any, **static: Any) -> Any:
        none = type(context.avals_in[0].manual_axis_type)() if context.avals_in else None
        plain = [
            [each.update(manual_axis_type=none) for each in avals] for avals in (context.avals_in, context.avals_out)
        ]
        return lower(context.replace(avals_in=plain[0], avals_out=plain[1]), *values, **static)

    return rule


def _plain_shapes(leaves: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in map(jax.typeof, leaves)]


def _result_types(*arguments: Any, jaxpr: Any) -> list[Any]:
    return [type_like(aval.shape, aval.dtype, arguments[0]) for aval in jaxpr.out_avals]


def _value(*leaves: Any, jaxpr: Any) -> Any:
    return jaxpr_as_fun(jaxpr)(*leaves)


def _linearize(is_vjp: bool, moving: Sequence[bool], *primals: Any, jaxpr: Any) -> Any:
    return fallback_linearize_rule(_sealed_p, is_vjp, moving, *primals, jaxpr=jaxpr, forward=not is_vjp)


def _jvp(primals: Any, tangents: Any, *, jaxpr: Any, forward: bool = False) -> tuple[Any, Any]:
    unknown = any(isinstance(tangent, pe.JaxprTracer) for tangent in tangents)
    if unknown and not forward:
        raise NotImplementedError(_TWICE)
    moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    both, moves = ad.jvp_jaxpr(jaxpr, moving, False)
    given = [tangent for tangent, here in zip(tangents, moving, strict=True) if here]
    found = _sealed_p.bind(*match_mesh_axes([*primals, *given]), jaxpr=both)
    # What is known now must not come out of one operation with what depends on unknown tangents.
    results = _sealed_p.bind(*primals, jaxpr=jaxpr) if unknown else found[: len(moves)]
    changes = iter(found[len(moves) :])
    none = [ad.Zero(jax.typeof(result).to_tangent_aval()) for result in results]
    return results, [next(changes) if here else zero for here, zero in zip(moves, none, strict=True)]


def _no_transpose(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(_TWICE)


def _batch(axis: Any, leaves: Any, axes: Any, *, jaxpr: Any) -> tuple[Any, Any]:
    """The batching rule: unbatched results stay unbatched, on which `jax.jacfwd` relies."""
    asked = [batching.zero_if_mapped] * len(jaxpr.out_avals)
    many, differs = batching.batch_jaxpr_axes(jaxpr, axis, axes, asked)
    results = _sealed_p.bind(*match_mesh_axes(leaves), jaxpr=many)
    return results, [0 if each else None for each in differs]


_sealed_p = Primitive("sealed")
_sealed_p.multiple_results = True
_sealed_p.is_high = lambda *_, **__: False  # what is inside, JAX brings down when it is compiled
_sealed_p.def_impl(lambda *leaves, jaxpr: jax.jit(partial(_value, jaxpr=jaxpr))(*leaves))
_sealed_p.def_abstract_eval(_result_types)
mlir.register_lowering(_sealed_p, lower_without_axes(_value))
ad.primitive_jvps[_sealed_p] = _jvp
ad.primitive_transposes[_sealed_p] = _no_transpose
primitive_linearizations[_sealed_p] = _linearize
batching.fancy_primitive_batchers[_sealed_p] = _batch
