"""Records of a sweep: nothing recorded is lost, whatever stopped the writing."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

import jaxform
from jaxform.core import disk
from jaxform.sweeps.records import EARLIER, NAME, Records, write_parquet

PATHS, MEASURES = ["mold.depth", "mold.path"], ["wall_min", "seconds"]


def _row(number: int, **more: object) -> dict[str, object]:
    said = {"design": number, "mold.depth": 0.1 * number, "mold.path": 'a "new", mold.stl', "status": "ok"}
    return said | {"wall_min": 1e-3 / 3, "seconds": 1.5, "digest": f"d{number}"} | more


def _table(folder: Path, name: str = NAME) -> list[dict[str, str]]:
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows_are_there_the_moment_they_are_written_to_the_last_bit(tmp_path: Path) -> None:
    records = Records(tmp_path, PATHS, MEASURES)
    assert _table(tmp_path) == []
    for number in (2, 1):
        records.append(_row(number))
        assert float(_table(tmp_path)[-1]["wall_min"]) == 1e-3 / 3
    assert [row["design"] for row in _table(tmp_path)] == ["2", "1"]
    assert _table(tmp_path)[0]["mold.path"] == 'a "new", mold.stl'
    rows = records.finish([(f"d{number}", {"design": number}) for number in (1, 2)])
    assert [row["design"] for row in _table(tmp_path)] == ["1", "2"] and rows == _table(tmp_path)


@pytest.mark.parametrize("kept", [0, 1, 5, 40, -1])
def test_a_row_that_was_being_written_is_cut_off(tmp_path: Path, kept: int) -> None:
    records = Records(tmp_path, PATHS, MEASURES)
    records.append(_row(1))
    whole = (tmp_path / NAME).read_bytes()
    records.append(_row(2, status="it is, as one says, broken"))
    line = (tmp_path / NAME).read_bytes()[len(whole) :]
    (tmp_path / NAME).write_bytes(whole + line[:kept])
    again = Records(tmp_path, PATHS, MEASURES, resume=True)
    assert set(again.rows) == {"d1"} and (tmp_path / NAME).read_bytes() == whole
    again.append(_row(2))
    assert set(Records(tmp_path, PATHS, MEASURES, resume=True).rows) == {"d1", "d2"}


def test_without_resume_the_table_begins_anew(tmp_path: Path) -> None:
    Records(tmp_path, PATHS, MEASURES).append(_row(1))
    assert Records(tmp_path, PATHS, MEASURES).rows == {} and _table(tmp_path) == []


def test_rows_of_designs_that_are_gone_are_kept_aside_and_the_others_are_numbered_anew(tmp_path: Path) -> None:
    records = Records(tmp_path, PATHS, MEASURES)
    for number in (1, 2, 3):
        records.append(_row(number))
    again = Records(tmp_path, PATHS, MEASURES, resume=True)
    again.keep_only({"d3": {"design": 1, "mold.depth": 0.5}})
    assert [(row["design"], row["mold.depth"], row["digest"]) for row in _table(tmp_path)] == [("1", "0.5", "d3")]
    assert [row["digest"] for row in _table(tmp_path, EARLIER)] == ["d1", "d2"]
    again.keep_only({})
    assert [row["digest"] for row in _table(tmp_path, EARLIER)] == ["d1", "d2", "d3"]


def test_a_full_disk_is_told_and_leaves_the_rows_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = Records(tmp_path, PATHS, MEASURES)
    records.append(_row(1))
    before = (tmp_path / NAME).read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(jaxform.InputError, match="--resume"):
        records.append(_row(2))
    assert (tmp_path / NAME).read_bytes() == before


def test_a_table_that_is_none_of_a_sweep_is_refused(tmp_path: Path) -> None:
    for text in ("a,b\n1,2\n", "design,status,digest\n1,ok\n", 'design,status,digest\n"1,ok,d\n"x\n'):
        (tmp_path / NAME).write_text(text)
        with pytest.raises(jaxform.InputError, match="is damaged"):
            Records(tmp_path, PATHS, MEASURES, resume=True)
        assert (tmp_path / NAME).read_text() == text


def test_what_has_no_column_gets_one(tmp_path: Path) -> None:
    records = Records(tmp_path, [], ["seconds"])
    records.append({"design": 1, "status": "ok", "seconds": 1.0, "digest": "d1"})
    records.append({"design": 2, "status": "ok", "height": 0.25, "seconds": 1.0, "digest": "d2"})
    assert [row["height"] for row in _table(tmp_path)] == ["", "0.25"]
    assert Records(tmp_path, [], ["seconds", "height"], resume=True).measures("d2")["height"] == "0.25"


def test_parquet_has_numbers_texts_and_units(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    records = Records(tmp_path, PATHS, MEASURES)
    records.append(_row(1))
    records.append(_row(2, wall_min=None, status="burst"))
    rows = list(records.rows.values())
    assert write_parquet(tmp_path, records.columns, rows, {"wall_min": "m"})
    table = parquet.read_table(tmp_path / "results.parquet")
    assert table.column("design").to_pylist() == [1, 2]
    assert table.column("wall_min").to_pylist() == [1e-3 / 3, None]
    assert table.column("mold.path").to_pylist()[0] == 'a "new", mold.stl'
    assert table.column("status").to_pylist() == ["ok", "burst"]
    assert table.schema.field("wall_min").metadata == {b"unit": b"m"}


def test_no_file_is_left_that_is_no_result(tmp_path: Path) -> None:
    records = Records(tmp_path, PATHS, MEASURES)
    records.append(_row(1))
    records.finish([("d1", {"design": 1})])
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(disk.PREFIX)]
