"""Functions with a hand-written reverse derivative; their forward derivative is JAX's.

A `custom_vjp` would shut out forward mode, which least-squares columns need. The rule of a primitive is asked for
both: where JAX looks for what is linear in unknown tangents, a reverse derivative is on its way, or `jax.linearize`
wants a linear function that it can also call, map and transpose.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

# Private, since no public rule distinguishes `jax.linearize` from `jax.vjp`.
from jax._src.interpreters.ad import fallback_linearize_rule, primitive_linearizations
from jax.ad_checkpoint import checkpoint_name
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

from jaxform.core.compilation import with_standard_promotion
from jaxform.core.pytree import pytree, static
from jaxform.kernels.opaque_primitive import call_opaque, lower_without_axes, manual_axes, match_mesh_axes, type_like


class Cotangents:
    """Collects the cotangents of the arguments that a reverse derivative asks for.

    Attributes:
        of: The arguments' tree, whose leaves are their numbers.
        wanted: True for leaves whose cotangent is asked for.
        found: Cotangents of the leaves; None stands for zero.
    """

    def __init__(self, structure: Any, wanted: tuple[bool, ...]) -> None:
        """Creates an empty collection for arguments of this tree structure."""
        self.of = jax.tree.unflatten(structure, range(structure.num_leaves))
        self.wanted = wanted
        self.found: list[jax.Array | None] = [None] * len(wanted)

    def want(self, part: Any) -> bool:
        """True where any leaf of a part of `of` is wanted."""
        return any(self.wanted[k] for k in jax.tree.leaves(part))

    def put(self, part: Any, values: Any) -> None:
        """Stores the cotangents of a part of `of`, given as a tree like it; those not wanted are ignored."""
        for k, value in zip(jax.tree.leaves(part), jax.tree.leaves(values), strict=True):
            if self.wanted[k]:
                self.found[k] = value


class DerivativeRule(NamedTuple):
    """A function with a hand-written reverse derivative; calling the rule calls the function.

    Attributes:
        value: Function of a mask of the differentiated leaves, and the arguments; returns the result and the residuals.
            Its forward derivative must be right as well: second derivatives use it.
        plain: Function of the arguments; returns the result alone, by operations that JAX can differentiate.
        pull: Function of the residuals, the `Cotangents` to be filled, and the cotangents of the result: its tree, with
            None for leaves without a derivative.
        like: Function of the arguments' shapes; returns the shapes of the result.
        smooth: Function of the result's tree; returns a mask of the leaves with a derivative.
        lasting: True for rules that exist as long as the process, whose traces are cached.
    """

    value: Callable[..., tuple[Any, Any]]
    plain: Callable[..., Any]
    pull: Callable[[Any, Cotangents, Any], None]
    like: Callable[..., Any]
    smooth: Callable[[Any], Any]
    lasting: bool = False

    def __call__(self, *arguments: Any) -> Any:
        """The function's result."""
        leaves, structure = jax.tree.flatten(arguments)
        results = _reversed_p.bind(*match_mesh_axes(leaves), rule=self, structure=structure)
        return jax.tree.unflatten(jax.tree.structure(self.like(*_shapes(arguments))), results)


def recompute(function: Callable[..., Any], like: Callable[..., Any], smooth: Callable[[Any], Any]) -> DerivativeRule:
    """A rule that stores only the arguments, like `jax.checkpoint`, which has no effect on a `DerivativeRule`."""

    def value(_: tuple[bool, ...], *arguments: Any) -> tuple[Any, Any]:
        return function(*arguments), arguments

    def pull(arguments: Any, cotangents: Cotangents, end: Any) -> None:
        leaves, structure = jax.tree.flatten(arguments)

        def evaluate(*new: Any) -> list[Any]:
            result = function(*jax.tree.unflatten(structure, merge(cotangents.wanted, new, leaves)))
            return _smooth_leaves(result, smooth)[0]

        wanted = [leaf for leaf, here in zip(leaves, cotangents.wanted, strict=True) if here]
        cotangents.found = merge(cotangents.wanted, jax.vjp(evaluate, *wanted)[1](jax.tree.leaves(end)))

    return DerivativeRule(value, jax.checkpoint(function), pull, like, smooth)


