"""Work through long arrays in short blocks, and only as far as they are in use.

On the CPU a block and all that is computed from it stay in the innermost cache, and XLA compiles a loop without
scatters into one function; the number of blocks is data, so that a list that becomes shorter costs less and nothing
is recompiled. On other devices one kernel over the whole arrays is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

BLOCK = 96  # three of the longest vectors, four times; no power of two: rows that far apart share the cache's sets


class Halves(NamedTuple):
    """A row (n,) of which what is in the blocks' first halves, and in their second, is computed apart, (n / 2,)."""

    first: jax.Array
    second: jax.Array

    def concatenate(self) -> jax.Array:
        """The row."""
        half = BLOCK // 2
        if self.first.size == half:
            return jnp.concatenate(self)
        return jnp.stack([part.reshape(-1, half) for part in self], axis=1).reshape(-1)


Rows = Sequence[jax.Array | Halves]


def padded_length(count: int) -> int:
    """The least whole number of blocks' length that is greater than `count`: one entry at least is left over."""
    return (count // BLOCK + 1) * BLOCK


def split_halves(values: jax.Array) -> Halves:
    """The values (n,), whole blocks, of the blocks' first halves and of their second halves."""
    half = BLOCK // 2
    if values.size == BLOCK:
        return Halves(values[:half], values[half:])
    first, second = jnp.moveaxis(values.reshape(-1, 2, half), 1, 0)
    return Halves(first.reshape(-1), second.reshape(-1))


class ArraySlice(NamedTuple):
    """A slice (k, size) from `begin` on of an array (k, several slices), read or written in place."""

    array: jax.Array
    begin: jax.Array | int
    size: int


class PerBlock(NamedTuple):
    """A number for each block (n_block,), which a function gets; of all of them at once it gets the largest."""

    array: jax.Array


def over_blocks(
    function: Callable[..., tuple[Sequence[Rows], Sequence[jax.Array]]],
    block_count: jax.Array,
    inputs: Any,
    into: Sequence[jax.Array | ArraySlice],
    *,
    sums: int = 0,
    most: int = 0,
    update: int = 0,
    kept: bool = True,
    whole: bool = False,
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Applies a function to the blocks in use, along the last axis.

    Args:
        function: Takes the inputs' blocks; gives for every array of `into` its rows (n,), and vectors (n,) to be
            summed over all, then those of which the largest is to be found, but 0 at least. It must treat every
            column by itself, and columns that are not in use harmlessly: where there are no blocks it is given them
            all.
        block_count: Number of blocks in use.
        inputs: Arrays (..., capacity), the capacity a whole number of blocks; or a `Part` of one, or what is
            `PerBlock`.
        into: Arrays (k, capacity), or a `Part` of one, that take the rows; what is beyond the blocks in use stays as it
            is.
        sums: Number of vectors that are summed; of the inputs' floating type.
        most: Number of vectors whose largest value is found.
        update: Number of arrays of `into`, the first ones and no `Part`s, whose rows the function takes as they were: a
            list of them is its first argument.
        kept: True if these rows are copied before the function uses them. Without it the function must see to it that
            whatever it reads of an array goes into what it writes there; else XLA copies the array for every block.
        whole: True if the function gets all columns at once, as it does on other devices: for derivatives.

    Returns:
        The arrays with the rows; the sums and, after them, the largest.
    """
    if whole or not on_cpu():
        rows, terms = function(*([list(into[:update])] if update else []), *_read_whole(inputs))
        new = [jnp.stack([row.concatenate() if isinstance(row, Halves) else row for row in each]) for each in rows]
        found = [jnp.sum(term) for term in terms[:sums]] + [jnp.max(term, initial=0.0) for term in terms[sums:]]
        return [_write_back(old, row) for old, row in zip(into, new, strict=True)], found

    def apply(flat: Sequence[jax.Array], i: jax.Array) -> tuple[Sequence[Rows], Sequence[jax.Array]]:
        if not update:
            return function(*_read_block(inputs, i))
        updated = zip(flat, arrays[:update], strict=False)
        old = [read_rows(each, len(array), i * BLOCK, BLOCK) for each, array in updated]
        # All is read before anything is written (docs/explanation/kernels.md).
        return function(jax.lax.optimization_barrier(old) if kept else old, *_read_block(inputs, i))

    def compute_block(
        i: jax.Array, carry: tuple[list[jax.Array], list[jax.Array]]
    ) -> tuple[list[jax.Array], list[jax.Array]]:
        flat, totals = carry
        rows, terms = apply(flat, i)
        flat = [_write_rows(*each, begin + i * BLOCK) for *each, begin in zip(flat, rows, begins, strict=True)]
        terms = [term.astype(real) for term in terms]
        added = [total + term for total, term in zip(totals[:sums], terms, strict=False)]
        return flat, added + [jnp.maximum(last, term) for last, term in zip(totals[sums:], terms[sums:], strict=True)]

    begins = [part.begin if isinstance(part, ArraySlice) else 0 for part in into]
    arrays = [part.array if isinstance(part, ArraySlice) else part for part in into]
    flat = [array.reshape(-1) for array in arrays]
    kinds = map(jnp.result_type, jax.tree.leaves((inputs, arrays)))
    real = next((kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)), jnp.float32)
    zeros = [jnp.zeros(BLOCK, real) for _ in range(sums + most)]
    flat, totals = jax.lax.fori_loop(0, block_count, compute_block, (flat, zeros))
    # Else the whole loop would be computed again for each use.
    flat, totals = jax.lax.optimization_barrier((flat, totals))
    shaped = [array.reshape(old.shape) for array, old in zip(flat, arrays, strict=True)]
    return shaped, [jnp.sum(each) for each in totals[:sums]] + [jnp.max(each) for each in totals[sums:]]


def read_rows(flat: jax.Array, count: int, first: jax.Array, size: int) -> list[jax.Array]:
    """Entries (size,) from `first` on of each of the `count` rows that lie one after the other in `flat`."""
    capacity = flat.size // count
    return [slice_at(flat, k * capacity + first, size) for k in range(count)]


def slice_at(array: jax.Array, begin: jax.Array | int, size: int) -> jax.Array:
    """Entries (..., size) of an array (..., n) from `begin` on, which is not checked for a negative sign."""
    return jax.lax.dynamic_slice_in_dim(array, begin, size, axis=array.ndim - 1, allow_negative_indices=False)


def put(array: jax.Array, new: jax.Array, begin: jax.Array | int) -> jax.Array:
    """The array (..., n) with new entries (..., size) from `begin` on, which is not checked for a negative sign."""
    return jax.lax.dynamic_update_slice_in_dim(array, new, begin, axis=array.ndim - 1, allow_negative_indices=False)


def entry(array: jax.Array, place: jax.Array) -> jax.Array:
    """The entry (...) of an array (..., n) at a place, which is not checked for a negative sign."""
    return jax.lax.dynamic_index_in_dim(array, place, array.ndim - 1, keepdims=False, allow_negative_indices=False)


def lax_cond_once[T](asked: jax.Array, work: Callable[[T], T], value: T, *, differentiable: bool = False) -> T:
    """The value transformed by `work` where `asked` is true, else the value unchanged.

    A loop that is entered at most once: other than a branch it copies nothing, but has no reverse derivative.
    """
    if differentiable:
        return jax.lax.cond(asked, work, lambda value: value, value)
    again = lambda carry: (jnp.asarray(False), work(carry[1]))  # noqa: E731
    return jax.lax.while_loop(lambda carry: carry[0], again, (asked, value))[1]


def compile_as_one[T](work: Callable[[T], T], value: T, count: jax.Array) -> T:
    """The value transformed by `work`, compiled into one function; not differentiable.

    XLA's CPU compiler does so with a loop that holds neither scatters nor sorts nor calls. Else each of a hundred small
    operations is started by itself, which takes longer than most of them do.

    Args:
        work: The function, called once.
        value: Its argument.
        count: Any number that is not negative; the compiler must not know that, or it would see through the loop.
    """
    return lax_cond_once(count >= 0, work, value)


def on_cpu() -> bool:
    """True where programs are compiled for the CPU, where loops over blocks are the faster way."""
    return jax.default_backend() == "cpu"


def materialize[T](values: T) -> T:
    """Values that are computed once and kept, for all their uses."""
    return jax.lax.optimization_barrier(values)


def total(values: jax.Array) -> jax.Array:
    """Sum of values (capacity,), whole blocks of them: many short sums side by side, where XLA makes one long one."""
    return jnp.sum(jnp.sum(values.reshape(-1, BLOCK), axis=0))


def _read_whole(inputs: Any) -> Any:
    def read_all(value: Any) -> jax.Array:
        if isinstance(value, PerBlock):
            return jnp.max(value.array)
        return slice_at(*value) if isinstance(value, ArraySlice) else value

    return jax.tree.map(read_all, inputs, is_leaf=_is_special)


def _read_block(inputs: Any, i: jax.Array) -> Any:
    def read_one(value: Any) -> jax.Array:
        if isinstance(value, PerBlock):
            return entry(value.array, i)
        array, begin = (value.array, value.begin) if isinstance(value, ArraySlice) else (value, 0)
        return slice_at(array, begin + i * BLOCK, BLOCK)

    return jax.tree.map(read_one, inputs, is_leaf=_is_special)


def _is_special(value: Any) -> bool:
    return isinstance(value, ArraySlice | PerBlock)


def _write_back(into: jax.Array | ArraySlice, new: jax.Array) -> jax.Array:
    if isinstance(into, ArraySlice):
        return put(into.array, new, into.begin)
    return new


def _write_rows(flat: jax.Array, rows: Rows, first: jax.Array) -> jax.Array:
    """Row by row: stacked first they would be one loop with a branch in it, which is not vectorized."""
    capacity = flat.size // len(rows)
    for k, row in enumerate(rows):
        begin = k * capacity + first
        for part in row if isinstance(row, Halves) else (row,):
            flat = put(flat, part.astype(flat.dtype), begin)
            begin += part.size
    return flat


def compact_indices(keep: jax.Array, capacity: int, count: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Indices (capacity,) of the marked entries (n,), one after the other, then any others; and the number marked.

    Of the first `count` entries, or of all.
    """
    if not on_cpu():
        keep = keep if count is None else keep & (jnp.arange(keep.size) < count)
        running = running_count(keep)
        place = jnp.searchsorted(running, jnp.arange(1, capacity + 1, dtype=jnp.int32))
        return jnp.minimum(place, keep.size - 1).astype(jnp.int32), running[-1]

    def add(i: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # The next entry overwrites one that is not kept.
        places, count = carry
        return put(places, i.astype(jnp.int32)[None], count), count + entry(keep, i)

    # One more, for what exceeds the capacity.
    places, found = _sequential_loop(keep, add, capacity + 1, count)
    return places[:capacity], found


def list_marked(marked: jax.Array, block_count: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Indices (n,) of the few marked entries (n,) of the blocks in use, then any others; and the number marked."""
    index = jnp.arange(BLOCK, dtype=jnp.int32)

    def add_block(i: jax.Array, found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        own = slice_at(marked, i * BLOCK, BLOCK)

        def next_marked(k: jax.Array) -> jax.Array:
            return jnp.min(jnp.where(own & (index > k), index, BLOCK))

        def add(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
            k, places, count = carry
            return next_marked(k), put(places, (i * BLOCK + k).astype(jnp.int32)[None], count), count + 1

        return jax.lax.while_loop(lambda carry: carry[0] < BLOCK, add, (next_marked(jnp.int32(-1)), *found))[1:]

    return jax.lax.fori_loop(0, block_count, add_block, (jnp.zeros(marked.size, jnp.int32), jnp.int32(0)))


def running_count(keep: jax.Array, count: jax.Array | None = None) -> jax.Array:
    """Running count (n,) of the marked entries, each included; arbitrary beyond the first `count`."""
    if not on_cpu():
        return jnp.cumsum(keep, dtype=jnp.int32)

    def add(i: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        counts, found = carry
        found = found + entry(keep, i)
        return put(counts, found[None], i), found

    return _sequential_loop(keep, add, keep.size, count)[0]


def _sequential_loop(
    keep: jax.Array, add: Callable[..., tuple[jax.Array, jax.Array]], capacity: int, count: jax.Array | None
) -> tuple[jax.Array, jax.Array]:
    """A loop over the entries: one short function, where sums in parallel are a dozen that take long to compile."""
    start = jnp.zeros(capacity, jnp.int32), jnp.int32(0)
    return jax.lax.fori_loop(0, keep.size if count is None else count, add, start)


def scatter_min(values: jax.Array, places: jax.Array, new: jax.Array, count: jax.Array) -> jax.Array:
    """Values (n,), the first `count` of these places (k,) lowered to new ones (k,) where these are lower."""
    if not on_cpu():
        used = jnp.arange(places.size) < count
        return values.at[places].min(jnp.where(used, new, jnp.inf))

    def lower(i: jax.Array, values: jax.Array) -> jax.Array:
        # No scatter in a loop (docs/explanation/kernels.md).
        place = entry(places, i)
        least = jnp.minimum(jax.lax.optimization_barrier(entry(values, place)), entry(new, i))
        return put(values, least[None], place)

    return jax.lax.fori_loop(0, count, lower, values)
