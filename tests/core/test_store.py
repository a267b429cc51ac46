"""Stored data are the same as newly made ones, and no fault of the files does harm."""

from __future__ import annotations

import pickle
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import serialize_executable

import jaxform
from jaxform.core import compilation, store
from jaxform.core.store import Store
from jaxform.io import files
from jaxform.runs.host import run
from jaxform.tools import molds, search
from tests.scenes import assert_same, cup, free_disc, mooney

# The runs end before the sheet reaches the cup.
pytestmark = pytest.mark.filterwarnings("ignore:nothing touched the mold")


def _same(one: object, other: object) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def _assert_same_run(result: object, expected: object) -> None:
    """But for the seconds, which are the last two."""
    pairs = zip(jax.tree.leaves(result)[:-2], jax.tree.leaves(expected)[:-2], strict=True)
    for found, wanted in pairs:
        assert_same(found, wanted)


@pytest.mark.long
def test_kept_programs_and_grids_give_the_same_run(tmp_path: Path) -> None:
    kept = Store(tmp_path)
    document = files.read_scene("dish")
    first, again = files.build(document, kept), files.build(document, kept)
    assert _same(first, jaxform.load("dish")) and _same(first, again)
    assert len(list(tmp_path.iterdir())) == 1  # the grid
    scene = cup(60, 2.0)
    plain = run(scene)
    names = set()
    for _ in range(2):
        result = run(scene, store=Store(tmp_path))
        _assert_same_run(result, plain)
        assert type(result) is jaxform.Result
        now = set(tmp_path.iterdir())
        assert not names or now == names
        names = now
    assert len(names) > 1


@pytest.mark.parametrize("content", [b"", b"not a file of ours"])
def test_a_damaged_file_is_made_anew(tmp_path: Path, content: bytes) -> None:
    kept, made = Store(tmp_path), []

    def make() -> dict[str, np.ndarray]:
        made.append(1)
        return {"x": np.arange(3)}

    @jax.jit
    def double(x: jax.Array) -> jax.Array:
        return 2 * x

    for _ in range(2):
        kept.arrays("numbers", (1, "a"), make)
        kept.program(double, jnp.ones(2))
    assert len(made) == 1
    for file in tmp_path.iterdir():
        file.write_bytes(content)
    assert np.array_equal(kept.arrays("numbers", (1, "a"), make)["x"], np.arange(3))
    assert len(made) == 2
    assert Store(tmp_path).program(double, jnp.ones(2))(jnp.ones(2)).tolist() == [2, 2]


def test_arrays_that_two_processes_want_at_once_are_made_once(tmp_path: Path) -> None:
    """The second waits for the first, which here waits a second for the second to make them as well."""
    made, begun, again = list[int](), threading.Event(), threading.Event()

    def want(number: int) -> Any:
        def make() -> dict[str, np.ndarray]:
            made.append(number)
            (begun if len(made) == 1 else again).set()
            again.wait(1.0)
            return {"number": np.array(number)}

        return Store(tmp_path / "made", shared=True).arrays("mesh", ("one",), make)

    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(want, 1)
        begun.wait()
        second = threads.submit(want, 2)
    assert made == [1]
    assert first.result() == second.result() == {"number": 1}


def test_what_differs_is_kept_apart(tmp_path: Path) -> None:
    kept = Store(tmp_path)
    for value in (1.0, 2.0):
        kept.arrays("numbers", (np.array([value]),), lambda value=value: {"x": np.array(value)})
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(TypeError):  # other shapes need another program
        kept.program(jax.jit(lambda x: x), jnp.ones(2))(jnp.ones(3))


def test_a_program_is_compiled_once_for_arguments_alike() -> None:
    traced = []

    @jax.jit
    def double(x: jax.Array) -> jax.Array:
        traced.append(x.shape)
        return 2 * x

    kept = Store()
    assert kept.program(double, jnp.ones(2)) is kept.program(double, jnp.zeros(2))
    assert kept.program(double, jnp.ones(3))(jnp.ones(3)).tolist() == [2, 2, 2]
    assert traced == [(2,), (3,)]


