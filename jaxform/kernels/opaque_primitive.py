"""Functions that are one opaque operation to the transformations around them, such as `shard_map` and derivatives.

Under `shard_map` JAX types every value by the mesh axes along which it differs, and a loop whose carry starts with a
constant then has no valid type. A simulation does not communicate with other devices, so its inside needs no such
types: inputs are made to differ along all axes at once, and so do the results.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any

import jax
from jax._src.interpreters.ad import fallback_linearize_rule, primitive_linearizations
from jax.core import ShapedArray
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe
from jax.sharding import PartitionSpec

from jaxform.core.compilation import with_standard_promotion

_TWICE = (
    "the gradient of a simulation has no reverse derivative: take second derivatives forward over reverse, by "
    "jax.hessian(f) or jax.jvp(jax.grad(f), ...)"
)


@with_standard_promotion
def call_opaque(function: Callable[..., Any], *arguments: Any, name: Hashable = None) -> Any:
    """The function's result; forward derivatives pass through, reverse ones are refused.

    Args:
        function: Function of trees of arrays; it may close over no traced value.
        arguments: Its arguments.
        name: Key of the function; with one it is traced once for arguments alike. JAX asks for the derivatives of a
            loop's body several times.

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
    results = _opaque_p.bind(*leaves, jaxpr=jaxpr)
    # An argument that is returned unchanged stays the same value, which loops look for.
    given = dict(zip(map(id, jaxpr.jaxpr.invars), leaves, strict=True))
    outgoing = map(id, jaxpr.jaxpr.outvars)
    return jax.tree.unflatten(flat.made, [given.get(*pair) for pair in zip(outgoing, results, strict=True)])


