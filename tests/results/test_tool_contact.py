"""Figures of each tool in the summary, against closed values."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest

import jaxform
from jaxform import molds, shapes
from jaxform.core.pytree import as_real
from jaxform.io.output import write_part
from jaxform.results.filling import FINER, remedy_of_bridge
from jaxform.results.size_field import edge_lines
from jaxform.results.summary import (
    _warnings_of_depth,
    _warnings_of_penetration,
    summarize,
    summarize_at_once,
)
from jaxform.results.tool_contact import ContactRecord, summarize_tools
from jaxform.tools.penetration import Penetration
from jaxform.tools.ribs import Ribs
from tests import scenes

_SHEET, _GAP, _WAY, _END = 0.01, 0.1, 0.5, 10.0


def _motion(way: float) -> jaxform.Motion:
    return jaxform.make_motion([0, 0, 1], [0.0, _END], [0.0, way])


def _tool(shape: molds.MoldShape, name: str, law: Any = None, way: float = 0.0, low: float = 0.0) -> jaxform.Mold:
    lowered = np.asarray(shape.vertices) - [0.0, 0.0, low]
    motion = _motion(way) if way else None
    return jaxform.make_mold(lowered, shape.triangles, contact=law, motion=motion, name=name)


def _scene(*tools: jaxform.Mold, elements: int = 150) -> jaxform.Scene:
    """A clamped disc of radius 1 that tools push."""
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, _SHEET, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=_END, damping=2.0),
        tools=tools,
        fill=False,
    )


@pytest.fixture(scope="module")
def pushed_flat() -> tuple[jaxform.Scene, jaxform.Result]:
    """A disc without a ring of nodes at the edge of the flat plug that pushes it, and a plate far from it."""
    plug = _tool(molds.revolved(profile=[[0.0, 0.0], [0.45, 0.0], [0.45, -1.5]], segments=96), "plug", None, _WAY, _GAP)
    scene = _scene(plug, _tool(molds.plate(radius=0.5), "far", None, 0.0, 3.0))
    return scene, jaxform.run(scene)


def test_a_flat_plug_to_which_the_sheet_sticks(pushed_flat: tuple[jaxform.Scene, jaxform.Result]) -> None:
    """The plug does not stretch what it lifts, from the moment at which it comes to the sheet."""
    scene, result = pushed_flat
    pushed, rests = summarize(result, scene)["tools"]
    assert (pushed["name"], rests["name"]) == ("plug", "far")
    met = _END * next(root.real for root in np.roots([-2.0, 3.0, 0.0, -_GAP / _WAY]) if 0.0 < root.real < 1.0)
    assert pushed["contact_time"]["min"] == pytest.approx(pushed["contact_time"]["max"]) == pytest.approx(met, rel=5e-3)
    assert pushed["contact_period"] == [pushed["contact_time"]["min"], float(result.time)]
    np.testing.assert_allclose([pushed["thickness"][key] for key in ("min", "mean", "max")], _SHEET, rtol=1e-9)
    assert pushed["thickness"]["cv"] < 1e-9
    # The elements under it keep their area.
    places = np.asarray(scene.parison.positions)[np.asarray(result.triangles)]
    under = (np.linalg.norm(places, axis=2) < 0.45).all(1)
    area = np.asarray(result.element_volume) / np.asarray(result.element_thickness)
    share = np.asarray(scene.tables.sheet.area)[under].sum() / area.sum()
    assert 0.05 < share == pytest.approx(pushed["contact_fraction"], rel=1e-9)
    assert pushed["contact_fraction_max"] == pushed["contact_fraction"]
    assert pushed["work"] == float(result.energy.tool_work) > 0.0 == pushed["friction_loss"]
    empty = ("contact_period", "contact_time", "thickness", "penetration_place")
    assert [rests[key] for key in empty] == [None] * 4
    assert [rests[key] for key in ("contact_fraction", "work", "friction_loss", "penetration_max")] == [0.0] * 4


def test_the_line_of_the_sheet_at_the_edge_of_a_plug_is_found_by_what_lies_on_it(
    pushed_flat: tuple[jaxform.Scene, jaxform.Result],
) -> None:
    """Elements across the edge are stretched alike on both sides of it: what is nearest to it in them is too far in."""
    lines = edge_lines(*pushed_flat)
    radius = np.concatenate([np.linalg.norm(line, axis=1) for line in lines])
    # The middles of the plug's 96 sides are nearest to its axis.
    assert len(radius) > 20 and 0.45 * np.cos(np.pi / 96) - 1e-9 < radius.min() and radius.max() < 0.45 + 1e-9


def test_a_clamped_rim_on_the_edge_of_a_mold_is_the_line_there() -> None:
    """Though the elements at the rim are stretched less than those below, which lie on the wall."""
    cup = molds.revolved(profile=[[0.0, -0.6], [0.6, -0.6], [1.0, 0.0], [1.3, 0.0]], segments=48)
    sheet = shapes.disc(radius=1.0, elements=150, symmetry="quarter")
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, _SHEET, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=jaxform.make_pressure([0.0], [-1.0]),
        solver=jaxform.make_solver(end_time=_END, damping=2.0),
        mold=jaxform.make_mold(cup.vertices, cup.triangles),
        fill=False,
    )
    radius = np.linalg.norm(sheet.positions, axis=1)
    # The rings at 0.9 and 1 are half as far apart on the formed sheet as those within.
    there = np.where(radius > 0.95, 1.0, 0.95 * radius / 0.9)
    height = np.maximum(-0.6, 1.5 * (there - 1.0))
    scaled = sheet.positions * (there / np.maximum(radius, 1e-12))[:, None]
    result: Any = SimpleNamespace(
        positions=scaled + height[:, None] * [0.0, 0.0, 1.0],
        stuck=np.ones(len(radius), bool),
        tool=np.where(sheet.clamped, -1, 0),
        time=_END,
    )
    outer = [line for line in edge_lines(scene, result) if np.linalg.norm(line, axis=1).max() > 0.8]
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(outer), axis=1), 1.0, atol=5e-3)


def _depth_in_ball(corners: np.ndarray, center: np.ndarray, radius: float) -> float:
    """Depth to which triangles (n, 3, 3) cut a ball, by points all over them."""
    count = 24
    i, j = np.mgrid[: count + 1, : count + 1]
    kept = i + j <= count
    shares = np.stack([count - i - j, i, j], axis=-1)[kept] / count
    away = np.linalg.norm(np.einsum("pk,nkc->npc", shares, corners) - center, axis=2)
    return radius - float(away.min())


@pytest.mark.parametrize("radius", scenes.short_first([0.3, 0.6]))
def test_elements_cut_a_round_plug_as_deep_as_chords_of_its_ball(radius: float) -> None:
    plug = _tool(molds.rod(radius=radius, length=2.0, segments=192), "plug", None, _WAY)
    scene = _scene(plug)
    result = jaxform.run(scene)
    summary = summarize(result, scene)
    corners = np.asarray(result.positions)[np.asarray(result.triangles)]
    (found,) = summary["tools"]
    center = np.array([0.0, 0.0, _WAY - radius])
    depth = _depth_in_ball(corners, center, radius)
    assert found["penetration_max"] == pytest.approx(depth, rel=0.05) and depth > 2e-3
    assert radius - np.linalg.norm(found["penetration_place"] - center) == pytest.approx(depth, rel=0.05)
    assert any("cuts an edge of tool plug" in sentence for sentence in summary["warnings"]) == (
        depth > float(np.asarray(result.element_thickness).max())
    )
    # Before it is measured nothing is said of it.
    (early,) = summarize_at_once(result, scene)["tools"]
    assert early == found | {"penetration_max": None, "penetration_place": None}


def _two_discs(chosen: tuple[int, ...], laws: tuple[Any, Any]) -> jaxform.Scene:
    """One of two discs that are apart, each with a plug of its own below it; or both."""
    sheet, count = shapes.disc(radius=1.0, elements=60, symmetry="quarter"), len(chosen)
    flat = molds.revolved(profile=[[0.0, 0.0], [0.3, 0.0], [0.3, -1.5]], segments=96)
    plugs = [_tool(flat, f"plug{k}", laws[k], way=(0.3, 0.5)[k], low=-3.0 * k) for k in chosen]
    return jaxform.build_scene(
        parison=jaxform.make_parison(
            np.concatenate([sheet.positions + np.array([0.0, 0.0, 3.0 * k]) for k in chosen]),
            np.concatenate([sheet.triangles + len(sheet.positions) * place for place in range(count)]),
            _SHEET,
            np.tile(sheet.clamped, count),
            np.tile(sheet.fixed, (count, 1)),
        ),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=_END, damping=2.0),
        tools=plugs,
        fill=False,
    )


@pytest.mark.long
@pytest.mark.parametrize("frictions", [(0.2, 0.4), (None, 0.4)])
def test_each_of_two_tools_that_move_and_rub_has_the_energies_that_it_has_alone(frictions: tuple) -> None:
    laws: Any = tuple(None if each is None else jaxform.Coulomb(as_real(each)) for each in frictions)
    alone, both = [], _two_discs((0, 1), laws)
    for number in (0, 1):
        scene = _two_discs((number,), laws)
        alone += summarize(jaxform.run(scene), scene)["tools"]
    result = jaxform.run(both)
    together = summarize(result, both)["tools"]
    for key in ("work", "friction_loss"):
        np.testing.assert_allclose([tool[key] for tool in together], [tool[key] for tool in alone], rtol=1e-3)
    np.testing.assert_allclose(sum(tool["work"] for tool in together), result.energy.tool_work, rtol=1e-12)
    np.testing.assert_allclose(sum(tool["friction_loss"] for tool in together), result.energy.friction_loss, rtol=1e-12)
    assert together[1]["work"] > 2 * together[0]["work"] > 0.0 and together[1]["friction_loss"] > 0.0
    # `simulate`, which runs another form of the step, adds them up alike.
    traced = jaxform.simulate(both)
    np.testing.assert_allclose(traced.energy.by_tool.work, result.energy.by_tool.work, rtol=1e-9)
    np.testing.assert_allclose(traced.energy.by_tool.friction, result.energy.by_tool.friction, rtol=1e-9)


def test_contact_of_tools_that_come_and_go() -> None:
    shape = molds.plate(radius=0.5)
    laws = [jaxform.Coulomb(as_real(0.3)), jaxform.Slide(), None]
    tools = [_tool(shape, f"t{k}", law, way=0.1 * (k > 0), low=3.0 + k) for k, law in enumerate(laws)]
    scene = _scene(*tools)
    made: Any = SimpleNamespace(
        triangles=np.array([[0, 1, 2], [3, 4, 5]]),
        used=np.ones(2, bool),
        stuck=np.zeros(6, bool),
        tool=np.array([0, 0, 0, -1, -1, 1]),
        contact_time=np.array([1.0, 2.0, 3.0, -1.0, -1.0, 4.0]),
        element_volume=np.array([1.0, 3.0]),
        element_thickness=np.array([0.5, 0.5]),
        time=9.0,
        energy=SimpleNamespace(tool_work=7.0, friction_loss=5.0, by_tool=SimpleNamespace(work=(3.0, 4.0), friction=())),
        contacts=np.array([[0.0, 0.5, 6.0, 8.0], [0.0, 0.75, 0.2, 0.2], [0.0] * 4, [0.0, 0.0, 0.1, 0.0]]),
        contact_periods=np.array([[0.5, 8.0], [np.nan, np.nan], [5.5, 6.5]]),
    )
    first, second, third = summarize_tools(made, scene)
    assert [tool["work"] for tool in (first, second, third)] == [0.0, 3.0, 4.0]
    assert [tool["friction_loss"] for tool in (first, second, third)] == [5.0, 0.0, 0.0]
    assert first["contact_fraction"] == 0.25 and first["contact_fraction_max"] == 0.75
    assert first["contact_period"] == [0.5, 9.0] and first["contact_time"] == {"min": 1.0, "max": 3.0}
    # A single node in contact: no element is, but it touches since then.
    assert second["contact_period"] == [4.0, 9.0] and second["thickness"] is None
    # It was left before the end.
    assert third["contact_period"] == [5.5, 6.5] and third["contact_time"] is None


def test_how_long_nodes_have_touched_each_tool() -> None:
    """By records now and then: of nodes that stay, that leave, that go to another tool, that leave and come back."""

    def at(time: float, tool: list[int], landed: list[float]) -> Any:
        return SimpleNamespace(
            time=time,
            tool=np.array(tool),
            contact_time=np.array(landed),
            triangles=np.array([[0, 1, 2]]),
            used=np.ones(1, bool),
            stuck=np.zeros(len(tool), bool),
            element_volume=np.ones(1),
            element_thickness=np.ones(1),
        )

    record = ContactRecord(2, 60.0)
    free, held = [-1, -1, -1, -1], [0, 0, 0, 0]
    record.offer(1.0, lambda: at(1.0, free, [-1.0] * 4))
    record.offer(3.0, lambda: at(3.0, held, [2.0] * 4))
    record.offer(3.5, lambda: pytest.fail("too soon after the last record"))
    # Half the time since the last record is counted, until the node came to a tool again.
    then = at(5.0, [0, -1, 1, 0], [2.0, -1.0, 4.0, 4.5])
    np.testing.assert_allclose(record.durations(then), [[3.0, 0.0], [2.0, 0.0], [1.5, 1.0], [2.25, 0.0]])
    record.offer(5.0, lambda: then)
    # A new node has touched nothing before.
    last = at(9.0, [0, 1, 1, -1, 0], [2.0, 8.0, 4.0, -1.0, 8.5])
    expected = [[7.0, 0.0], [2.0, 1.0], [1.5, 5.0], [4.25, 0.0], [0.5, 0.0]]
    for _ in range(2):
        np.testing.assert_allclose(record.durations(last), expected)


def test_nodes_that_stick_have_touched_their_tool_since_they_came_to_it(
    pushed_flat: tuple[jaxform.Scene, jaxform.Result], tmp_path: Path
) -> None:
    scene, result = pushed_flat
    write_part(scene, result, tmp_path / "part.vtu")
    fields = meshio.read(tmp_path / "part.vtu").point_data
    on = np.asarray(result.tool) == 0
    assert 5 < on.sum() < len(on)
    expected = np.where(on, float(result.time) - np.asarray(result.contact_time), 0.0)
    np.testing.assert_allclose(fields["contact_duration_plug"], expected, rtol=1e-12)
    np.testing.assert_array_equal(fields["contact_duration_far"], 0.0)


def test_contact_from_the_start_begins_at_0() -> None:
    """Not at the least number, by which the state tells it from a clamp."""
    disc = shapes.disc(radius=1.0, elements=24, symmetry="quarter")
    lowest = molds.plate(radius=0.9)
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(disc.positions, disc.triangles, _SHEET, disc.clamped, disc.fixed),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=_END, damping=2.0),
        mold=jaxform.make_mold(lowest.vertices, lowest.triangles),
        fill=False,
    )
    (mold,) = summarize(jaxform.run(scene), scene)["tools"]
    assert mold["contact_time"] == {"min": 0.0, "max": 0.0} and mold["contact_period"][0] == 0.0


def test_a_warning_of_penetration_names_the_tool_and_its_remedy() -> None:
    """A plug need not be as wide as the sheet, as a mold must be."""
    scene = _scene(_tool(molds.plate(radius=0.3), "plug", low=3.0), elements=24)
    result = jaxform.run(scene)
    deep = Penetration(0.0, 1.0, np.zeros(3))
    (found,) = _warnings_of_penetration(result, scene, deep, scene.tools[0])
    assert found.startswith("the sheet penetrates tool plug, by up to 1 m at ")
    assert found.endswith(f"{FINER}, add [refinement], or round the edge of tool plug")
    (of_mold,) = _warnings_of_depth(result, scene, deep, "the mold")
    assert of_mold.endswith("make the mold as wide as the sheet, or the elements smaller")


def test_the_remedy_for_edges_between_nodes_is_one_that_the_scene_can_have() -> None:
    """Edge contact excludes refinement and smooth landing: only what the scene has not, and can have, is named."""
    scene = _scene(_tool(molds.plate(radius=0.3), "plug", low=3.0), elements=24)
    result = jaxform.run(scene)
    rib, cut = (
        Penetration(0.0, 0.0, np.zeros(3), ribs=Ribs(3, 0.1, 0.01, np.zeros(3))),
        Penetration(0, 0.02, np.zeros(3)),
    )

    def remedies(**changes: Any) -> list[str]:
        solver = dataclasses.replace(scene.solver, **changes)
        changed = dataclasses.replace(scene, solver=solver)
        sentences = (_warnings_of_penetration(result, changed, found, scene.tools[0])[0] for found in (rib, cut))
        return [sentence.rsplit("; ", 1)[1] for sentence in sentences]

    assert all(words.startswith("set solver.edge_contact = true") for words in remedies())
    words = f"{FINER}, run `jaxform adapt`, or replace solver.edge_contact by [refinement]"
    assert remedies(edge_contact=True) == [words] * 2
    assert remedies(smooth_landing=True) == [FINER] * 2
    refined = dataclasses.replace(
        scene, refinement=jaxform.make_refinement(angle=10.0, interval=1, max_level=2, elements=99)
    )
    (sentence,) = _warnings_of_penetration(result, refined, rib, scene.tools[0])
    assert "edge_contact" not in sentence and "refinement.max_level larger" in sentence
    held = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, edge_contact=True))
    bridged = [remedy_of_bridge(each) for each in (scene, held, refined)]
    assert bridged == [f"add [refinement], or {FINER}", FINER, f"{FINER}, or refinement.max_level larger"]


@pytest.mark.long
def test_sides_that_edges_of_two_tools_hold_count_for_the_tool_that_holds_them() -> None:
    """Two discs that slender pins push between their nodes; the sum is the work of both."""
    sheet = shapes.disc(radius=1.0, elements=24, symmetry="quarter")
    pin = molds.revolved(profile=[[0.0, 0.0], [0.45, 0.0], [0.45, -1.5]], segments=12)
    plugs = [_tool(pin, f"plug{k}", None, way=(0.3, 0.5)[k], low=-3.0 * k) for k in (0, 1)]
    places = np.concatenate([sheet.positions + np.array([0.0, 0.0, 3.0 * k]) for k in (0, 1)])
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(
            places,
            np.concatenate([sheet.triangles, sheet.triangles + len(sheet.positions)]),
            _SHEET,
            np.tile(sheet.clamped, 2),
            np.tile(sheet.fixed, (2, 1)),
        ),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=_END, damping=2.0, edge_contact=True),
        tools=plugs,
        fill=False,
    )
    result = jaxform.run(scene)
    assert int(np.asarray(result.held_sides)) > 0
    works = [tool["work"] for tool in summarize(result, scene)["tools"]]
    np.testing.assert_allclose(sum(works), result.energy.tool_work, rtol=1e-12)
    assert 0.0 < works[0] < works[1]
