"""Programs that `jaxform warm` compiles beforehand, and the words of `jaxform check` on them."""

from __future__ import annotations

from pathlib import Path

import pytest

from jaxform.cli import command, precompile, session
from jaxform.runs import padding
from tests import scenes


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setattr(session, "cache_folder", lambda: folder)
    monkeypatch.setattr(session, "use_compile_cache", lambda _: None)
    return folder


@pytest.mark.long
def test_what_was_compiled_beforehand_serves_other_scenes_of_the_kind(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene, other = tmp_path / "scene.toml", tmp_path / "other.toml"
    scene.write_text(scenes.FILE)
    other.write_text(scenes.FILE.replace("elements = 40", "elements = 90").replace("segments = 48", "segments = 36"))
    assert command.main(["check", str(scene)]) == 0
    assert "compiles first, for about 6 s" in capfd.readouterr().out
    assert command.main(["warm", str(scene)]) == 0
    assert "1 compiled, 0 were compiled already" in capfd.readouterr().out
    assert command.main(["warm", str(other), str(scene)]) == 0
    assert "0 compiled, 2 were compiled already" in capfd.readouterr().out
    assert command.main(["check", str(other)]) == 0
    assert "its programs are compiled already" in capfd.readouterr().out


def test_an_interruption_leaves_what_is_done(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    done: list[int] = []

    def compile(make: object, elements: int, _: object) -> bool:
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(elements)
        return len(done) % 2 == 0

    monkeypatch.setattr(precompile, "compile_kind", compile)
    assert command.main(["warm"]) == session.INTERRUPTED
    lines = capfd.readouterr().out.splitlines()
    assert "compiled already" in lines[0] and "compiled already" not in lines[1]
    assert lines[-1].startswith("interrupted; 3 of ")


def test_the_common_kinds_are_of_other_shapes_and_known_sizes() -> None:
    kinds = list(precompile.kinds())
    assert len({words for words, _, _ in kinds}) == len(kinds)
    for _, make, elements in (kinds[0], kinds[7], kinds[-1]):
        room = padding.pad_to_bucket(make(), elements).scene
        assert len(room.parison.triangles) - elements in (0, 1)


def test_without_a_folder_there_is_nothing_to_warm(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "cache_folder", lambda: None)
    assert command.main(["warm"]) == session.BAD_INPUT
    assert "XDG_CACHE_HOME" in capfd.readouterr().err


def test_a_scene_that_is_wrong_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wrong.toml").write_text("[parison]\n")
    assert command.main(["warm", str(tmp_path / "wrong.toml")]) == session.BAD_INPUT
    assert "wrong.toml" in capfd.readouterr().err
