"""What every test runs under: double precision, pictures without a display, programs compiled once."""

import os
from pathlib import Path

import hypothesis

# What is compiled is kept for other tests, for the programs that they start and for the next run; each worker has a
# folder, since two must not write one file. `pytest --cache-clear` empties them.
_WORKER = os.environ.get("PYTEST_XDIST_WORKER", "alone")
_PROGRAMS = Path(__file__).parent.parent / ".pytest_cache" / "programs" / _WORKER
os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_PROGRAMS))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

import jax  # noqa: E402  (it reads the environment)

jax.config.update("jax_enable_x64", True)

# The first example of a test compiles, so its time says nothing; the same examples in every run.
hypothesis.settings.register_profile("jaxform", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("jaxform")