class _Flat:
    """A function of leaves, which gives leaves.

    Attributes:
        function: The function of trees.
        structure: Tree structure of its arguments.
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
    return fallback_linearize_rule(_opaque_p, is_vjp, moving, *primals, jaxpr=jaxpr, forward=not is_vjp)


def _jvp(primals: Any, tangents: Any, *, jaxpr: Any, forward: bool = False) -> tuple[Any, Any]:
    unknown = any(isinstance(tangent, pe.JaxprTracer) for tangent in tangents)
    if unknown and not forward:
        raise NotImplementedError(_TWICE)
    moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    both, moves = ad.jvp_jaxpr(jaxpr, moving, False)
    given = [tangent for tangent, here in zip(tangents, moving, strict=True) if here]
    found = _opaque_p.bind(*match_mesh_axes([*primals, *given]), jaxpr=both)
    # Known values must not come out of one operation together with values that depend on unknown tangents.
    results = _opaque_p.bind(*primals, jaxpr=jaxpr) if unknown else found[: len(moves)]
    changes = iter(found[len(moves) :])
    none = [ad.Zero(jax.typeof(result).to_tangent_aval()) for result in results]
    return results, [next(changes) if here else zero for here, zero in zip(moves, none, strict=True)]


def _no_transpose(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(_TWICE)


def _batch(axis: Any, leaves: Any, axes: Any, *, jaxpr: Any) -> tuple[Any, Any]:
    """The batching rule: unbatched results stay unbatched, on which `jax.jacfwd` relies."""
    asked = [batching.zero_if_mapped] * len(jaxpr.out_avals)
    many, differs = batching.batch_jaxpr_axes(jaxpr, axis, axes, asked)
    results = _opaque_p.bind(*match_mesh_axes(leaves), jaxpr=many)
    return results, [0 if each else None for each in differs]


_opaque_p = Primitive("opaque")
_opaque_p.multiple_results = True
_opaque_p.is_high = lambda *_, **__: False  # JAX lowers the inner operations at compilation
_opaque_p.def_impl(lambda *leaves, jaxpr: jax.jit(partial(_value, jaxpr=jaxpr))(*leaves))
_opaque_p.def_abstract_eval(_result_types)
mlir.register_lowering(_opaque_p, lower_without_axes(_value))
ad.primitive_jvps[_opaque_p] = _jvp
ad.primitive_transposes[_opaque_p] = _no_transpose
primitive_linearizations[_opaque_p] = _linearize
batching.fancy_primitive_batchers[_opaque_p] = _batch


# A function of a load and of elements as an operation of JAX, with derivatives written by hand.

Pair = tuple[jax.Array, jax.Array]


class TwiceDifferentiable:
    """Called with a load and elements, gives nodal values (3, place) and numbers of the shape of the pressure.

    The load's first leaves are its positions, its thickness and its pressure.

    Leaves of both are flat arguments of the operations; how many of them are the load's, and which of these have a
    tangent (`present`), or a second one (`bent`), is static.
    """

    def __init__(
        self,
        name: str,
        value: Callable[[Any, Any], Pair],
        tangent: Callable[[Any, Any, Any], Pair],
        cotangent: Callable[[Any, Any, list[bool], Any, Any], list[jax.Array | None]],
    ) -> None:
        """Makes the operations.

        Args:
            name: Name of the operation.
            value: The function.
            tangent: Takes also the load's changes, None where there is none.
            cotangent: Its transpose: takes which of the load's leaves are wanted, and the results' cotangents, None for
                zero; gives those of the leaves, None where not wanted or zero.
        """
        self._value, self._tangent, self._cotangent = value, tangent, cotangent
        self._value_p = _primitive(name, self._value_flat)
        self._tangent_p = _primitive(f"{name}_tangent", self._tangent_flat)
        self._second_p = _primitive(f"{name}_second_tangent", self._second_flat)
        ad.primitive_jvps[self._value_p] = self._value_jvp
        ad.primitive_jvps[self._tangent_p] = self._tangent_jvp
        ad.primitive_jvps[self._second_p] = self._second_jvp
        ad.primitive_transposes[self._tangent_p] = self._tangent_transpose
        ad.primitive_transposes[self._second_p] = self._second_transpose

    def __call__(self, load: Any, elements: Any) -> Pair:
        """The function's results."""
        leaves, structure = jax.tree.flatten((load, elements))
        smooth = len(jax.tree.leaves(load))
        nodal, number = self._value_p.bind(*leaves, structure=structure, smooth=smooth)
        return nodal, number

    @with_standard_promotion
    def _value_flat(self, *leaves: Any, structure: Any, smooth: int) -> Pair:
        return self._value(*jax.tree.unflatten(structure, leaves))

    @with_standard_promotion
    def _tangent_flat(self, *leaves: Any, structure: Any, smooth: int, present: tuple[bool, ...]) -> Pair:
        (load, elements), given = _split(leaves, structure)
        return self._tangent(load, elements, _fill_missing(load, present, given))

    @with_standard_promotion
    def _second_flat(
        self, *leaves: Any, structure: Any, smooth: int, present: tuple[bool, ...], bent: tuple[bool, ...]
    ) -> Pair:
        """Change of the tangent with the load, along the second of two directions."""
        (load, elements), given = _split(leaves, structure)
        first, second = given[: sum(present)], given[sum(present) :]
        changes = _fill_missing(load, present, first)

        def evaluate(*new: Any) -> Pair:
            return self._tangent(_replace_leaves(load, bent, new), elements, changes)

        return jax.jvp(evaluate, tuple(_select(jax.tree.leaves(load), bent)), tuple(second))[1]

    def _value_jvp(self, primals: Any, tangents: Any, *, structure: Any, smooth: int) -> tuple[Any, Any]:
        value = self._value_p.bind(*primals, structure=structure, smooth=smooth)
        given, present = _present_tangents(tangents[:smooth])
        _refuse_mesh(tangents, structure, smooth)
        change = self._tangent_p.bind(*primals, *given, structure=structure, smooth=smooth, present=present)
        return value, change

    def _tangent_jvp(self, primals: Any, tangents: Any, **static: Any) -> tuple[Any, Any]:
        structure, smooth, present = static["structure"], static["smooth"], static["present"]
        value = self._tangent_p.bind(*primals, **static)
        _refuse_mesh(tangents, structure, smooth)
        terms = []
        given, bent = _present_tangents(tangents[:smooth])
        if given:
            terms.append(self._second_p.bind(*primals, *given, **static, bent=bent))
        given, here = _present_tangents(tangents[structure.num_leaves :])
        if given:
            new = iter(here)
            both = tuple(next(new) if is_present else False for is_present in present)
            arguments = primals[: structure.num_leaves]
            terms.append(self._tangent_p.bind(*arguments, *given, structure=structure, smooth=smooth, present=both))
        return value, terms[0] if len(terms) == 1 else [ad.add_jaxvals(*each) for each in zip(*terms, strict=True)]

    @with_standard_promotion
    def _second_jvp(self, primals: Any, tangents: Any, **static: Any) -> tuple[Any, Any]:
        given, moving = _present_tangents(tangents)

        def evaluate(*new: Any) -> Pair:
            return self._second_flat(*_merge(moving, new, primals), **static)

        return jax.jvp(evaluate, tuple(_select(primals, moving)), tuple(given))

    @with_standard_promotion
    def _tangent_transpose(
        self, cotangents: Any, *leaves: Any, structure: Any, smooth: int, present: tuple[bool, ...]
    ) -> list[Any]:
        (load, elements), given = _split(leaves, structure)
        unknown = iter(map(ad.is_undefined_primal, given))
        wanted = [here and next(unknown) for here in present]

        def pull(load: Any, elements: Any, results: Any) -> list[Any]:
            return self._cotangent(load, elements, wanted, *results)

        found = call_opaque(pull, load, elements, _nonzero_cotangents(cotangents))
        return [None] * structure.num_leaves + _select(found, present)

    @with_standard_promotion
    def _second_transpose(
        self, cotangents: Any, *leaves: Any, structure: Any, smooth: int, present: tuple[bool, ...], bent: Any
    ) -> list[Any]:
        (load, elements), given = _split(leaves, structure)
        first, unknown = given[: sum(present)], iter(map(ad.is_undefined_primal, given[sum(present) :]))
        wanted = [here and next(unknown) for here in bent]

        def pull(load: Any, elements: Any, results: Any, first: Any) -> list[Any]:
            def evaluate(*new: Any) -> list[Any]:
                return self._cotangent(_replace_leaves(load, present, new), elements, wanted, *results)

            return jax.jvp(evaluate, tuple(_select(jax.tree.leaves(load), present)), tuple(first))[1]

        found = call_opaque(pull, load, elements, _nonzero_cotangents(cotangents), first)
        return [None] * (structure.num_leaves + len(first)) + _select(found, bent)