@pytree
class _Pullback:
    """The pullback that JAX keeps for the reverse derivative, and a mask of its leaves."""

    apply: Any
    moving: tuple[bool, ...] = static()


def as_single_operation(function: Callable[..., Any], *arguments: Any) -> Any:
    """The function's result as one operation, with JAX's own derivatives; nothing is computed again."""
    shapes = _shapes(arguments)
    results = jax.eval_shape(function, *shapes)

    def smooth(result: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.issubdtype(leaf.dtype, jnp.floating), result)

    def value(moving: tuple[bool, ...], *arguments: Any) -> tuple[Any, Any]:
        if not any(moving):
            return function(*arguments), None
        leaves, structure = jax.tree.flatten(arguments)

        def evaluate(*new: Any) -> tuple[list[Any], Any]:
            result = function(*jax.tree.unflatten(structure, merge(moving, new, leaves)))
            return _smooth_leaves(result, smooth)[0], result

        _, apply, result = jax.vjp(evaluate, *select(leaves, moving), has_aux=True)
        return result, _Pullback(apply, moving)

    def pull(kept: _Pullback, cotangents: Cotangents, end: Any) -> None:
        cotangents.found = merge(kept.moving, kept.apply(jax.tree.leaves(end)))

    return DerivativeRule(value, function, pull, lambda *_: results, smooth)(*arguments)


def select(values: Iterable[Any], here: Sequence[bool]) -> list[Any]:
    """The values at the places where `here` is true."""
    return [value for value, is_here in zip(values, here, strict=True) if is_here]


def merge(here: Sequence[bool], some: Iterable[Any], others: Iterable[Any] = itertools.repeat(None)) -> list[Any]:
    """A list with the next of `some` where `here` is true, and the entry of `others` at that place elsewhere."""
    new = iter(some)
    return [next(new) if is_here else other for is_here, other in zip(here, others, strict=False)]


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: ShapedArray(leaf.shape, leaf.dtype), tree)


def _smooth_leaves(result: Any, smooth: Callable[[Any], Any]) -> tuple[list[Any], tuple[bool, ...]]:
    """The leaves with a derivative, and the mask of these."""
    flags = tuple(jax.tree.leaves(smooth(result)))
    return [leaf for leaf, here in zip(jax.tree.leaves(result), flags, strict=True) if here], flags


@with_standard_promotion
def _value(*leaves: Any, rule: DerivativeRule, structure: Any) -> list[Any]:
    still = (False,) * len(leaves)
    return jax.tree.leaves(rule.value(still, *jax.tree.unflatten(structure, leaves))[0])


def _like(*leaves: Any, rule: DerivativeRule, structure: Any) -> list[Any]:
    results = jax.tree.leaves(rule.like(*jax.tree.unflatten(structure, _shapes(list(leaves)))))
    return [type_like(result.shape, result.dtype, leaves[0]) for result in results]


def _linearize(is_vjp: bool, moving: Sequence[bool], *primals: Any, **static: Any) -> Any:
    """The rule for linear functions of tangents: one that is only transposed need not keep the arguments."""
    return fallback_linearize_rule(_reversed_p, is_vjp, moving, *primals, **static, forward=not is_vjp)


@with_standard_promotion
def _jvp(
    primals: Any, tangents: Any, *, rule: DerivativeRule, structure: Any, forward: bool = False
) -> tuple[Any, Any]:
    moving = tuple(not isinstance(t, ad.Zero) for t in tangents)
    given = select(tangents, moving)
    if any(isinstance(t, pe.JaxprTracer) for t in given):
        name = (rule, moving) if rule.lasting else None
        result, kept = call_opaque(partial(rule.value, moving), *jax.tree.unflatten(structure, primals), name=name)
        carried, smooth = _smooth_leaves(result, rule.smooth)
        leaves, kept_structure = jax.tree.flatten(kept)
        changes = _change_p.bind(
            *match_mesh_axes([*leaves, *(primals if forward else []), *given]),
            rule=rule,
            forward=forward,
            structure=structure,
            moving=moving,
            kept=kept_structure,
            like=jax.tree.structure(result),
            smooth=smooth,
            shapes=tuple((leaf.shape, leaf.dtype) for leaf in carried),
        )
    else:
        result, changes = _forward(rule, structure, moving, primals, given)
        smooth = _smooth_leaves(result, rule.smooth)[1]
    results = jax.tree.leaves(result)
    none = [ad.Zero(jax.typeof(value).to_tangent_aval()) for value in results]
    return results, merge(smooth, changes, none)


