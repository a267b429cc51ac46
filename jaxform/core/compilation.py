"""Settings of JAX under which this package computes, XLA's options, and the folder in which JAX keeps programs."""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from jaxform.core import disk
from jaxform.core.errors import InputError
from jaxform.core.installation import usable_cores

# Settings of JAX under which this package computes, independent of the settings of the user's code.


def with_standard_promotion[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """The function under JAX's standard promotion of types, which this package is written for.

    A user's choice of strict promotion applies to the user's code only. Rules of derivatives need it too: JAX calls
    them after `simulate` has returned.
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
    """Computes on the device of an array, and yields a function that places a result there.

    Results that passed the host are on the default device, as are arrays without a device chosen by the user. Arrays
    on several devices are left to JAX.
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
    """The device on which JAX computes by default."""
    chosen = jax.config.jax_default_device
    if chosen is None:
        return jax.local_devices()[0]
    return jax.local_devices(backend=chosen)[0] if isinstance(chosen, str) else chosen


# Compilation of programs, and the folder in which JAX keeps them.

_LEVEL = 2  # of optimization, of the 3 that XLA's CPU compiler has
_CROWDED = 0.5  # of the mappings that Linux lets a process have


def compiler_options() -> dict[str, int | str]:
    """Options for `jax.jit` around `simulate`, or for `compile` of its lowering: up to a quarter less run time.

    On the CPU they enable vectors of 512 bits, of which LLVM uses half by default; without such vectors this has no
    effect. They lower the level of optimization, since the highest one unrolls short loops before it vectorizes them;
    put long operations on whole arrays beside the simulation into a separate `jit`. And, if this version of XLA has the
    option, they turn off threads for sums and products of whole arrays, which are too short for them. On other devices
    there are no options. `run`, `simulate_batch` and designs use them.
    """
    if jax.default_backend() != "cpu":
        return {}
    return {"xla_cpu_prefer_vector_width": 512, "xla_backend_optimization_level": _LEVEL, **_optional_flags()}


@functools.cache
def _optional_flags() -> dict[str, int | str]:
    """An option that may come and go with XLA's versions, where the present one knows it."""
    option: dict[str, int | str] = {"xla_cpu_experimental_ynn_fusion_type": ""}
    try:
        jax.jit(lambda x: x).lower(np.float32(0.0)).compile(option)
    except RuntimeError:
        return {}
    return option


def keep_programs(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Makes JAX store compiled programs for later processes, and returns the folder; a script then starts in seconds.

    Args:
        folder: The folder. By default JAX's (`JAX_COMPILATION_CACHE_DIR`), else the user's cache folder, as for the
            command. Programs in it are executed: no other user should be able to write to it.

    Returns:
        The folder; None if the user has no private cache folder: then nothing is stored.

    Raises:
        InputError: If the folder cannot be made.
    """
    known = jax.config.jax_compilation_cache_dir
    if folder is None and known:
        _cache_every_program()
        return Path(known)
    if folder is None:
        cache = disk.user_cache_folder()
        if cache is None:
            return None
        chosen = cache / disk.COMPILED
        keep_programs_in(chosen, _exit_stack())
        return chosen
    chosen = Path(folder).absolute()
    try:
        chosen.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        problem = f"cannot be written ({disk.error_reason(error)})"
        raise InputError(problem, "choose another folder", "folder", str(folder)) from None
    keep_programs_in(chosen, _exit_stack())
    return chosen


def keep_programs_in(folder: Path, guard: contextlib.ExitStack) -> None:
    """Stores compiled programs in a folder between processes; it is verified now and when the guard closes."""
    guard.enter_context(disk.guard_folder(folder))
    share_programs_in(folder)


def share_programs_in(folder: Path) -> None:
    """Stores compiled programs in a folder shared by several processes, which another process verifies."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Else what was compiled before would have settled for this process that nothing is kept.
    compilation_cache.reset_cache()
    _cache_every_program()


def _cache_every_program() -> None:
    # Many small programs together take longer than one large one.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


@functools.cache
def _exit_stack() -> contextlib.ExitStack:
    guard = contextlib.ExitStack()
    atexit.register(guard.close)
    return guard


def compile_function(function: Any, *arguments: Any) -> Any:
    """A jitted function, compiled ahead for arguments like these."""
    return start_compiling(function, *arguments)[1].result()


@with_standard_promotion
def compile_on_thread(function: Any, *arguments: Any) -> Any:
    """A jitted function, compiled for arguments like these on this thread."""
    return function.lower(*arguments).compile(compiler_options())


def start_compiling(
    function: Any, *arguments: Any, done: Callable[[Any, Any], None] | None = None
) -> tuple[Any, Future[Any]]:
    """The shapes of a jitted function's results, and the function, which is being compiled for arguments like these.

    XLA holds no lock of the interpreter: others are traced and compiled meanwhile. When it is compiled, `done` is
    called with both.
    """
    if exceeds_program_limit():
        jax.clear_caches()
    with _pause_garbage_collection():
        lowered = function.lower(*arguments)

    def compile_program() -> Any:
        program = lowered.compile(compiler_options())
        if done is not None:
            done(lowered.out_info, program)
        return program

    return lowered.out_info, submit_compilation(compile_program)


def submit_compilation[T](work: Callable[[], T]) -> Future[T]:
    """The future of work of compiling or loading a program, on another thread while others are compiled."""
    return _compilers().submit(work)


@functools.cache
def _compilers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_cores())


@contextlib.contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """Pauses garbage collection: tracing makes many lasting objects, and collection takes a tenth of its time."""
    used = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if used:
            gc.enable()


def exceeds_program_limit() -> bool:
    """True where this process has so many programs that some must be released before others are compiled.

    On Linux each takes some hundred mappings of memory, of 65 530 as a rule; without any left the compiler
    ends the process. On other systems no such limit is known.
    """
    with contextlib.suppress(OSError, ValueError):
        with Path("/proc/self/maps").open("rb") as mappings:
            used = sum(1 for _ in mappings)
        return used > _CROWDED * int(Path("/proc/sys/vm/max_map_count").read_text())
    return False