def _split(leaves: Sequence[Any], structure: Any) -> tuple[Any, list[Any]]:
    """The load with the elements, and the changes that come after them."""
    count = structure.num_leaves
    return jax.tree.unflatten(structure, leaves[:count]), list(leaves[count:])


def _select(values: Sequence[Any], here: Sequence[bool]) -> list[Any]:
    return [value for value, is_here in zip(values, here, strict=True) if is_here]


def _merge(here: Sequence[bool], new: Sequence[Any], old: Sequence[Any]) -> list[Any]:
    given = iter(new)
    return [next(given) if is_here else value for is_here, value in zip(here, old, strict=True)]


def _replace_leaves(load: Any, here: Sequence[bool], new: Sequence[Any]) -> Any:
    leaves, structure = jax.tree.flatten(load)
    return jax.tree.unflatten(structure, _merge(here, new, leaves))


def _fill_missing(load: Any, present: Sequence[bool], given: Sequence[Any]) -> Any:
    """Changes as a tree like the load, None where there is none."""
    return jax.tree.unflatten(jax.tree.structure(load), _merge(present, given, [None] * len(present)))


def _present_tangents(tangents: Sequence[Any]) -> tuple[list[Any], tuple[bool, ...]]:
    present = tuple(not isinstance(tangent, ad.Zero) for tangent in tangents)
    return _select(tangents, present), present


def _nonzero_cotangents(cotangents: Any) -> list[Any]:
    return [None if isinstance(cotangent, ad.Zero) else cotangent for cotangent in cotangents]


def _refuse_mesh(tangents: Sequence[Any], structure: Any, smooth: int) -> None:
    if _present_tangents(tangents[smooth : structure.num_leaves])[0]:
        raise TypeError("the force has no derivative with respect to the initial mesh")


def _batch_twice(function: Callable[..., Any], leaves: Any, axes: Any, **static: Any) -> tuple[Any, Any]:
    return jax.vmap(partial(function, **static), axes)(*leaves), (0, 0)


def _primitive(name: str, function: Callable[..., Any]) -> Primitive:
    """A primitive with two results that does what the function does, under jit and vmap."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *leaves, **static: jax.jit(partial(function, **static))(*leaves))
    primitive.def_abstract_eval(lambda positions, _, pressure, *__, **___: _twice_result_types(positions, pressure))
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=True))
    batching.primitive_batchers[primitive] = partial(_batch_twice, function)
    return primitive


def _twice_result_types(positions: Any, pressure: Any) -> list[Any]:
    """The types of both results, known without tracing the function."""
    return [ShapedArray(positions.shape, positions.dtype), ShapedArray(pressure.shape, positions.dtype)]
