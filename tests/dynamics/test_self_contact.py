"""Contact of a sheet with itself: the films of a fold that meet back to back stick, and the run is as in `simulate`."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxform
from jaxform.cli import command
from jaxform.io import files
from jaxform.results.part import warnings_of_part

_ACROSS, _ALONG, _ANGLE, _HEIGHT = 17, 13, 10.0, 0.05


@functools.cache
def _fold(self_contact: bool) -> jaxform.Scene:
    """A sheet like a book that stands open, clamped but for its ridge, whose flanks are pressed together."""
    across, along = np.meshgrid(np.linspace(-1.0, 1.0, _ACROSS), np.linspace(0.0, 2.0, _ALONG), indexing="ij")
    angle = np.radians(_ANGLE)
    places = np.stack([along, across * np.sin(angle), np.abs(across) * np.cos(angle)], axis=-1).reshape(-1, 3)
    number = np.arange(len(places)).reshape(_ACROSS, _ALONG)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    a, b, c, d = (corner.ravel() for corner in corners)
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    clamped = (np.abs(across) == 1.0).ravel() | (np.abs(along - 1.0) == 1.0).ravel()
    parison = jaxform.make_parison(_HEIGHT * places, triangles, thickness=1e-3, clamped=clamped)
    return jaxform.build_scene(
        parison=parison,
        material=jaxform.MooneyRivlin(*map(jnp.asarray, (0.05e6, 0.1, 1000.0))),
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, 4.0e3]),
        solver=jaxform.make_solver(end_time=0.12, damping=100.0, self_contact=self_contact),
    )


def _stuck_in_flight(result: jaxform.Result) -> np.ndarray:
    """Nodes that stick though they are not clamped: there is no mold."""
    return np.asarray(result.stuck) & (np.asarray(result.contact_time) > 0.0)


@pytest.mark.long
def test_a_simulation_joins_the_same_nodes_as_a_run_and_its_gradient_is_that_of_differences() -> None:
    scene = _fold(True)
    run, pure = jaxform.run(scene), jaxform.simulate(scene)
    assert _stuck_in_flight(run).sum() > 20 and not _stuck_in_flight(jaxform.simulate(_fold(False))).any()
    np.testing.assert_array_equal(_stuck_in_flight(run), _stuck_in_flight(pure))
    np.testing.assert_allclose(pure.positions, run.positions, atol=1e-9)

    @jax.jit
    @jax.value_and_grad
    def height(scale: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": 1e-3 * scale})
        result = jaxform.simulate(changed)
        return jnp.mean(result.positions[:, 2]) / _HEIGHT

    step = 1e-6
    (_, slope), (above, _), (below, _) = (height(jnp.asarray(1.0 + k * step)) for k in (0, 1, -1))
    assert float(slope) == pytest.approx((float(above) - float(below)) / (2 * step), rel=1e-3)


def _crossings(scene: jaxform.Scene) -> tuple[jaxform.Result, list[str]]:
    """The result of a run, and what it says of a sheet that passes through itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jaxform.InputWarning)
        result = jaxform.run(scene)
    said = [sentence for sentence in warnings_of_part(result, scene) if "through itself" in sentence]
    return result, said


def _without(scene: jaxform.Scene) -> jaxform.Scene:
    return dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, self_contact=False))


@pytest.mark.long
def test_the_papers_box_folds_at_its_upper_corner_and_ends_without_a_warning() -> None:
    scene = jaxform.load("box-insert")
    _, said = _crossings(_without(scene))
    assert len(said) == 1 and "solver.self_contact" in said[0]
    formed, said = _crossings(scene)
    assert int(formed.status) == 0 and said == []
    assert 5 < (_stuck_in_flight(formed) & (np.asarray(formed.wall) == 0)).sum() < 40


@pytest.mark.long
def test_a_box_that_folds_to_webs_at_its_corners_does_not_burst(tmp_path: Path) -> None:
    trimesh.creation.box((100.0, 100.0, 40.0)).export(tmp_path / "box.stl")
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(tmp_path / "box.stl"), "--drape", "--quiet"]) == 0
    scene = files.load(folder / "scene.toml")
    assert scene.solver.self_contact
    formed, said = _crossings(scene)
    assert int(formed.status) == 0 and said == []
    assert (_stuck_in_flight(formed) & (np.asarray(formed.wall) == 0)).any()
