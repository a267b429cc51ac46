"""A store of expensive, reproducible results in files between runs: search grids and compiled programs.

The command line keeps one in the user's cache folder, beside JAX's own of small programs. Names of files are digests
of everything the content depends on, this package's source included, so that no content can be out of date; a
file that cannot be read or written is made again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import os
import pickle
import platform
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxlib import version as jaxlib

from jaxform.core import disk
from jaxform.core.compilation import (
    compile_on_thread,
    compiler_options,
    default_device,
    exceeds_program_limit,
    start_compiling,
    submit_compilation,
)
from jaxform.core.errors import InputError
from jaxform.core.pytree import is_internal

Arrays = Mapping[str, np.ndarray]
Program = Callable[..., Any]
_MOST_BYTES = 300_000_000  # of a folder's files; those not used for longest go first
_SEAL = hashlib.sha256().digest_size
_MOST_SUBJECTS = 256  # of which it is known what they took last time
_MOST_PROGRAMS = 64  # compiled, in memory; the first made go first

PACKAGE = Path(__file__).parents[1]


PendingProgram = tuple[Any, Future[Callable[..., Any]]]
"""A function that is being compiled, or has been: a tree with shapes and types of its results, and its future."""


class Store:
    """A folder of stored results; without a folder only compiled programs are stored, in memory.

    Args:
        folder: Path of the folder; None keeps compiled programs in memory.
        shared: True if other processes use it at the same time: of those that want the same arrays or program, one
            makes them. Runs take programs of their own bucket sizes alone, so that no sum depends on what was compiled
            before.

    Attributes:
        folder: Path of the folder, made when the first thing is written.
        shared: As above.
    """

    def __init__(self, folder: Path | None = None, *, shared: bool = False) -> None:
        self.folder = folder
        self.shared = shared
        self._programs: dict[_ProgramKey, PendingProgram] = {}
        self._taken: dict[str, None] = {}
        self._ahead: Future[dict[str, tuple[bytes, Future[Program]]]] | None = None

    def arrays(self, name: str, key: tuple[Any, ...], make: Callable[[], Arrays]) -> Arrays:
        """Named arrays.

        Args:
            name: A word for the arrays.
            key: Arrays, numbers and texts on which they depend.
            make: Makes them where they are not kept.
        """
        path = self._path(name, key)
        if path is None:
            return make()
        found = _read_arrays(path)
        if found is not None:
            return found
        with self._lock(path):
            found = _read_arrays(path) if self.shared else None  # what another process has made meanwhile
            return self._make_arrays(path, make) if found is None else found

    def _make_arrays(self, path: Path, make: Callable[[], Arrays]) -> Arrays:
        arrays, file = make(), io.BytesIO()
        np.savez(file, allow_pickle=False, **arrays)
        # A search grid shrinks to an eighth, and to check and expand that takes no longer than to check it whole.
        self._write(path, zlib.compress(file.getbuffer(), 1))
        return arrays

    @contextlib.contextmanager
    def _lock(self, path: Path) -> Iterator[None]:
        """Lets one process at a time make a file, where others use the folder."""
        with disk.exclusive(path.parents[1], path.name) if self.shared else contextlib.nullcontext():
            yield

    def is_noted(self, name: str, key: tuple[Any, ...]) -> bool:
        """True if `note` was called with the same, by any process."""
        path = self._path(name, key)
        return path is not None and _read_verified(path) is not None

    def note(self, name: str, key: tuple[Any, ...]) -> None:
        """Notes that something was done, for other processes."""
        path = self._path(name, key)
        if path is not None:
            self._write(path, b"")

    def program(self, function: Any, *arguments: Any) -> Callable[..., Any]:
        """A function compiled for arguments like these: once; where it is kept in a file, it need not be traced.

        Args:
            function: Jitted; it depends on its arguments only.
            arguments: Pytrees of arrays; the structure, shapes and types count, not the values.
        """
        return self.start_program(function, *arguments)[1].result()

    def has_program(self, function: Any, *arguments: Any) -> bool:
        """True where a program is available, in memory or in a file."""
        key = _key(function, arguments)
        if key in self._programs:
            return True
        path = self._file(key)
        return path is not None and path.exists()

    def preload(self, subject: str) -> None:
        """Starts to load the programs of the last run of a subject, while the scene is still being read.

        For an unknown subject, those of the last run of all.
        """
        if self.folder is not None:
            self._ahead = submit_compilation(lambda: self._start_preloading(subject))

    def record_programs(self, subject: str) -> None:
        """Notes which stored programs a run of a subject used; programs loaded without use are released."""
        self._ahead = None
        if self.folder is None or not self._taken:
            return
        before = self._recent_names()
        others = [(about, names) for about, names in before.items() if about != subject]
        now = dict([*others[1 - _MOST_SUBJECTS :], (subject, list(self._taken))])
        if [*now.items()] != [*before.items()]:
            self._write(self.folder / _recent_names_file(), json.dumps(now).encode())

    def _recent_names(self) -> dict[str, list[str]]:
        """The names of the files of the programs that subjects took, the latest last."""
        kept = None if self.folder is None else _read_verified(self.folder / _recent_names_file())
        try:
            found = {} if kept is None else json.loads(bytes(kept))
        except ValueError:
            return {}
        # Another version may write something else there.
        lists = found.values() if isinstance(found, dict) else [None]
        known = all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists)
        return found if known else {}

    def _start_preloading(self, subject: str) -> dict[str, tuple[bytes, Future[Program]]]:
        assert self.folder is not None
        lately = self._recent_names()
        names = lately.get(subject) or next(reversed(lately.values()), [])
        read = {name: _read_verified(self.folder / Path(name).name) for name in names}
        found = {name: kept for name, kept in read.items() if kept is not None}
        longest_first = sorted(found, key=lambda name: -len(found[name]))
        return {name: loading for name in longest_first if (loading := _start_deserializing(found[name])) is not None}

    def clear_memory(self) -> None:
        """Releases the programs in memory; those in files stay."""
        self._programs.clear()

    def _file(self, key: _ProgramKey) -> Path | None:
        """The file of a program; None where it is kept in no file: only programs of the first device are."""
        function, tree, _, backend = key
        if not is_internal(tree) or ":" in backend:
            return None
        return self._path(function.__name__, tuple(str(part) for part in key[1:]))

    def start_program(self, function: Any, *arguments: Any) -> PendingProgram:
        """The program as `program` has it, compiled while others are traced and compiled."""
        key = _key(function, arguments)
        if key not in self._programs:
            path = self._file(key)
            if path is not None:
                self._taken[path.name] = None
            if exceeds_program_limit():
                self._programs.clear()
            while len(self._programs) >= _MOST_PROGRAMS:
                self._programs.pop(next(iter(self._programs)), None)
            self._programs[key] = self._start_loading(path, function, arguments) or self._start_compiling(
                path, function, arguments
            )
        return self._programs[key]

    def _start_loading(self, path: Path | None, function: Any, arguments: tuple[Any, ...]) -> PendingProgram | None:
        """A program that is being read from its file; None where there is none."""
        if path is None:
            return None
        ahead = {} if self._ahead is None else self._ahead.result()
        pending = ahead.pop(path.name, None) or _start_deserializing(_read_verified(path))
        if pending is None:
            return None
        described, loading = pending
        try:
            shapes, of_trees = _restore_trees(described)
        except Exception:  # any error of pickle for a file of another version
            return None
        done: Future[Callable[..., Any]] = Future()

        def forward_result(loaded: Future[Callable[..., Any]]) -> None:
            try:
                done.set_result(of_trees(loaded.result()))
            except Exception:  # any error of XLA for a program of another machine or version
                _compile_into(done, function, arguments)

        loading.add_done_callback(forward_result)
        return shapes, done

    def _start_compiling(self, path: Path | None, function: Any, arguments: tuple[Any, ...]) -> PendingProgram:
        """A program that is being compiled, and then written into its file where it has one."""
        if path is None:
            return start_compiling(function, *arguments)
        lock = contextlib.ExitStack()
        if self.shared:
            lock.enter_context(self._lock(path))
            found = self._start_loading(path, function, arguments)  # what another has compiled meanwhile
            if found is not None:
                lock.close()
                return found

        def store_program(shapes: Any, program: Any) -> None:
            content = serialize_program(shapes, program)
            if content is not None:
                self._write(path, content)

        try:
            pending = start_compiling(jit_under_new_name(function), *arguments, done=store_program)
        except BaseException:
            lock.close()
            raise
        pending[1].add_done_callback(lambda _: lock.close())
        return pending

    def _path(self, name: str, key: tuple[Any, ...]) -> Path | None:
        if self.folder is None:
            return None
        digest = hashlib.sha256(_environment_digest())
        for part in key:
            if isinstance(part, np.ndarray):
                digest.update(f"{part.dtype}{part.shape}".encode())
                digest.update(np.ascontiguousarray(part).tobytes())
            else:
                digest.update(repr(part).encode())
        return self.folder / f"{name.strip('_')}-{digest.hexdigest()[:32]}"

    def _write(self, path: Path, content: Any) -> None:
        """Writes atomically, since another run may read at any time; a digest precedes the content."""
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                try:
                    file.write(_content_digest(path, content))
                    file.write(content)
                except BaseException:
                    Path(file.name).unlink()
                    raise
            Path(file.name).replace(path)
            self._trim()

    def _trim(self) -> None:
        assert self.folder is not None
        files = sorted(((file.stat(), file) for file in self.folder.iterdir()), key=lambda pair: -pair[0].st_mtime)
        used = 0
        for status, file in files:
            used += status.st_size
            if used > _MOST_BYTES:
                file.unlink(missing_ok=True)


_ProgramKey = tuple[Any, Any, tuple[tuple[tuple[int, ...], Any], ...], str]
"""Key of a program in memory: the function, the structure of its arguments, their shapes and types, the backend."""


def _key(function: Any, arguments: Any) -> _ProgramKey:
    leaves, tree = jax.tree.flatten(arguments)
    kinds = tuple((np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves)
    return function, tree, kinds, _backend_name()


def _backend_name() -> str:
    """The backend, and the device where that is not its first one."""
    device, first = default_device(), jax.local_devices()[0]
    return jax.default_backend() if device == first else f"{device.platform}:{device.id}"


def _recent_names_file() -> str:
    """The file of recently used names; for programs of this host alone, of any source, which is slow to read."""
    precision = f"{jax.config.read('jax_enable_x64')}"
    return f"lately-{hashlib.sha256(host_digest() + precision.encode()).hexdigest()[:32]}"


def _start_deserializing(kept: Any) -> tuple[bytes, Future[Program]] | None:
    """The description of a program, and the function that is being loaded; None where these bytes are none."""
    found = None if kept is None else deserialize_program(kept)
    if found is None:
        return None
    described, load = found
    return described, submit_compilation(load)


def _compile_into(done: Future[Callable[..., Any]], function: Any, arguments: tuple[Any, ...]) -> None:
    try:
        done.set_result(compile_on_thread(function, *arguments))
    except BaseException as error:  # for whoever waits
        done.set_exception(error)


def _content_digest(path: Path, content: Any) -> bytes:
    """A digest of a file's name and its content: what is damaged, or has another's name, does not have it."""
    digest = hashlib.sha256(path.name.encode())
    digest.update(content)
    return digest.digest()


def _read_arrays(path: Path) -> Arrays | None:
    """The arrays in a file; None where it is missing or damaged."""
    content = _read_verified(path)
    if content is None:
        return None
    with np.load(io.BytesIO(zlib.decompress(content)), allow_pickle=False) as found:
        return {key: found[key] for key in found.files}


def _read_verified(path: Path) -> memoryview | None:
    """The content of a file that is what was written under its name; None where there is none."""
    try:
        whole = memoryview(disk.read_bytes(path, _MOST_BYTES))
        seal, content = whole[:_SEAL], whole[_SEAL:]
        if seal != _content_digest(path, content):
            return None
        os.utime(path)
    except (OSError, InputError):
        return None
    return content


@functools.cache
def _environment_digest() -> bytes:
    """A digest of what makes the things: this package's source, the precision, and what programs are made for."""
    precision = jax.config.read("jax_enable_x64")
    return hashlib.sha256(f"{precision}".encode() + machine_digest() + _source_digest(PACKAGE)).digest()