def test_a_kept_program_is_neither_traced_nor_compiled_again(tmp_path: Path) -> None:
    traced, x = [], jnp.arange(3.0)

    @jax.jit
    def double(x: jax.Array) -> dict[str, jax.Array]:
        traced.append(x.shape)
        return {"twice": 2 * x}

    for _ in range(3):
        shapes, soon = Store(tmp_path).start_program(double, x)
        assert shapes["twice"].shape == (3,) and shapes["twice"].dtype == x.dtype
        assert soon.result()(x)["twice"].tolist() == [0.0, 2.0, 4.0]
    assert traced == [(3,)] and len(list(tmp_path.iterdir())) == 1


def test_a_program_that_this_machine_cannot_load_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    double, x = jax.jit(lambda x: 2 * x), jnp.arange(3.0)
    Store(tmp_path).program(double, x)

    def load(*_: object, **__: object) -> None:
        raise RuntimeError("made for another processor")

    monkeypatch.setattr(serialize_executable, "deserialize_and_load", load)
    assert Store(tmp_path).program(double, x)(x).tolist() == [0.0, 2.0, 4.0]
    known = Store(tmp_path)
    known.program(double, x)
    known.record_programs("a scene")
    ahead = Store(tmp_path)
    ahead.preload("a scene")
    assert ahead.program(double, x)(x).tolist() == [0.0, 2.0, 4.0]


@pytest.mark.parametrize("subject", ["a scene", "one that was never run"])
def test_what_a_scene_took_is_loaded_before_it_is_asked_for(
    subject: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @jax.jit
    def many(x: jax.Array, tree: dict[str, jax.Array]) -> dict[str, Any]:
        return {"sum": x + tree["b"], "pair": (tree["a"], 2 * x)}

    arguments = jnp.arange(3.0), {"a": jnp.ones(2), "b": jnp.ones(())}
    first = Store(tmp_path)
    expected = first.program(many, *arguments)(*arguments)
    first.record_programs("a scene")
    ahead = Store(tmp_path)
    ahead.preload(subject)
    assert ahead._ahead is not None and len(ahead._ahead.result()) == 1
    monkeypatch.setattr(store, "deserialize_program", lambda _: pytest.fail("it was loaded already"))
    found = ahead.program(many, *arguments)(*arguments)
    assert jax.tree.structure(found) == jax.tree.structure(expected) and _same(found, expected)
    assert ahead.program(many, *arguments) is ahead.program(many, *arguments)


def test_of_many_scenes_the_latest_are_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_MOST_SUBJECTS", 3)
    for number in range(5):
        kept = Store(tmp_path)
        kept.program(jax.jit(lambda x, n=number: x + n), jnp.ones(1))
        kept._taken = {f"program-{number}": None}
        kept.record_programs(f"scene {number}")
    again = Store(tmp_path)
    assert again._recent_names() == {f"scene {number}": [f"program-{number}"] for number in (2, 3, 4)}
    again._taken = {"program-2": None}
    again.record_programs("scene 2")
    assert [*again._recent_names()] == ["scene 3", "scene 4", "scene 2"]


def test_what_is_foreseen_wrongly_does_no_harm(tmp_path: Path) -> None:
    """Names of files that are damaged, or no more, or not in the folder; and no names at all."""
    double, x = jax.jit(lambda x: 2 * x), jnp.arange(3.0)
    outside = tmp_path / "outside"
    outside.write_bytes(b"none of ours")
    for names in (["gone"], ["../outside"], [str(outside)], [], [""]):
        kept = Store(tmp_path / "kept")
        kept.program(double, x)
        kept._taken |= dict.fromkeys(names)
        kept.record_programs("a scene")
        for file in (tmp_path / "kept").iterdir():
            if not file.name.startswith("lately"):
                file.write_bytes(b"")
        ahead = Store(tmp_path / "kept")
        ahead.preload("a scene")
        assert ahead._ahead is not None and ahead._ahead.result() == {}
        assert ahead.program(double, x)(x).tolist() == [0.0, 2.0, 4.0]
    for content in (b"no JSON", b"[1, 2]", b'{"a scene": 3}', b'{"a scene": [3]}'):
        other = Store(tmp_path / "kept")
        other._write(tmp_path / "kept" / store._recent_names_file(), content)
        other.preload("a scene")
        assert other.program(double, x)(x).tolist() == [0.0, 2.0, 4.0]
        other.record_programs("a scene")
    nowhere = Store()
    nowhere.preload("a scene")
    nowhere.program(double, x)
    nowhere.record_programs("a scene")


def test_what_another_version_wrote_is_not_read() -> None:
    assert store.deserialize_program(b"") is None
    assert store.deserialize_program(zlib.compress(pickle.dumps("a program of tomorrow"))) is None


@pytest.mark.long
def test_programs_go_before_they_are_too_many_for_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "_CROWDED", 1.0)  # whatever other tests have compiled in this process
    kept, scene = Store(), cup(60, 2.0)
    plain = run(scene, store=kept)
    assert len(kept._programs) > 1 and not compilation.exceeds_program_limit()
    monkeypatch.setattr(compilation, "_CROWDED", 0.0)
    if not compilation.exceeds_program_limit():
        pytest.skip("only Linux tells how many mappings a process has")
    run(free_disc(60, 0.5, mooney(0.1), end_time=2.0), store=kept)
    assert len(kept._programs) == 1  # all but the last one made
    _assert_same_run(run(scene, store=kept), plain)


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    kept = Store(tmp_path / "file" / "folder")
    assert kept.arrays("numbers", (), lambda: {"x": np.arange(2)})["x"].tolist() == [0, 1]


