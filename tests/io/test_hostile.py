"""Whatever is given: one line and exit status 2; no traceback, no hang, no memory without bounds, nothing lost."""

from __future__ import annotations

import errno
import os
import pwd
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaxform
from benchmarks.hostile import fuzz
from jaxform import molds, shapes
from jaxform.cli import command, session
from jaxform.core import disk, errors
from jaxform.core.errors import InputError, InputWarning
from jaxform.core.store import Store
from jaxform.io import catalog
from jaxform.io.output import Frames
from tests import scenes

pytestmark = pytest.mark.quick


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "cache_folder", lambda: None)


def _assert_refused(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert command.main(list(arguments)) == 2
    printed = capfd.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1, printed.err
    assert len(printed.err) < 3000
    return printed.err


TEXTS = {
    "a = " + "1" * 5000: "too many digits",
    "a = 0x" + "f" * 50_000: "a: has a number with too many digits",
    "a = 9223372036854775808": "64 bits",
    ".".join(["a"] * 100_000) + " = 1": "dotted key of more than",
    "[" + ".".join(['"a b"'] * 100_000) + "]": "dotted key of more than",
    "a = { b = 1, " + "c." * 100_000 + "d = 1}": "dotted key of more than",
    "a = " + "[" * 100_000: "nested too deeply",
    "a" * 1_000_000: "not valid TOML",
    "k" * 1_000_000 + " = 1": "is not a valid key here",
    "\x00": "not valid TOML",
    "\x85 = 1": "not valid TOML",
}


@pytest.mark.parametrize("text", TEXTS, ids=range(len(TEXTS)))
def test_a_hostile_scene_file_is_refused_soon(tmp_path: Path, capfd: pytest.CaptureFixture[str], text: str) -> None:
    (tmp_path / "scene.toml").write_text(text)
    begin = time.process_time()
    line = _assert_refused(capfd, "check", str(tmp_path / "scene.toml"))
    assert time.process_time() - begin < 5
    assert TEXTS[text] in line and "scene.toml" in line


def test_words_with_dots_are_no_dotted_key(tmp_path: Path) -> None:
    text = 'description = "' + "a. b.c " * 1000 + '"\n[parison.x]\n'
    (tmp_path / "scene.toml").write_text(text)
    assert catalog.read(tmp_path / "scene.toml", "scene")[2]["parison"] == {"x": {}}


def test_bytes_that_are_no_text(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.toml").write_bytes(b"\xff\xfe")
    assert "UTF-8" in _assert_refused(capfd, "check", str(tmp_path / "scene.toml"))


NAMES = ["a" * 5000, "a\0b", "~nosuch/x.toml", "/dev/zero", "../" * 3000, "/", "", "pipe.toml", "\udcff.toml"]


@pytest.mark.parametrize("name", NAMES)
def test_hostile_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo(tmp_path / "pipe.toml")
    _assert_refused(capfd, "check", name)
    mold = scenes.FILE[scenes.FILE.index('shape = "revolved"') : scenes.FILE.index("[solver]")]
    if name.isprintable():
        stl = name.replace("toml", "stl")
        (tmp_path / "scene.toml").write_text(scenes.FILE.replace(mold, f'shape = "file"\npath = "{stl}"\n'))
        assert "mold.path" in _assert_refused(capfd, "check", "scene.toml")
    (tmp_path / "good.toml").write_text(scenes.FILE)
    if name not in ("", "/", "../" * 3000, "\udcff.toml", "~nosuch/x.toml"):
        assert "--out" in _assert_refused(capfd, "simulate", "good.toml", "--out", name)


def _homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_: int) -> None:
        raise KeyError

    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)


def test_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    _homeless(monkeypatch)
    assert disk.user_cache_folder() is None
    assert "home" in _assert_refused(capfd, "check", "~/scene.toml")


