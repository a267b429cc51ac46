"""Checkpoint policy for recomputed parts of a run: decisions and search results are saved.

Decisions and searches carry no derivative, but without them the part cannot be taken again, and they take longer than
the rest. They are few numbers beside the state.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax.ad_checkpoint import checkpoint_name

_NAME = "decided"


def save_decision[T](found: T) -> T:
    """A decision, or what was searched for (any tree of arrays), unchanged; `checkpoint` keeps it."""
    return jax.tree.map(lambda values: checkpoint_name(values, _NAME), found)


def checkpoint[**P, R](work: Callable[P, R]) -> Callable[P, R]:
    """The function; its reverse derivative keeps arguments and what `save_decision` saves, and recomputes the rest."""
    return jax.checkpoint(work, policy=jax.checkpoint_policies.save_only_these_names(_NAME))