def test_the_folder_does_not_grow_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_MOST_BYTES", 10_000)
    kept = Store(tmp_path)
    for key in range(12):
        kept.arrays("numbers", (key,), lambda: {"x": np.random.default_rng(0).uniform(size=200)})
    assert 5_000 < sum(file.stat().st_size for file in tmp_path.iterdir()) <= 10_000


def test_search_grids_of_several_fine_molds_find_place_beside_the_programs(tmp_path: Path) -> None:
    """Each of 100 000 triangles would take 60 to 100 MB of the folder's 300, and the next would push it out."""
    profile = [[0.0, 0.08], [0.07, 0.08], [0.0975, 0.0], [0.1, 0.0], [0.072, 0.083], [0.0, 0.083]]
    shape, kept = molds.revolved(profile=profile, segments=1000), Store(tmp_path)
    plain = search.build_grid(shape.vertices, shape.triangles, 0.002)
    made = search.build_grid(shape.vertices, shape.triangles, 0.002, kept)
    found = search.build_grid(shape.vertices, shape.triangles, 0.002, Store(tmp_path))
    assert _same(made, plain) and _same(found, plain)
    lists = sum(np.asarray(getattr(plain, name)).nbytes for name in ("bound", "start", "ends", "listed"))
    assert lists > 1_000_000
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 0.25 * lists


def test_a_changed_byte_anywhere_in_the_package_is_other_source(tmp_path: Path) -> None:
    inside = tmp_path / "laws" / "viscous"
    inside.mkdir(parents=True)
    (tmp_path / "a.py").write_text("x = 1\n")
    (inside / "b.py").write_text("y = 1\n")
    before = store._source_digest(tmp_path)
    (inside / "b.py").write_text("y = 2\n")
    changed = store._source_digest(tmp_path)
    (inside / "b.py").rename(tmp_path / "b.py")
    moved = store._source_digest(tmp_path)
    assert (store.PACKAGE / "__init__.pyi").exists() and (store.PACKAGE / "dynamics" / "step.py").exists()
    (tmp_path / "notes.txt").write_text("not source")
    assert len({before, changed, moved}) == 3 and store._source_digest(tmp_path) == moved