def _forward(
    rule: DerivativeRule, structure: Any, moving: tuple[bool, ...], primals: Any, given: Any
) -> tuple[Any, list[Any]]:
    """The result, and the tangents of its leaves that carry one; reverse derivatives of these are JAX's own."""

    def value_and_tangents(primals: Any, given: Any) -> tuple[Any, list[Any]]:
        def plain(*moved: Any) -> tuple[list[Any], Any]:
            result = rule.plain(*jax.tree.unflatten(structure, merge(moving, moved, primals)))
            return _smooth_leaves(result, rule.smooth)[0], result

        _, changes, result = jax.jvp(plain, select(primals, moving), given, has_aux=True)
        return result, changes

    if not manual_axes(primals):
        return value_and_tangents(primals, given)

    def like(primals: Any, _: Any) -> list[Any]:
        return _smooth_leaves(rule.like(*jax.tree.unflatten(structure, primals)), rule.smooth)[0]

    # Apart from the result, which must not depend on the tangents, or `jacfwd` would give one for each of them.
    changes = recompute(lambda *given: value_and_tangents(*given)[1], like, lambda changes: [True] * len(changes))
    return rule(*jax.tree.unflatten(structure, primals)), changes(list(primals), given)


@with_standard_promotion
def _transpose(
    cotangents: Any,
    *leaves: Any,
    rule: DerivativeRule,
    forward: bool,
    structure: Any,
    moving: tuple[bool, ...],
    kept: Any,
    like: Any,
    smooth: tuple[bool, ...],
    shapes: Any,
) -> list[Any]:
    count = kept.num_leaves
    given = leaves[count + structure.num_leaves * forward :]
    end = jax.tree.unflatten(like, merge(smooth, map(ad.instantiate_zeros, cotangents)))
    change = map(ad.is_undefined_primal, given)
    wanted = tuple(merge(moving, change, itertools.repeat(False)))

    def pull(kept: Any, end: Any) -> list[Any]:
        collected = Cotangents(structure, wanted)
        rule.pull(kept, collected, end)
        return collected.found

    name = (rule, structure, wanted) if rule.lasting else None
    found = call_opaque(pull, jax.tree.unflatten(kept, leaves[:count]), end, name=name)
    return [None] * (len(leaves) - len(given)) + select(found, moving)


@with_standard_promotion
def _batch(leaves: Any, axes: Any, *, rule: DerivativeRule, structure: Any) -> tuple[Any, Any]:
    """The batching rule: one function of many arguments side by side, with its derivative."""
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)

    def vectorize(function: Callable[..., Any]) -> Callable[..., Any]:
        together = jax.vmap(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), axes)
        return lambda *arguments: together(*jax.tree.leaves(arguments))

    def value(moving: tuple[bool, ...], *arguments: Any) -> tuple[Any, Any]:
        return vectorize(partial(rule.value, moving))(*arguments)

    def pull(kept: Any, cotangents: Cotangents, end: Any) -> None:
        def one(kept: Any, end: Any) -> list[Any]:
            collected = Cotangents(structure, cotangents.wanted)
            rule.pull(kept, collected, end)
            return collected.found

        for k, each in enumerate(jax.vmap(one)(kept, end)):
            if each is not None:
                cotangents.found[k] = jnp.sum(each, 0) if axes[k] is None else jnp.moveaxis(each, 0, axes[k])

    def like(*arguments: Any) -> Any:
        shapes = [
            ShapedArray(leaf.shape if axis is None else (*leaf.shape[:axis], *leaf.shape[axis + 1 :]), leaf.dtype)
            for leaf, axis in zip(jax.tree.leaves(arguments), axes, strict=True)
        ]
        one = rule.like(*jax.tree.unflatten(structure, shapes))
        return jax.tree.map(lambda leaf: ShapedArray((size, *leaf.shape), leaf.dtype), one)

    many = DerivativeRule(value, vectorize(rule.plain), pull, like, rule.smooth)
    results = _reversed_p.bind(*match_mesh_axes(leaves), rule=many, structure=structure)
    return results, (0,) * len(results)


