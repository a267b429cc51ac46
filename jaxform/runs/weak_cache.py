"""Cache of values computed from parts of a scene, for as long as these exist; scenes share them with their parts."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np

_made: weakref.WeakKeyDictionary[Any, dict[tuple[Hashable, ...], Any]] = weakref.WeakKeyDictionary()


def cache_by_identity[P, R, *Ts](make: Callable[[P, *Ts], R], part: P, *others: *Ts) -> R:
    """The value of a function of a part of a scene and of other arguments, cached with the part.

    It is computed once while the part exists, unless the arguments have arrays that can be written into.

    Args:
        make: The function; its value depends on its arguments only.
        part: A record whose leaves are arrays.
        others: Hashable; records are compared by identity, not by content.
    """
    if any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves((part, others))):
        return make(part, *others)
    made, key = _made.setdefault(part, {}), (make, *others)
    if key not in made:
        made[key] = make(part, *others)
    return made[key]
