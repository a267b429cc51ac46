"""jaxform: a differentiable simulator of blow moulding and thermoforming.

The names are listed in `__init__.pyi`; each is imported when it is first used.
"""

import sys

import lazy_loader

if "jax" in sys.modules:
    # Whoever has JAX may use this package for the first time inside a trace: see `core.pytree`.
    import jax.extend  # noqa: F401

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
