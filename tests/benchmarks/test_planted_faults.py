"""Faults that are planted to try the tests: each can be planted, and is another program."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks import planted_faults


@pytest.mark.parametrize("fault", planted_faults.FAULTS, ids=lambda fault: f"{Path(fault.file).stem}: {fault.wrong}")
def test_a_fault_stands_in_a_file_once_and_leaves_it_readable(fault: planted_faults.Fault, tmp_path: Path) -> None:
    (tmp_path / fault.file).parent.mkdir(parents=True)
    right = (planted_faults.ROOT / fault.file).read_text(encoding="utf-8")
    (tmp_path / fault.file).write_text(right, encoding="utf-8")
    planted_faults.plant(fault, tmp_path)
    wrong = (tmp_path / fault.file).read_text(encoding="utf-8")
    assert ast.dump(ast.parse(wrong)) != ast.dump(ast.parse(right))
    assert fault.area in planted_faults.TESTS


def test_what_is_asked_is_there() -> None:
    for tests in planted_faults.TESTS.values():
        assert all((planted_faults.ROOT / path).exists() for path in tests)


def test_a_line_that_is_gone_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\nx = 1\n")
    for right in ("x = 1", "y"):
        with pytest.raises(ValueError, match=r"a\.py.*not once"):
            planted_faults.plant(planted_faults.Fault("step", "a.py", right, "x = 2"), tmp_path)
