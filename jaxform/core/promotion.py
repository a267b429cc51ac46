"""Under which of JAX's settings this package computes, whatever its user has chosen for code of their own."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax


def with_standard_promotion[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """The function under JAX's standard promotion of types, which this package is written for.

    Who asks for the strict one asks for it of code of their own. Rules of derivatives need it too: JAX calls them long
    after `simulate` has returned.
    """

    @functools.wraps(function)
    def wrapper(*arguments: P.args, **named: P.kwargs) -> R:
        if jax.config.jax_numpy_dtype_promotion == "standard":
            return function(*arguments, **named)
        with jax.numpy_dtype_promotion("standard"):
            return function(*arguments, **named)

    return wrapper


@contextlib.contextmanager
def device_context(array: Any) -> Iterator[Callable[[Any], Any]]:
    """Computes on the device that an array is on, and gives what places a result there.

    What has passed the host is on the default device, and arrays that are on no device by their user's choice follow
    it. Arrays on several devices are left to JAX.
    """
    devices = array.devices() if isinstance(array, jax.Array) else set()
    if len(devices) != 1 or (device := next(iter(devices))) == default_device():
        yield lambda result: result
        return
    with jax.default_device(device):
        yield functools.partial(_move_to_device, device) if array.committed else lambda result: result


def _move_to_device(device: Any, tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.device_put(leaf, device) if isinstance(leaf, jax.Array) else leaf, tree)


def default_device() -> Any:
    """The device that JAX computes on where nothing else is said."""
    chosen = jax.config.jax_default_device
    if chosen is None:
        return jax.local_devices()[0]
    return jax.local_devices(backend=chosen)[0] if isinstance(chosen, str) else chosen