NUMBERS = [
    ("[0.1, 0.0]", "[1e300, 0.0]", "mold.profile[2][0]"),
    ("[0.1, 0.0]", "[1e7, 0.0]", "mold.profile[2][0]"),
    ("radius = 0.1", "radius = 1e300", "parison.radius"),
    ("density = 1000.0", "density = 1e300", "material.density"),
    ("density = 1000.0", "density = 1e-300", "material.density"),
    ("thickness = 1.0e-3", "thickness = 1e-310", "parison.thickness"),
    ("[0.0, 2.0e4]", "[0.0, -1e300]", "pressure.value[1]"),
    ("segments = 48", "segments = 9000000000000000000", "mold.segments"),
    ("elements = 40", "elements = 9000000000000000000", "parison.elements"),
    ("[solver]", "[output]\nframes = 9000000000000000000\n[solver]", "output.frames"),
]


@pytest.mark.parametrize(("old", "new", "key"), NUMBERS)
def test_numbers_that_nothing_can_be_computed_with(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], old: str, new: str, key: str
) -> None:
    assert old in scenes.FILE
    (tmp_path / "scene.toml").write_text(scenes.FILE.replace(old, new, 1))
    assert f"{key} = " in _assert_refused(capfd, "check", str(tmp_path / "scene.toml"))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/final.vtu"),
            "out/final.vtu: No space left on device",
        ),
        (
            FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "out/x"),
            "out/x: No such file or directory; it or its folder",
        ),
        (OSError("odd\nwords"), "odd words; check"),
        (MemoryError(), "not enough memory"),
        (RecursionError(), "nested too deeply"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes"), "not enough memory"),
    ],
)
def test_what_the_machine_refuses_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    def fail(_: object) -> int:
        raise error

    monkeypatch.setattr(command, "_scenes", fail)
    assert words in _assert_refused(capfd, "scenes")


def test_a_mistake_of_the_program_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (RuntimeError("no such thing"), KeyError("x"), ValueError("y")):
        assert errors.describe_system_error(error) is None

        def fail(_: object, error: Exception = error) -> int:
            raise error

        monkeypatch.setattr(command, "_scenes", fail)
        with pytest.raises(type(error)):
            command.main(["scenes"])


def test_a_full_disk_for_people_who_read(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(session, "say", full)
    assert "No space left" in _assert_refused(capfd, "scenes")


def test_frames_that_cannot_be_written_lose_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "frames").write_text("in the way")
    frames = Frames(tmp_path, 3)

    class Moment:
        time, end_time = 0.0, 1.0

        def result(self) -> None:
            return None

    for _ in range(3):
        frames.offer(scenes.cup(60, 2.0), Moment())  # type: ignore[arg-type]
    with pytest.raises(OSError):
        frames.finish(scenes.cup(60, 2.0), None)  # type: ignore[arg-type]


def test_a_cache_that_others_can_write_to_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = os.umask(0)
    try:
        folder = disk.user_cache_folder()
    finally:
        os.umask(before)
    assert folder is not None and folder == tmp_path / "jaxform"
    for place in (folder, folder / "made", folder / "compiled"):
        assert place.stat().st_mode & 0o077 == 0
    for place, mode in ((folder, 0o770), (folder / "compiled", 0o707), (folder / "made", 0o720)):
        place.chmod(mode)
        with pytest.warns(InputWarning, match="other users own it or can write to it"):
            assert disk.user_cache_folder() is None
        place.chmod(0o755)
        assert disk.user_cache_folder() == folder
    real = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: real + 1)
    with pytest.warns(InputWarning, match="other users own it"):
        assert disk.user_cache_folder() is None


def test_a_relative_cache_folder_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert disk.user_cache_folder() == tmp_path / "home" / ".cache" / "jaxform"


def test_kept_files_that_were_swapped_are_made_anew(tmp_path: Path) -> None:
    kept = Store(tmp_path)
    for key in (1, 2):
        kept.arrays("numbers", (key,), lambda key=key: {"x": np.full(3, key)})
    one, two = sorted(tmp_path.iterdir())
    first, second = one.read_bytes(), two.read_bytes()
    one.write_bytes(second)
    two.write_bytes(first)
    for key in (1, 2):
        for _ in range(2):
            assert kept.arrays("numbers", (key,), lambda key=key: {"x": np.full(3, key)})["x"].tolist() == [key] * 3
    assert {path.read_bytes() for path in (one, two)} == {first, second}


