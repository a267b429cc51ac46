"""Material models of a user's own in scene files: declared once, in one Python file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxform
from jaxform.cli import command
from jaxform.io import files, schema
from jaxform.io.scene_rewriting import keep_scene, write_scene
from jaxform.materials import LAWS
from tests import scenes
from tests.scenes import real

_MODEL = '''
from __future__ import annotations
import jax
import jaxform


@jaxform.law(model="{name}")
class {cls}(jaxform.Law):
    """W = a (I1 - 3) + b (I1 - 3)^2.

    Attributes:
        a: Half the shear modulus [Pa].
        b: Coefficient of the square [Pa].
        density: Mass per volume [kg/m^3].
    """

    a: jax.Array = jaxform.parameter("Pa", above=0.0)
    b: jax.Array = jaxform.parameter("Pa", least=0.0, file_default={default})
    density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

    def energy(self, i1, i2):
        return {factor} * self.a * (i1 - 3.0) + self.b * (i1 - 3.0) ** 2
'''
_OLD = 'model = "mooney-rivlin"\nc = 0.2e6\nalpha = 0.1\n'
_NEW = 'model = "square"\nmodel_file = "square.py"\na = 0.2e6\n'


@pytest.fixture(autouse=True)
def _registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = dict(LAWS)
    yield
    LAWS.clear()
    LAWS.update(before)


def _write(folder: Path, material: str = _NEW, name: str = "square", **options: object) -> Path:
    given = {"name": name, "cls": name.capitalize(), "default": "1.0e3", "factor": "1.0"} | options
    (folder / "square.py").write_text(_MODEL.format(**given))
    path = folder / "scene.toml"
    assert _OLD in scenes.FILE
    path.write_text(scenes.FILE.replace(_OLD, material))
    return path


def _message(path: Path) -> str:
    with pytest.raises(jaxform.InputError) as caught:
        jaxform.load(path)
    return str(caught.value)


def test_a_file_declares_a_model_for_a_scene(tmp_path: Path) -> None:
    law = jaxform.load(_write(tmp_path)).material
    assert type(law).__name__ == "Square" and float(law.density) == 1000.0  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose([float(getattr(law, name)) for name in "ab"], [0.2e6, 1.0e3], rtol=1e-12)
    (tmp_path / "scene.toml").write_text(
        scenes.FILE.replace(_OLD, _NEW + 'b = { along = "radius", at = [0.0, 0.1], value = [1e3, 3e3] }\n')
    )
    zoned = jaxform.load(tmp_path / "scene.toml")
    radius = np.linalg.norm(np.asarray(zoned.parison.positions)[:, :2], axis=1)
    np.testing.assert_allclose(zoned.material.zones["b"], 1e3 + 2e3 * radius / 0.1, rtol=1e-9)


def test_the_same_text_is_the_same_class_and_another_text_another(tmp_path: Path) -> None:
    first = type(jaxform.load(_write(tmp_path)).material)
    assert type(jaxform.load(_write(tmp_path)).material) is first
    document = files.read_scene(tmp_path / "scene.toml")
    changed = jaxform.load(_write(tmp_path, factor="2.0")).material
    assert type(changed) is not first
    one = real(4.0)
    assert float(changed.energy(one, one)) == pytest.approx(2.0 * 0.2e6 + 1.0e3)
    # A scene that was read before is built with the model that it was read with.
    assert type(files.build(document).material) is first


def test_keys_and_ranges_of_a_scene_file_are_those_that_the_class_declares(tmp_path: Path) -> None:
    assert "material.a = -1.0: is too small" in _message(_write(tmp_path, _NEW.replace("0.2e6", "-1.0")))
    assert "material.a: is missing" in _message(_write(tmp_path, _NEW.replace("a = 0.2e6\n", "")))
    assert "material.c: is " in _message(_write(tmp_path, _NEW + "c = 1.0\n"))
    assert "material.b: is missing" in _message(_write(tmp_path, default="None"))
    table = schema.material_table("square", LAWS["square"])
    assert table.__doc__ == LAWS["square"].__doc__ and {"a", "b", "density", "model"} < set(table.model_fields)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", "declares no material model"),
        ("import jaxform\nraise ValueError('no')\n", r"cannot be run \(ValueError in line 2: no\)"),
        ("def f(:\n", r"cannot be run \(SyntaxError in line 1"),
        ("raise SystemExit(3)\n", r"cannot be run \(SystemExit in line 1: 3\)"),
        (_MODEL.format(name="gent", cls="Gent", default=0.0, factor=1.0), "name of a built-in material model"),
        (_MODEL.format(name="My Law", cls="Mine", default=0.0, factor=1.0), "not a name of a material model"),
        (
            _MODEL.format(name="s", cls="S", default=0.0, factor=1.0).replace(" b: jax", " viscous: jax"),
            "key of .material",
        ),
    ],
)
def test_a_file_that_declares_no_model_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path, before = _write(tmp_path), dict(LAWS)
    (tmp_path / "square.py").write_text(text)
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(path)
    assert before == LAWS


def test_a_missing_file_is_refused_with_its_key(tmp_path: Path) -> None:
    path = _write(tmp_path)
    (tmp_path / "square.py").unlink()
    assert "material.model_file" in (text := _message(path)) and "does not exist" in text
    path.write_text(scenes.FILE.replace(_OLD, _NEW.replace('model_file = "square.py"\n', "")))
    assert "material.model = 'square': is unknown; use " in _message(path)


def test_a_registered_model_needs_no_file(tmp_path: Path) -> None:
    @jaxform.law(model="own-square")
    class Own(jaxform.Law):
        a: jax.Array = jaxform.parameter("Pa", above=0.0)
        density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

        def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
            return self.a * (i1 - 3.0)

    path = _write(tmp_path, 'model = "own-square"\na = 0.2e6\n')
    assert type(jaxform.load(path).material) is Own
    made = jaxform.scenes.dish(elements=60, material={"model": "own-square", "a": 1e5})
    assert type(made.material) is Own and float(made.material.a) == 1e5
    assert float(Own(real(2.0), real(1.0)).energy(real(4.0), real(4.0))) == 2.0


def test_a_scene_that_is_written_elsewhere_finds_its_model(tmp_path: Path) -> None:
    document = files.read_scene(_write(tmp_path))
    for name in ("best", "kept"):
        (tmp_path / name).mkdir()
    best = write_scene(document, {"material.a": 3e5}, tmp_path / "best")
    kept = keep_scene(document, tmp_path / "kept")
    assert float(jaxform.load(best).material.a) == 3e5  # pyright: ignore[reportAttributeAccessIssue]
    assert float(jaxform.load(kept).material.a) == 2e5  # pyright: ignore[reportAttributeAccessIssue]


def test_the_command_fits_a_model_of_a_file(tmp_path: Path) -> None:
    path = _write(tmp_path)
    stretch = np.linspace(1.1, 2.0, 12)
    invariant = stretch**2 + 2.0 / stretch - 3.0
    stress = 2.0 * (stretch - stretch**-2) * (1.5e5 + 2.0 * 2.0e4 * invariant)
    rows = "\n".join(f"{x},{y}" for x, y in zip(stretch, stress, strict=True))
    (tmp_path / "uniaxial.csv").write_text(f"stretch,stress\n{rows}\n")
    words = ["fit", str(tmp_path / "uniaxial.csv"), "--model", "square", "--quiet", "--out", str(tmp_path / "out")]
    assert command.main(words) == 2
    assert command.main([*words, "--model-file", str(tmp_path / "square.py")]) == 0
    found = {row["name"]: row["value"] for row in json.loads((tmp_path / "out/summary.json").read_text())["numbers"]}
    np.testing.assert_allclose([found["a"], found["b"]], [1.5e5, 2.0e4], rtol=1e-6)
    path.write_text(
        scenes.FILE.replace("[material]\n" + _OLD + "density = 1000.0\n", (tmp_path / "out/material.toml").read_text())
    )
    assert float(jaxform.load(path).material.a) == pytest.approx(1.5e5)  # pyright: ignore[reportAttributeAccessIssue]


def test_models_say_whether_they_depend_on_the_second_invariant() -> None:
    found = {
        jaxform.NeoHookean(real(1.0), real(1.0)).depends_on_second_invariant,
        jaxform.Gent(real(1.0), real(30.0), real(1.0)).depends_on_second_invariant,
    }
    assert found == {False} and jaxform.MooneyRivlin(real(1.0), real(0.1), real(1.0)).depends_on_second_invariant
