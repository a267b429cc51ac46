"""Compiled programs as bytes, and programs from them: they need be neither traced nor lowered to be found again."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import platform
import zlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from jaxform.core.compiling import compiler_options


def freshly_named(function: Any) -> Any:
    """A jitted function under a name that JAX's own cache has no program of: what it gave could not be packed.

    XLA leaves out of a program that it has read what it would need to write it again.
    """

    def call(*arguments: Any) -> Any:
        return function(*arguments)

    call.__name__ = f"{function.__name__.strip('_')}_{os.urandom(8).hex()}"
    return jax.jit(call)


def packed(shapes: Any, program: Any) -> bytes | None:
    """A compiled program and the shapes of its results, as bytes; None where XLA cannot write it down."""
    from jax.experimental import serialize_executable

    leaves, tree = jax.tree.flatten(shapes)
    described = [(tuple(leaf.shape), str(leaf.dtype)) for leaf in leaves]
    try:
        content = pickle.dumps((described, tree, serialize_executable.serialize(program)))
    except Exception:  # whatever: it is compiled again next time
        return None
    return zlib.compress(content, 1)


def unpacked(content: Any) -> tuple[Any, Callable[[], Any]] | None:
    """The shapes of a program's results, and what loads it; None where the bytes are none of this version's.

    Args:
        content: What `packed` gave, from a place that is the user's alone: such bytes can do anything.
    """
    from jax.experimental import serialize_executable

    try:
        described, tree, program = pickle.loads(zlib.decompress(content))
        shapes = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, kind) for shape, kind in described])
    except Exception:  # whatever pickle raises for what another version has written
        return None
    return shapes, lambda: serialize_executable.deserialize_and_load(
        *program, execution_devices=jax.local_devices()[:1]
    )


@functools.cache
def machine() -> bytes:
    """A digest of what a compiled program is made for, its source aside: versions, XLA's options, the processor."""
    digest = hashlib.sha256()
    device = jax.local_devices()[0]
    for word in (
        jax.__version__,
        metadata.version("jaxlib"),
        device.client.platform_version,
        device.device_kind,
        len(jax.local_devices()),
        compiler_options(),
        os.environ.get("XLA_FLAGS", ""),
        platform.machine(),
        _instructions(),
    ):
        digest.update(f"{word}\n".encode())
    return digest.digest()


def _instructions() -> str:
    """What instructions the processor has, where the system says so."""
    try:
        with Path("/proc/cpuinfo").open() as lines:
            return next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        return platform.processor()
