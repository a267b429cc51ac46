"""The benchmark's own code, in small: the peers step alike, the tables fill, the pictures are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import jaxform
from benchmarks.accuracy import refinement
from benchmarks.speed import bench, bowl, formulations, peers, pictures, sheets


@pytest.mark.long
def test_every_formulation_and_peer_steps_alike() -> None:
    sheet = sheets.sheet(200)
    expected = peers.with_numpy(sheet)(20)
    assert np.abs(expected - sheet.positions).max() > 1e-3
    steppers = {"C++": peers.cpp(sheet), "numba": peers.with_numba(sheet)}
    for name, step in steppers.items():
        if step is not None:
            np.testing.assert_allclose(step(20), expected, rtol=0, atol=1e-13, err_msg=name)
    ways = {name: formulations.stepper(build(sheet), sheet) for name, build in formulations.LOSERS.items()}
    ways |= {f"blocks of {block}": formulations.own_formulation(sheet, block=block) for block in (64, 128)}
    ways["one by one"] = formulations.own_formulation(sheet, paired=False)
    for name, step in ways.items():
        np.testing.assert_allclose(np.asarray(step(20)).T, expected, rtol=0, atol=1e-13, err_msg=name)
    single = np.asarray(formulations.own_formulation(sheet, np.float32)(20)).T
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, rtol=0, atol=1e-5)


def test_the_bowl_in_plain_cpp_is_the_same_part() -> None:
    scene = bowl.bowl(0.01)
    result = jaxform.run(scene)
    assert result.schedule is not None
    run = bowl.cpp_run(scene, result.schedule)
    if run is None:
        pytest.skip("no C++ compiler")
    positions, moved = run()
    np.testing.assert_allclose(positions, result.positions, rtol=0, atol=1e-9)
    # Elements are dropped where all of their nodes stick, and most do at last.
    assert 0.3 < moved / (int(result.steps) * len(scene.parison.triangles)) < 0.8


@pytest.mark.long
def test_the_bowl_s_table_adds_up_to_its_run() -> None:
    row, *table, total = bowl.show_bowl(0.01, 1)
    assert row["rms difference m"] is None or row["rms difference m"] < 1e-9
    assert total["ms"] == pytest.approx(row["run ms"]) == pytest.approx(sum(part["ms"] for part in table))
    scene = bowl.bowl(0.01)
    windows = bowl.record_windows(scene)
    schedule = jaxform.run(scene).schedule
    assert schedule is not None
    taken = np.asarray(schedule.counts) > 0
    np.testing.assert_array_equal(windows.counts, np.asarray(schedule.counts)[taken])
    np.testing.assert_array_equal(windows.lengths, np.asarray(schedule.lengths)[taken])


@pytest.mark.long
def test_the_tables_fill_and_the_pictures_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "_WORK", 2000)
    found = {"bare": bench.show_bare((50, 128))}
    scene = bench.free_sheet(100, 128)
    found["gradients"] = [bench.gradient_cost(scene, forward_mode=True)]
    found["memory"] = found["gradients"]
    found["skips"] = [
        {"scene": "one", "switched": "all", "seconds": 1.0},
        {"scene": "one", "switched": "no skip_far", "seconds": 2.0},
    ]
    row = found["gradients"][0]
    assert abs(row["steps"] - 128) < 40
    assert row["value and gradient"] > row["run"] > 0
    pictures.draw(found, tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"bare.png", "gradients.png", "memory.png", "skips.png"}


@pytest.mark.long
def test_the_share_of_moving_elements_is_counted() -> None:
    from tests import scenes

    scene = scenes.cup()
    moved, steps = bench.moving_share(scene)
    assert 0.1 * steps * len(scene.parison.triangles) < moved < steps * len(scene.parison.triangles)


@pytest.mark.long
def test_refinement_s_table_has_a_row_per_case(tmp_path: Path) -> None:
    cases = [{"elements": 27, "angle": angle, "max_level": 2} for angle in (80.0, 8.0)]
    rows = refinement.curve(refinement.dish, refinement.exact_dish, cases)
    assert [row["status"] for row in rows] == ["ok", "ok"]
    assert rows[0]["final"] == 26 < rows[1]["final"] and rows[1]["error"] < rows[0]["error"]
    refinement.draw({"dish": rows}, tmp_path)
    assert (tmp_path / "refinement-error.png").stat().st_size > 10_000
