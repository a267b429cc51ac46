"""Settings of all tests: double precision, pictures without a display, programs compiled once."""

import gc
import os
import signal
from pathlib import Path

import hypothesis
import pytest

# Compiled programs are kept for other tests, the other worker, the processes that they start and later runs.
# `pytest --cache-clear` empties it.
_PROGRAMS = Path(__file__).parent.parent / ".pytest_cache" / "programs"
os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_PROGRAMS))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.02")
# Compiling is nearly all of the time, and the machine code need not be fast: XLA does the same to a program, LLVM less.
# Programs that tests start are compiled as users' are.
_FLAGS = os.environ.get("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] = f"{_FLAGS} --xla_backend_optimization_level=0"

# A shell without job control starts background commands that ignore SIGINT, and so would the programs that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tracing makes many objects that live on: to look for garbage among them takes a quarter of its time.
gc.set_threshold(100_000, 50, 50)

import jax  # noqa: E402  (it reads the environment)

jax.config.update("jax_enable_x64", True)
jax.devices()  # reads the flags
os.environ["XLA_FLAGS"] = _FLAGS

from jaxform.core import compilation  # noqa: E402

compilation._LEVEL = 0

# The first example of a test compiles, so its time says nothing; the same examples in every run.
hypothesis.settings.register_profile("jaxform", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("jaxform")

# Files go to the workers whole, in this order: those that take longest first, so that all workers end together.
_FIRST = (
    "features",
    "new_extrusion",
    "refinement",
    "simulation",
    "cli",
    "contact",
    "skips",
    "force",
    "fit",
    "sweep",
    "edge_contact",
    "fields",
    "new_bucks",
    "optimize",
    "new",
    "viscous",
    "further_laws",
    "new_bottles",
    "check",
    "stability",
    "sliding",
    "windows",
    "cooling",
    "laws",
    "pinch",
    "design",
    "notebooks",
    "second",
    "gravity",
    "blocks",
    "zones",
    "padding",
    "bench",
    "validate",
    "rims",
    "exact",
    "files",
    "gas",
    "worker_process",
    "rank",
    "initial_contact",
    "store",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the longest files first and leaves the order otherwise."""
    places = {f"test_{name}": place for place, name in enumerate(_FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))
