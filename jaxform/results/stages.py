"""A formed part as the sheet of the next stage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.model.scene import Parison, Scene, make_parison
from jaxform.results.result import Result, drop_unused

Array = NDArray[np.float64]

_THINNEST = 0.5  # of the mean of its elements: below this a corrected nodal thickness is that mean


def parison_of(result: Result, scene: Scene) -> Parison:
    """The formed part as a parison, for `build_scene` of the next stage: its shape without stress, and its mass.

    The mesh is that of the nodes and elements that exist at the end. What was clamped stays clamped, what was on a
    symmetry plane stays on it. Numbers of the material that vary over the sheet are not part of a parison; a scene
    that has some needs them at the nodes of this one, `result.active` of the former ones.

    Args:
        result: The part; not traced.
        scene: The simulated scene.

    Returns:
        The parison, with the final positions (n_node, 3) [m], and with a nodal thickness (n_node,) [m] of which the
        elements' volumes sum up to those of the part to rounding.
    """
    kept, part = drop_unused(scene, result)
    positions, triangles = np.asarray(part.positions, float), np.asarray(part.triangles)
    temperature = kept.parison.temperature if part.temperature is None else part.temperature
    return make_parison(
        positions,
        triangles,
        _conserve_volume(
            np.asarray(part.thickness, float), positions, triangles, np.asarray(part.element_volume, float)
        ),
        np.asarray(kept.parison.clamped),
        np.asarray(kept.parison.fixed),
        None if temperature is None else np.asarray(temperature),
    )


def _conserve_volume(thickness: Array, positions: Array, triangles: NDArray[np.integer], volume: Array) -> Array:
    """A nodal thickness (n_node,) [m] near the given one, whose elements have the given volume (n_element,) in all.

    An element's thickness is the mean of its nodes'. What it has too much or too little of its volume is shared out
    to its nodes, in proportion to their areas, so that the sum of all volumes is right. Where a node would become much
    thinner than its elements, all nodes have the mean of their elements by area, which conserves the sum as well.
    """
    corners = positions[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)

    def lump(values: Array) -> Array:
        return np.bincount(triangles.ravel(), np.repeat(values / 3, 3), len(positions))

    mean = lump(volume) / lump(area)
    corrected = thickness + lump(volume - area * thickness[triangles].mean(1)) / lump(area)
    return corrected if np.all(corrected > _THINNEST * mean) else mean
