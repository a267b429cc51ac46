"""What loads the sheet, and how another loading is added: a class of its own, decorated with `loading`."""

from __future__ import annotations

from typing import Any, ClassVar, dataclass_transform

import jax
import numpy as np

from jaxform.core.parameters import declared_part, parameter, within
from jaxform.core.pytree import as_real, static

_LOOKS = 17


class Loading:
    """Pressure difference on the sheet, positive along its triangles' normals.

    A loading is a pytree whose numbers are leaves; its class is the static choice. It gives the pressure of a moment,
    differentiable in all that it depends on::

        @jaxform.loading
        class Sealed(jaxform.Loading):
            content: jax.Array = jaxform.parameter("J", above=0.0)
            dead_volume: jax.Array = jaxform.parameter("m^3", above=0.0)
            outside: jax.Array = jaxform.parameter("Pa", least=0.0)

            def at(self, time, volume):
                return self.content / (self.dead_volume + volume) - self.outside

    The stable step knows how the pressure falls with the volume; gradients are by checkpoints (`jaxform.Checkpointed`).

    Attributes:
        follows_volume: Whether the pressure depends on the enclosed volume; where it does not, no step works it out.
    """

    follows_volume: ClassVar[bool] = True

    def at(self, time: jax.Array, volume: Any) -> jax.Array:
        """Pressure [Pa] at a time [s], with so much volume [m^3] of the modelled part between the sheet and its origin.

        The volume is not worked out, but None, where the pressure does not follow it.
        """
        raise NotImplementedError

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """Pressures [Pa] of the process, by which one tells how much and which way it pushes; of numbers, not traced.

        Args:
            end_time: When it ends [s].
            volume: What the sheet encloses at first [m^3].
        """
        times = np.linspace(0.0, end_time, _LOOKS)
        return np.asarray([self.at(as_real(time), as_real(volume)) for time in times], float)


@dataclass_transform(frozen_default=True, field_specifiers=(parameter, within, static))
def loading[T: Loading](cls: type[T]) -> type[T]:
    """Makes a class a loading: a frozen dataclass and a pytree, its numbers known to `replace` and to designs.

    Raises:
        InputError: It does not derive from `Loading`, gives no pressure, or has an undeclared number.
    """
    return declared_part(cls, Loading, "at", "derive it from jaxform.Loading and give it a pressure, `at`", "pressure")
