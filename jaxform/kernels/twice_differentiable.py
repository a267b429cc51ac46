"""A function of a load and of elements as an operation of JAX, with derivatives written by hand.

The tangent and its transpose are given. What second derivatives need follows from these: the change of the tangent
along one direction is linear in the other, and the transpose of that is the change of the first one's transpose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxform.core.promotion import with_standard_promotion
from jaxform.kernels.opaque_primitive import call_opaque

Pair = tuple[jax.Array, jax.Array]


class TwiceDifferentiable:
    """Called with a load and elements, gives nodal values (3, place) and a number, with their derivatives.

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
            name: Of the operation.
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


def _batch(function: Callable[..., Any], leaves: Any, axes: Any, **static: Any) -> tuple[Any, Any]:
    return jax.vmap(partial(function, **static), axes)(*leaves), (0, 0)


def _primitive(name: str, function: Callable[..., Any]) -> Primitive:
    """A primitive with two results that does what the function does, under jit and vmap."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *leaves, **static: jax.jit(partial(function, **static))(*leaves))
    primitive.def_abstract_eval(lambda positions, *_, **__: _result_types(positions))
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=True))
    batching.primitive_batchers[primitive] = partial(_batch, function)
    return primitive


def _result_types(positions: Any) -> list[Any]:
    """The types of both results, known without tracing the function."""
    return [ShapedArray(positions.shape, positions.dtype), ShapedArray((), positions.dtype)]
