"""Compiled programs as bytes, and programs from them: they need be neither traced nor lowered to be found again."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import platform
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jaxlib import version as jaxlib

from jaxform.core.compilation import compiler_options

Program = Callable[..., Any]


def jit_under_new_name(function: Any) -> Any:
    """A jitted function under a name that JAX's own cache has no program of: what it gave could not be packed.

    XLA leaves out of a program that it has read what it would need to write it again.
    """

    def call(*arguments: Any) -> Any:
        return function(*arguments)

    call.__name__ = f"{function.__name__.strip('_')}_{os.urandom(8).hex()}"
    return jax.jit(call)


def serialize_program(shapes: Any, program: Any) -> bytes | None:
    """A compiled program and the shapes of its results, as bytes; None where XLA cannot write it down."""
    from jax.experimental import serialize_executable

    leaves, tree = jax.tree.flatten(shapes)
    described = [(tuple(leaf.shape), str(leaf.dtype)) for leaf in leaves]
    try:
        code, given, made = serialize_executable.serialize(program)
        content = pickle.dumps((code, given.num_leaves, made.num_leaves, pickle.dumps((described, tree, made))))
    except Exception:  # whatever: it is compiled again next time
        return None
    return zlib.compress(content, 1)


class StoredProgram(NamedTuple):
    """A program that was read from bytes.

    Attributes:
        load: Loads it, as a function from leaves to leaves: that needs none of the classes of its arguments.
        known: What else is known of it.
    """

    load: Callable[[], Program]
    known: bytes

    def shapes(self) -> tuple[Any, Callable[[Program], Program]]:
        """The shapes of its results, and what makes of the loaded function one of trees.

        Raises:
            Exception: Whatever pickle raises for what another version has written.
        """
        described, tree, made = pickle.loads(self.known)
        shapes = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, kind) for shape, kind in described])

        def of_trees(flat: Program) -> Program:
            return lambda *arguments: jax.tree.unflatten(made, flat(*jax.tree.leaves(arguments)))

        return shapes, of_trees


def deserialize_program(content: Any) -> StoredProgram | None:
    """A program from bytes; None where they are none of this version's.

    Args:
        content: What `serialize_program` gave, from a place that is the user's alone: such bytes can do anything.
    """
    try:
        code, given, made, known = pickle.loads(zlib.decompress(content))
        leaves = jax.tree.structure((tuple(range(given)), {})), jax.tree.structure(tuple(range(made)))
    except Exception:  # whatever pickle raises for what another version has written
        return None

    def load() -> Program:
        from jax.experimental import serialize_executable

        return serialize_executable.deserialize_and_load(code, *leaves, execution_devices=jax.local_devices()[:1])

    return StoredProgram(load, known)


@functools.cache
def machine_digest() -> bytes:
    """A digest of what a compiled program is made for, its source aside: versions, XLA's options, the processor."""
    device = jax.local_devices()[0]
    seen = device.client.platform_version, device.device_kind, len(jax.local_devices()), compiler_options()
    return _digest(host_digest(), *seen)


@functools.cache
def host_digest() -> bytes:
    """A digest of what of that is known before any device is looked at."""
    asked = os.environ.get("XLA_FLAGS", ""), os.environ.get("JAX_PLATFORMS", "")
    return _digest(jax.__version__, jaxlib.__version__, *asked, platform.machine(), _processor_flags())


def _digest(*words: object) -> bytes:
    return hashlib.sha256("\n".join(map(str, words)).encode()).digest()


def _processor_flags() -> str:
    """The instruction set flags of the processor, where the system tells them."""
    try:
        with Path("/proc/cpuinfo").open() as lines:
            return next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        return platform.processor()