def test_compiled_programs_that_were_swapped_or_changed_are_removed(tmp_path: Path) -> None:
    names = ["a-cache", "b-cache", "c-cache", "d-cache"]
    with disk.guard_folder(tmp_path):
        for number, name in enumerate(names):
            (tmp_path / name).write_text("x" * (1 + number))
    (tmp_path / "a-cache").rename(tmp_path / "spare")
    (tmp_path / "b-cache").rename(tmp_path / "a-cache")
    (tmp_path / "spare").rename(tmp_path / "b-cache")
    (tmp_path / "c-cache").write_text("cut")
    (tmp_path / "new-cache").write_text("of a run that was killed")
    os.utime(tmp_path / "c-cache", ns=(0, 0))
    with disk.guard_folder(tmp_path):
        assert sorted(path.name for path in tmp_path.glob("*-cache")) == ["d-cache", "new-cache"]


@pytest.mark.parametrize("damaged", ["[" * 100_000, "{}", "", "changed"])
def test_where_the_record_of_programs_is_damaged_none_of_them_is_believed(damaged: str, tmp_path: Path) -> None:
    record = tmp_path / "record.json"
    with disk.guard_folder(tmp_path):
        (tmp_path / "a-cache").write_text("x")
    with disk.guard_folder(tmp_path):
        assert (tmp_path / "a-cache").exists()
    record.write_text(record.read_text().replace("a-cache", "b-cache") if damaged == "changed" else damaged)
    with disk.guard_folder(tmp_path):
        assert not (tmp_path / "a-cache").exists()


def test_a_file_that_is_large_or_grows_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(10_000_000_000)
    with pytest.raises(InputError, match="is too large"):
        disk.read_bytes(path, disk.MOST_MESH)
    with pytest.raises(InputError, match="is a device"):
        disk.read_bytes(Path("/dev/zero"), disk.MOST_MESH)


@pytest.mark.parametrize("kind", ["files", "meshes"])
def test_a_few_of_the_damaged_inputs_of_the_benchmark(kind: str) -> None:
    found = [fuzz.run_case(kind, number) for number in range(40) if number % 20]
    assert not [case for case in found if fuzz.faults(case)]
    assert sum(case["status"] == 2 for case in found) > 10


def test_a_mold_a_million_times_the_sheet_is_refused_before_anything_is_divided_by_zero() -> None:
    sheet = shapes.rectangle(size=[0.1, 0.2], element_size=0.03)
    box = molds.box_insert(size=[0.1, 1e6], depth=0.05, insert_size=[0.03, 0.05], insert_height=0.02)
    with pytest.raises(InputError, match="cannot be projected onto it"):
        jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
            material=scenes.mooney(0.1, 2e5),
            pressure=jaxform.make_pressure([0.0, 0.2], [0.0, 2e4]),
            solver=jaxform.make_solver(end_time=0.05),
            mold=jaxform.make_mold(box.vertices, box.triangles),
        )


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "free disk space, then go on"),
        (errno.EFBIG, "raise the limit on the size of files (ulimit -f), then go on"),
        (errno.EROFS, "make it and its folder writable, then go on"),
    ],
)
def test_the_remedy_of_a_file_that_cannot_be_written_follows_from_the_reason(number: int, words: str) -> None:
    error = disk.write_error("out/x", OSError(number, os.strerror(number)), "then go on")
    assert error.remedy == words


def test_a_limit_on_the_size_of_files_is_told_as_such(tmp_path: Path) -> None:
    """In a process of its own: of 5000 bytes the system writes 4096, and says why with the rest."""
    code = """
import resource, signal, sys
from pathlib import Path
from jaxform.core.disk import write_all
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
with Path(sys.argv[1]).open("wb", buffering=0) as file:
    try:
        write_all(file, b"x" * 5000)
    except OSError as error:
        print(error.strerror)
"""
    said = subprocess.run([sys.executable, "-c", code, str(tmp_path / "x")], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == os.strerror(errno.EFBIG) and (tmp_path / "x").stat().st_size == 4096
