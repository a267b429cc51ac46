"""Messages while a search compiles."""

from __future__ import annotations

from jaxform import Scene

_PROGRAMS = {"gradient": "value and gradient", "columns": "the Jacobian of the deviations"}  # that take long
_SECONDS = (20, 40)  # for one, uniform and refined, on two cores


def waiting_message(program: str, scene: Scene) -> str | None:
    """Message before a program of the search is compiled; None where that takes little time."""
    if program not in _PROGRAMS:
        return None
    seconds = _SECONDS[scene.refinement is not None]
    return f"compiling {_PROGRAMS[program]}, about {seconds} s unless it was compiled before"