def _source_digest(package: Path) -> bytes:
    """A digest of the source of a package, its sub-packages included: names and contents."""
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        name, content = source.relative_to(package).as_posix().encode(), source.read_bytes()
        digest.update(b"%d %d " % (len(name), len(content)) + name + content)
    return digest.digest()


# Compiled programs as bytes, and programs from them: they need be neither traced nor lowered to be found again.


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
    except Exception:  # any error: it is compiled again next time
        return None
    return zlib.compress(content, 1)


def _restore_trees(described: bytes) -> tuple[Any, Callable[[Program], Program]]:
    """The shapes of a program's results, and what makes of the loaded function one of trees.

    Raises:
        Exception: Whatever pickle raises for what another version has written.
    """
    leaves, tree, made = pickle.loads(described)
    shapes = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, kind) for shape, kind in leaves])

    def of_trees(flat: Program) -> Program:
        return lambda *arguments: jax.tree.unflatten(made, flat(*jax.tree.leaves(arguments)))

    return shapes, of_trees


def deserialize_program(content: Any) -> tuple[bytes, Callable[[], Program]] | None:
    """A program from bytes; None where they are none of this version's.

    Args:
        content: Bytes of `serialize_program`, from a place that is the user's alone: such bytes can do anything.

    Returns:
        Its description, for `_restore_trees`, and a function that loads it, as one from leaves to leaves: that needs
        none of the classes of its arguments.
    """
    try:
        code, given, made, described = pickle.loads(zlib.decompress(content))
        leaves = jax.tree.structure((tuple(range(given)), {})), jax.tree.structure(tuple(range(made)))
    except Exception:  # any error of pickle for a file of another version
        return None

    def load() -> Program:
        from jax.experimental import serialize_executable

        return serialize_executable.deserialize_and_load(code, *leaves, execution_devices=jax.local_devices()[:1])

    return described, load


@functools.cache
def machine_digest() -> bytes:
    """A digest of what a compiled program is made for, its source aside: versions, XLA's options, the processor."""
    device = jax.local_devices()[0]
    seen = device.client.platform_version, device.device_kind, len(jax.local_devices()), compiler_options()
    return _digest(host_digest(), *seen)


@functools.cache
def host_digest() -> bytes:
    """A digest of what of that is known before any device is examined."""
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
