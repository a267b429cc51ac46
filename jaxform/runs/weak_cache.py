"""What was made of parts of a scene, for as long as these are there: scenes that share them share it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np

_made: weakref.WeakKeyDictionary[Any, dict[tuple[Hashable, ...], Any]] = weakref.WeakKeyDictionary()


def cache_by_identity[P, R, *Ts](make: Callable[[P, *Ts], R], part: P, *others: *Ts) -> R:
    """What a function makes of a part of a scene and of others, which it does not change.

    It is made once while the part is there, unless the part has arrays that can be written into.

    Args:
        make: Depends on its arguments only.
        part: A record whose leaves are arrays.
        others: Hashable; records count by what they are, not by what they hold.
    """
    if any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves((part, others))):
        return make(part, *others)
    made, key = _made.setdefault(part, {}), (make, *others)
    if key not in made:
        made[key] = make(part, *others)
    return made[key]
