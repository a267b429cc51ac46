"""Warnings about a part after the run: a mold untouched, a sheet gone, walls beyond sense, the minimum."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxform.model.part import make_part
from jaxform.model.scene import Scene
from jaxform.results.part import has_burst, thinnest_element, warnings_of_part
from jaxform.sheet.state import Status
from tests import scenes


def _part(scene: Scene, rise: float, **changes: Any) -> Any:
    """The sheet of the cup pushed by a height at its pole; as much of a `Result` as is looked at."""

    @dataclasses.dataclass
    class Part:
        positions: np.ndarray
        triangles: np.ndarray
        used: np.ndarray
        active: np.ndarray
        stuck: np.ndarray
        contact_time: np.ndarray
        wall: np.ndarray
        stretches: np.ndarray
        element_thickness: np.ndarray
        held_sides: None = None
        status: int = 0

    start, triangles = np.asarray(scene.parison.positions), np.asarray(scene.parison.triangles)
    radius = np.hypot(start[:, 0], start[:, 1])
    now = start + np.outer(rise * (1 - np.square(radius)), [0.0, 0.0, 1.0])
    nodes, count = len(start), len(triangles)
    clamped = np.asarray(scene.parison.clamped)
    part = Part(
        positions=now,
        triangles=triangles,
        used=np.ones(count, bool),
        active=np.ones(nodes, bool),
        stuck=clamped,
        contact_time=np.where(clamped, 0.0, -1.0),
        wall=np.zeros(nodes, int),
        stretches=np.ones((count, 2)),
        element_thickness=np.full(count, 0.01),
    )
    return dataclasses.replace(part, **changes)


def test_a_mold_that_nothing_touched() -> None:
    scene = scenes.cup()
    start = np.asarray(scene.parison.positions)
    nothing = warnings_of_part(_part(scene, 0.2), scene)
    assert len(nothing) == 1 and "nothing touched the mold" in nothing[0]
    clamped, pole = np.asarray(scene.parison.clamped), scenes.pole(scene)
    # Nodes that lay on the mold's flange at the start stuck in the first step, and did not move.
    flange = np.hypot(start[:, 0], start[:, 1]) > 0.7
    lying = np.where(clamped, 0.0, np.where(flange, 1e-3, -1.0))
    low = start.copy()
    low[~flange, 2] = 0.2
    assert len(warnings_of_part(_part(scene, 0.0, positions=low, contact_time=lying), scene)) == 1
    touched = np.where(np.arange(len(start)) == pole, 1.0, np.where(clamped, 0.0, -1.0))
    assert warnings_of_part(_part(scene, 0.5, contact_time=touched), scene) == []
    stopped = int(Status.STOPPED)
    assert warnings_of_part(_part(scene, 0.2, status=stopped), scene) == []
    assert warnings_of_part(_part(scene, 0.2), dataclasses.replace(scene, mold=None)) == []


def test_a_sheet_that_left_the_molds_box() -> None:
    scene = scenes.cup()
    touched = np.ones(len(scene.parison.positions))
    assert warnings_of_part(_part(scene, 0.5, contact_time=touched), scene) == []
    for rise, by in ((-0.3, "0.3 m"), (0.9, "0.4 m")):
        told = warnings_of_part(_part(scene, rise, contact_time=touched), scene)
        assert len(told) == 1 and f"left the mold's box, by {by} at (0, 0, {rise}) m" in told[0]


def test_a_sheet_that_passes_through_itself_and_bursts() -> None:
    scene = scenes.cup()
    start, count = np.asarray(scene.parison.positions), len(scene.parison.triangles)
    touched = np.ones(len(start))
    radius = np.hypot(start[:, 0], start[:, 1])
    # The middle of the sheet is turned over: it is drawn out, and back through what it came from.
    folded = start.copy()
    folded[:, :2] *= np.where(radius < 0.6, 1.9, 1.0)[:, None]
    folded[:, 2] = np.where(radius < 0.6, 0.13 - 0.2 * radius, 0.05)
    plain, stretches = _part(scene, 0.5, contact_time=touched), np.ones((count, 2))
    part = dataclasses.replace(plain, positions=folded)
    told = warnings_of_part(part, scene)
    assert len(told) == 1 and "the sheet passes through itself" in told[0]
    assert not has_burst(part, scene)
    stretches[3] = [20.0, 10.0]
    assert has_burst(dataclasses.replace(part, stretches=stretches), scene)
    assert not has_burst(dataclasses.replace(plain, stretches=stretches), scene)
    # An element that sticks wholly stays where it is.
    stuck = dataclasses.replace(part, stretches=stretches, stuck=np.ones(len(start), bool))
    assert not has_burst(stuck, scene)


def test_walls_that_are_stretched_beyond_any_sense() -> None:
    scene = scenes.cup()
    touched, count = np.ones(len(scene.parison.positions)), len(scene.parison.triangles)
    stretches = np.ones((count, 2))
    stretches[3] = [20.0, 10.0]
    told = warnings_of_part(_part(scene, 0.5, contact_time=touched, stretches=stretches), scene)
    assert len(told) == 1 and "an element without contact" in told[0] and "0.5 % of the initial" in told[0]
    stretches[3] = [4.0, 4.0]
    assert warnings_of_part(_part(scene, 0.5, contact_time=touched, stretches=stretches), scene) == []
    stretches[3] = [9.0, 9.0]
    balloon = dataclasses.replace(scene, mold=None)
    assert warnings_of_part(_part(balloon, 0.5, contact_time=touched, stretches=stretches), balloon) == []


def test_walls_that_no_sheet_bears() -> None:
    scene = scenes.cup()
    corners = np.asarray(scene.parison.triangles)
    touched = np.ones(len(scene.parison.positions))
    stretches, walls = np.ones((len(corners), 2)), np.zeros(len(touched), int)
    walls[corners[3, 0]] = 5
    stretches[3], stretches[8] = [20.0, 10.0], [9.0, 8.0]
    thickness = 0.01 / np.prod(stretches, axis=1)
    part = _part(scene, 0.5, contact_time=touched, stretches=stretches, wall=walls, element_thickness=thickness)
    told = warnings_of_part(part, scene)
    x, y, z = part.positions[corners[3]].mean(0)
    assert len(told) == 1 and f"0.5 % of the initial thickness (5e-05 m) at ({x:.4g}, {y:.4g}, {z:.4g}) m" in told[0]
    assert "an area draw ratio of 200" in told[0]
    # Just above the limit nothing is said, nor of what is no part: here, all that is lower than the trim plane.
    stretches[3], stretches[8] = [4.45, 4.45], [1.0, 1.0]
    assert warnings_of_part(dataclasses.replace(part, stretches=stretches), scene) == []
    # A deep cup that thins 35 times, on the mold or in a corner that is not filled.
    stretches[3], stretches[8] = [7.0, 5.0], [1.0, 1.0]
    for touches in (walls, np.zeros_like(walls)):
        told = warnings_of_part(dataclasses.replace(part, stretches=stretches, wall=touches), scene)
        assert len(told) == 1 and "an area draw ratio of 35" in told[0]
    stretches[3] = [20.0, 10.0]
    assert len(warnings_of_part(dataclasses.replace(part, stretches=stretches), scene)) == 1
    trimmed = dataclasses.replace(scene, part=make_part(trim=("z", float(z) + 1e-3, "above")))
    assert warnings_of_part(dataclasses.replace(part, stretches=stretches), trimmed) == []


def test_the_thinnest_place_is_told_in_the_part_and_in_the_sheet() -> None:
    scene = scenes.cup()
    walls = np.full(len(scene.parison.triangles), 0.01)
    walls[7] = 0.004
    stretches = np.ones((len(walls), 2))
    stretches[7] = [2.5, 1.0]
    part = _part(scene, 0.5, element_thickness=walls, stretches=stretches)
    # The thickness of unused elements is 0.
    walls[9], part.used[9] = 0.0, False
    found, nodes = thinnest_element(part, scene), np.asarray(scene.parison.triangles)[7]
    assert found["thickness"] == 0.004 and found["ratio"] == 0.4
    np.testing.assert_allclose(found["formed"], part.positions[nodes].mean(0))
    np.testing.assert_allclose(found["initial"], np.asarray(scene.parison.positions)[nodes].mean(0))
