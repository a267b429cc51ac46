"""A branch with a reverse derivative that is left out as the branch is, also where several runs go side by side.

Side by side, JAX's `cond` computes both branches for each run. A loop that is entered at most once is left out as soon
as no run asks for it, but has no reverse derivative of JAX's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun
from jax.interpreters import partial_eval as pe

from jaxform.core.pytree import pytree, static
from jaxform.kernels.blocks import lax_cond_once
from jaxform.kernels.derivatives import Cotangents, DerivativeRule, merge, select

Leaves = Sequence[jax.Array]


@pytree
class _BranchResiduals:
    """Residuals for the reverse derivative of a branch.

    Attributes:
        asked: True if the branch was taken.
        given: Its arguments: closed-over values, then the value.
        residual_index: Residuals that the branch has computed.
        place: Index of each leaf of its derivative in `given`, or beyond that in `residual_index`.
        structure: Tree structure of its derivative, a function.
        moving: True for the differentiated ones of `given`.
    """

    asked: jax.Array
    given: list[jax.Array]
    residual_index: list[jax.Array]
    place: tuple[int, ...] = static()
    structure: Any = static()
    moving: tuple[bool, ...] = static()


def branch[T](asked: jax.Array, work: Callable[[T], T], value: T, smooth: Callable[[T], Any] | None = None) -> T:
    """The value transformed by `work` where `asked` is true, else unchanged; differentiable.

    Args:
        asked: True if the branch is taken.
        work: It gives a value of the same structure and shapes, and may close over traced values.
        value: A tree of arrays.
        smooth: Tree of flags, true for leaves of the value that carry a derivative; by default all real numbers do.
    """
    leaves, structure = jax.tree.flatten(value)
    made = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(work(jax.tree.unflatten(structure, leaves))))(*leaves)
    function = jaxpr_as_fun(pe.convert_constvars_jaxpr(made.jaxpr))
    flags = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
    flags = flags if smooth is None else jax.tree.leaves(smooth(value))
    rule = DerivativeRule(
        value=partial(_value, function, flags),
        plain=partial(_result, function, differentiable=True),
        pull=partial(_pull, flags),
        like=lambda _, __, leaves: leaves,
        smooth=lambda _: flags,
    )
    return jax.tree.unflatten(structure, rule(asked, made.consts, leaves))


def _result(
    function: Callable[..., Leaves], asked: jax.Array, constants: Leaves, leaves: Leaves, *, differentiable: bool
) -> list[jax.Array]:
    take = lambda leaves: list(function(*constants, *leaves))  # noqa: E731
    return lax_cond_once(asked, take, list(leaves), differentiable=differentiable)


def _value(
    function: Callable[..., Leaves],
    smooth: Sequence[bool],
    moving: tuple[bool, ...],
    asked: jax.Array,
    constants: Leaves,
    leaves: Leaves,
) -> tuple[Leaves, _BranchResiduals | None]:
    here, given = moving[1:], [*constants, *leaves]
    if not any(here):
        return _result(function, asked, constants, leaves, differentiable=False), None
    structures = []

    def with_residuals(*given: jax.Array) -> list[jax.Array]:
        def evaluate(*new: jax.Array) -> tuple[list[jax.Array], Leaves]:
            results = function(*merge(here, new, given))
            return select(results, smooth), results

        _, back, results = jax.vjp(evaluate, *select(given, here), has_aux=True)
        kept, structure = jax.tree.flatten(back)
        structures.append(structure)
        return [*results, *kept]

    made, shapes = jax.make_jaxpr(with_residuals, return_shape=True)(*given)
    variables, place = list(map(id, made.jaxpr.invars)), []
    residual_indices = []
    for k, variable in enumerate(made.jaxpr.outvars[len(leaves) :], len(leaves)):
        if id(variable) not in variables:
            variables.append(id(variable))
            residual_indices.append(k)
        place.append(variables.index(id(variable)))

    def take(now: tuple[list[jax.Array], list[jax.Array]]) -> tuple[list[jax.Array], list[jax.Array]]:
        results = jaxpr_as_fun(made)(*constants, *now[0])
        return results[: len(leaves)], [results[k] for k in residual_indices]

    none = [jnp.zeros(shapes[k].shape, shapes[k].dtype) for k in residual_indices]
    results, kept = lax_cond_once(asked, take, (list(leaves), none))
    return results, _BranchResiduals(asked, given, kept, tuple(place), structures[-1], here)


def _pull(
    smooth: Sequence[bool], kept: _BranchResiduals, cotangents: Cotangents, end: Sequence[jax.Array | None]
) -> None:
    values = [*kept.given, *kept.residual_index]
    back = jax.tree.unflatten(kept.structure, [values[where] for where in kept.place])
    wanted = cotangents.wanted[1:]
    results = select(end, smooth)
    through = select([*[None] * (len(kept.given) - len(end)), *end], wanted)
    pairs = zip(select(kept.given, wanted), through, strict=True)
    through = [jnp.zeros_like(value) if new is None else new for value, new in pairs]
    found = lax_cond_once(kept.asked, lambda _: select(merge(kept.moving, back(results)), wanted), through)
    cotangents.found = [None, *merge(wanted, found)]