@with_standard_promotion
def _tangents(
    *leaves: Any, rule: DerivativeRule, forward: bool, structure: Any, moving: tuple[bool, ...], kept: Any, **_: Any
) -> list[Any]:
    """The results' tangents, from those of the arguments: the function is recomputed for it."""
    if not forward:
        raise NotImplementedError(
            "the residuals of jax.vjp of a simulation can only be transposed: use jax.jvp instead"
        )
    first = kept.num_leaves
    primals, given = leaves[first : first + structure.num_leaves], leaves[first + structure.num_leaves :]
    return _forward(rule, structure, moving, primals, list(given))[1]


@with_standard_promotion
def _batch_tangents(leaves: Any, axes: Any, **static: Any) -> tuple[Any, Any]:
    return jax.vmap(partial(_tangents, **static), axes)(*leaves), (0,) * len(static["shapes"])


@with_standard_promotion
def _tangents_jvp(primals: Any, tangents: Any, **static: Any) -> tuple[Any, Any]:
    """The JVP of the tangents, by the arguments and their tangents; the residuals follow from these."""
    first = static["kept"].num_leaves
    moving = [k >= first and not isinstance(t, ad.Zero) for k, t in enumerate(tangents)]

    def evaluate(*new: Any) -> list[Any]:
        return _tangents(*merge(moving, new, primals), **static)

    if not any(moving):
        changes = _change_p.bind(*primals, **static)
        return changes, [ad.Zero(jax.typeof(change).to_tangent_aval()) for change in changes]
    return jax.jvp(evaluate, select(primals, moving), select(tangents, moving))


_reversed_p = Primitive("with_own_reverse")
_reversed_p.multiple_results = True
_reversed_p.def_impl(lambda *leaves, **static: jax.jit(partial(_value, **static))(*leaves))
_reversed_p.def_abstract_eval(_like)
mlir.register_lowering(_reversed_p, lower_without_axes(_value))
ad.primitive_jvps[_reversed_p] = _jvp
primitive_linearizations[_reversed_p] = _linearize
batching.primitive_batchers[_reversed_p] = _batch

_change_p = Primitive("with_own_reverse_change")
_change_p.multiple_results = True
_change_p.def_impl(lambda *leaves, **static: jax.jit(partial(_tangents, **static))(*leaves))
_change_p.def_abstract_eval(lambda first, *_, shapes, **__: [type_like(shape, dtype, first) for shape, dtype in shapes])
ad.primitive_transposes[_change_p] = _transpose
ad.primitive_jvps[_change_p] = _tangents_jvp
batching.primitive_batchers[_change_p] = _batch_tangents
mlir.register_lowering(_change_p, lower_without_axes(_tangents))


# Checkpoint policy for recomputed parts of a run: decisions and search results are saved.
#
# Decisions and searches carry no derivative, but the part cannot be recomputed without them, and they take longer than
# the rest. They are few numbers compared with the state.

_NAME = "decided"


def save_decision[T](found: T) -> T:
    """The decision (a tree of arrays), unchanged, marked so that `checkpoint` stores it."""
    return jax.tree.map(lambda values: checkpoint_name(values, _NAME), found)


def checkpoint[**P, R](work: Callable[P, R]) -> Callable[P, R]:
    """The function; its reverse derivative stores arguments and decisions (`save_decision`) and recomputes the rest."""
    return jax.checkpoint(work, policy=jax.checkpoint_policies.save_only_these_names(_NAME))
