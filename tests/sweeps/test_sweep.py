"""`jaxform.sweep`: a function of the user's own, of scenes, names and designs."""

from __future__ import annotations

import csv
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxform
from jaxform.io import files
from tests import scenes


def describe(scene: jaxform.Scene) -> dict[str, float]:
    """Facts of a built scene, without a simulation; zero damping fails."""
    if scene.solver.damping is not None and float(scene.solver.damping) == 50.0:
        raise ZeroDivisionError("as asked for")
    depth = float(np.asarray(scene.mold.vertices)[:, 2].max()) if scene.mold is not None else 0.0
    return {"depth": depth, "c": float(np.asarray(vars(scene.material)["c"]).max())}


def of_each_type(scene: jaxform.Scene) -> dict[str, Any]:
    return {"count": 3, "whole": 2.0, "good": scene.mold is not None, "word": "cup"}


def same(scene: jaxform.Scene) -> bytes:
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(scene))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(scenes.FILE)
    return path


DESIGNS: list[dict[str, Any]] = [
    {"mold.profile[0][1]": 0.06, "mold.profile[1][1]": 0.06},
    {"material.c": 3e5},
    {"material.c": -1.0},
    {"solver.damping": 50.0},
]


def test_designs_and_files_are_built_and_scenes_are_sent(scene: Path) -> None:
    loaded = jaxform.load(scene)
    found = jaxform.sweep([*DESIGNS, scene, loaded], describe, scene=scene, workers=2)
    values = [outcome.value for outcome in found]
    assert values[:2] == [{"depth": 0.06, "c": 2e5}, {"depth": 0.05, "c": 3e5}]
    assert values[2:4] == [None, None] and values[4:] == [{"depth": 0.05, "c": 2e5}] * 2
    assert found[2].status.startswith("material.c = -1.0") and found[3].status == "ZeroDivisionError: as asked for"
    assert [outcome.status for outcome in found if outcome.value] == ["ok"] * 4


@pytest.mark.long
def test_a_scene_comes_to_a_worker_with_the_same_bits(scene: Path) -> None:
    loaded = jaxform.load(scene)
    (found,) = jaxform.sweep([loaded], same, workers=1)
    assert found.value == same(loaded)
    document = files.read_scene(scene)
    assert pickle.loads(pickle.dumps(document)) == document


def test_an_executor_of_the_users_own_does_and_stays_open(scene: Path) -> None:
    seen: list[int] = []
    with ThreadPoolExecutor(2) as executor:
        for _ in range(2):
            found = jaxform.sweep(
                DESIGNS, describe, scene=scene, executor=executor, on_outcome=lambda place, _: seen.append(place)
            )
    assert sorted(seen) == [0, 0, 1, 1, 2, 2, 3, 3] and found[1].value == {"depth": 0.05, "c": 3e5}


def test_outcomes_are_recorded_and_read_again(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with ThreadPoolExecutor(2) as executor:
        options: dict[str, Any] = {"scene": scene, "executor": executor, "out": out}
        first = jaxform.sweep(DESIGNS[:3], describe, **options)
        computed: list[int] = []

        def note(place: int, outcome: jaxform.Outcome) -> None:
            computed.append(place)

        more = jaxform.sweep([*DESIGNS, {"material.c": 4e5}], describe, resume=True, on_outcome=note, **options)
        assert more[:3] == first and more[4].value == {"depth": 0.05, "c": 4e5}
        with (out / "results.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["design"] for row in rows] == ["1", "2", "3", "4", "5"]
        assert [row["depth"] for row in rows] == ["0.06", "0.05", "", "", "0.05"]
        assert [row["seconds"] for row in rows[:2]] == [repr(outcome.seconds) for outcome in first[:2]]
        anew = jaxform.sweep(DESIGNS[:1], describe, **options)
        assert anew[0].seconds != first[0].seconds


def test_values_have_the_types_that_they_were_recorded_with(scene: Path, tmp_path: Path) -> None:
    """A whole number came back as 3.0, and True as a text."""
    with ThreadPoolExecutor(1) as executor:
        options: dict[str, Any] = {"scene": scene, "executor": executor, "out": tmp_path / "out"}
        first, again = (jaxform.sweep(DESIGNS[:1], of_each_type, resume=resume, **options) for resume in (False, True))
    assert again == first and first[0].seconds == again[0].seconds
    assert [type(value) for value in again[0].value.values()] == [int, float, bool, str]


def test_the_default_is_the_row_of_the_command(scene: Path) -> None:
    with ThreadPoolExecutor(1) as executor:
        (found,) = jaxform.sweep([scene], executor=executor)
    result = jaxform.run(jaxform.load(scene))
    summary = jaxform.summarize(result, jaxform.load(scene))
    assert found.status == "ok" and found.value["wall_min"] == summary["thickness"]["min"]
    assert found.value["mass"] == summary["mass"] and found.value["flash_mass"] is None


@pytest.mark.parametrize(
    ("designs", "function", "options", "words"),
    [
        ([], describe, {}, "is empty"),
        ([3], describe, {}, r"scenes_or_designs\[0\] = 3: is neither a scene"),
        ([{"material.c": 1.0}], describe, {}, "name one with --scene"),
        (["dish-coarse"], lambda scene: 0, {}, "cannot be sent to another process"),
        (["dish-coarse"], 3, {}, "is not a function"),
        (["dish-coarse"], describe, {"workers": 0}, "must be a positive whole number"),
        (["dish-coarse"], describe, {"executor": 3}, "is not an executor"),
        ([{"material..c": 1.0}], describe, {"scene": "dish-coarse"}, "is not a path"),
    ],
)
def test_bad_input_is_named(designs: Any, function: Any, options: dict[str, Any], words: str) -> None:
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.sweep(designs, function, **options)
