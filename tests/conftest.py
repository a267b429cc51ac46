"""What every test runs under: double precision, no silent broadcasting, pictures without a display."""

import os

import hypothesis
import jax

os.environ["MPLBACKEND"] = "Agg"

jax.config.update("jax_enable_x64", True)

# The first example of a test compiles, so its time says nothing; the same examples in every run.
hypothesis.settings.register_profile("jaxform", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("jaxform")
