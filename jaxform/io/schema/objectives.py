"""Tables of the objectives of a study."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from jaxform.io.schema.quantities import TargetThickness
from jaxform.io.validation import Positive, Table, choice, form


class ObjectiveTable(Table):
    """Keys that all objectives share.

    Attributes:
        weight: Weight of the objective in a sum of several.
    """

    weight: Positive = 1.0


class TargetTable(ObjectiveTable):
    """Come close to a final thickness [m]; with `limit`, keep a deviation (relative, rms) instead.

    Attributes:
        kind: The kind of objective.
        thickness: The wanted wall [m].
        limit: Relative deviation (rms) to be kept, instead of the least one.
    """

    kind: Literal["target"]
    thickness: TargetThickness
    limit: Positive | None = None


class UniformTable(ObjectiveTable):
    """Make the wall even.

    Attributes:
        kind: The kind of objective.
    """

    kind: Literal["uniform"]


class LeastMassTable(ObjectiveTable):
    """Use as little material as a minimum of the wall [m] allows.

    Attributes:
        kind: The kind of objective.
        minimum: Minimum of the wall [m].
    """

    kind: Literal["least-mass"]
    minimum: Positive


class FormingTimeTable(ObjectiveTable):
    """Form quickly; the higher the power of the mean, the more the last contact counts.

    Attributes:
        kind: The kind of objective.
        power: Power of the mean of contact times: the higher, the more the last contact counts.
    """

    kind: Literal["forming-time"]
    power: Annotated[float, Field(ge=1, le=100)] = 8.0


class KineticEnergyTable(ObjectiveTable):
    """Form gently.

    Attributes:
        kind: The kind of objective.
    """

    kind: Literal["kinetic-energy"]


_OBJECTIVES = ["target", "uniform", "least-mass", "forming-time", "kinetic-energy"]
Objective = Annotated[
    Annotated[TargetTable, Tag("<target>")]
    | Annotated[UniformTable, Tag("<uniform>")]
    | Annotated[LeastMassTable, Tag("<least-mass>")]
    | Annotated[FormingTimeTable, Tag("<forming-time>")]
    | Annotated[KineticEnergyTable, Tag("<kinetic-energy>")],
    *choice("kind", _OBJECTIVES),
]
Objectives = Annotated[
    Annotated[Objective, Tag("<one>")] | Annotated[Annotated[list[Objective], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]
