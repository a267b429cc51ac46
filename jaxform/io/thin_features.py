"""Check for ribs and pins of a mold that are thinner than the elements of the sheet. On the host, before a run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import warn_of
from jaxform.core.formatting import format_place
from jaxform.io.scene_checks import survey
from jaxform.model.scene import Scene
from jaxform.tools.slender import SlenderFeature, slender_feature

Array = NDArray[np.float64]


def warn_of_thin_features(scene: Scene, file: str = "") -> None:
    """Warns of the highest rib or pin of the mold that may pass between the nodes of a nearly flat sheet."""
    side = finest_side(scene)
    found = _thin_feature(scene, side)
    if found is None:
        return
    problem = (
        f"has a rib or pin at {format_place(found.place)} that is {found.height:.2g} m high and at most "
        f"{found.width:.2g} m wide, and elements have sides of {side:.2g} m: it may pass through the "
        "sheet between two nodes"
    )
    remedy = f"make the elements smaller (parison.element_size = {0.5 * found.width:.1g}), or refine near the mold"
    warn_of(problem, f"{remedy} ([refinement])", key="mold", file=file)


def finest_side(scene: Scene) -> float:
    """The median of the elements' longest sides [m], as short as refinement near the mold makes them."""
    corners = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    levels = 0 if scene.refinement is None else int(scene.refinement.base_level)
    # Two bisections halve a side.
    return float(np.median(longest)) * 0.5 ** (0.5 * levels)


def _thin_feature(scene: Scene, side: float) -> SlenderFeature | None:
    seen = survey(scene)
    if scene.mold is None or not seen.faces:
        return None
    positions = np.asarray(scene.parison.positions, float)
    sheet = positions[np.asarray(scene.parison.triangles)]
    mold = np.asarray(scene.mold.vertices, float)[np.asarray(scene.mold.triangles)]
    held = positions[np.asarray(scene.parison.clamped)]
    return slender_feature(sheet, mold, seen.push / np.linalg.norm(seen.push), side, held)
