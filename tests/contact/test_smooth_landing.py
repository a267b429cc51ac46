"""Nodes that land on curved paths at their own time within a step: paths, slopes, what it refuses."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform.contact import sticking
from jaxform.mechanics.elements import Nodes
from jaxform.model.scene import Scene
from jaxform.tools.contact_law import Slide
from jaxform.tools.mold import Mold
from jaxform.tools.surface_walk import ContactSurface
from tests import scenes


def _land(share: float, speed: np.ndarray, pull: np.ndarray, smooth: bool) -> sticking.Landing:
    """A node that lands at the origin, on z = 0, after a share of a step of length 1, at a speed under a constant pull.

    The positions at both ends of the step are those of its parabola.
    """
    corners = jnp.asarray([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]])
    grid: Any = None  # the landing itself does not search
    surface = ContactSurface(Mold(corners, jnp.asarray([[0, 1, 2]])), grid)
    before, after = (time * speed + 0.5 * time**2 * pull for time in (-share, 1.0 - share))
    real = jnp.asarray(1.0)
    nodes = Nodes(
        jnp.asarray(after)[:, None], jnp.asarray(after - before)[:, None], jnp.zeros(1, bool), jnp.zeros(1),
        jnp.zeros(1, jnp.int32), None, {},
    )  # fmt: skip
    curve = jnp.asarray(pull)[:, None] if smooth else None
    step = sticking.ContactStep(real, real, jnp.int32(0), curve=curve)
    flying = sticking.Landing(nodes, jnp.zeros(1, jnp.int32), jnp.zeros(()))
    return sticking.place_on_surfaces(
        flying, step, (jnp.ones(1), None), (surface,), jnp.zeros(1, jnp.int32), differentiable=True
    )


@pytest.mark.parametrize("share", [0.03, 0.5, 0.9])
def test_a_node_lands_where_its_parabola_does_and_returns_there_in_a_step(share: float) -> None:
    speed, pull = np.array([0.7, -0.2, -1.0]), np.array([0.4, 0.5, 0.3])
    landed = _land(share, speed, pull, smooth=True)
    place, back = np.asarray(landed.nodes.positions)[:, 0], np.asarray(landed.nodes.velocities)[:, 0]
    np.testing.assert_allclose(float(landed.nodes.contact_time[0]), share, rtol=1e-12)
    np.testing.assert_allclose(place + back, 0.0, atol=1e-14)
    # For one step it is a little beyond: so its mean place is that of a node that stops where it lands.
    np.testing.assert_allclose(place, 0.5 * share * (1.0 - share) * speed, atol=1e-12)
    straight = _land(share, speed, pull, smooth=False)
    off = np.abs(np.asarray(straight.nodes.positions)[:, 0]).max()
    assert off > 0.1 * share * (1.0 - share) and np.all(np.asarray(straight.nodes.velocities) == 0.0)


def _smooth(scene: Scene) -> Scene:
    return dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, smooth_landing=True))


@pytest.mark.long
def test_slopes_are_exact_and_hardly_depend_on_where_in_a_step_nodes_land() -> None:
    """A process that begins later forms the same part: the slope by its time is that by the phase of the steps alone.

    Of the logarithm of the wall's variance it is 0.28 [1/s] where nodes land on straight paths. All take the same
    steps: which ones a run finds depends on the phase too.
    """
    scene = _smooth(scenes.cup())
    ramp = {"pressure.time": jnp.asarray([0.5, 1.5])}
    fast = jaxform.replace(scene, ramp | {"solver.damping": jnp.asarray(0.2)})
    steps = jaxform.run(fast).schedule

    @jax.jit
    @jax.value_and_grad
    def unevenness(numbers: dict[str, jax.Array]) -> jax.Array:
        result = jaxform.simulate(jaxform.replace(fast, numbers), schedule=steps)
        return jnp.log(jnp.var(result.element_thickness))

    numbers = ramp | {"parison.thickness": scene.parison.thickness}
    scenes.assert_slopes(unevenness, numbers, size=1e-6)
    later = [numbers | {"pressure.time": numbers["pressure.time"] + 0.0071 * k} for k in range(6)]
    slopes = [float(jnp.sum(unevenness(each)[1]["pressure.time"])) for each in later]
    assert np.sqrt(np.mean(np.square(slopes))) < 0.03


def _parts(scene: Scene) -> dict[str, Any]:
    return {name: getattr(scene, name) for name in ("parison", "material", "pressure", "solver")}


@pytest.mark.long
def test_run_and_replay_agree_where_the_mesh_is_refined_and_nodes_rest_on_the_mold() -> None:
    scene = _smooth(scenes.cup())
    limits = jaxform.make_refinement(angle=8.0, interval=64, max_level=2, elements=300)
    scene = jaxform.build_scene(**_parts(scene), mold=scene.mold, refinement=limits, fill=False)
    result = jaxform.run(scene)
    again = jax.jit(lambda scene: jaxform.simulate(scene, schedule=result.schedule))(scene)
    assert int(result.status) == int(again.status) == 0 and scene.mold is not None
    np.testing.assert_allclose(again.positions, result.positions, atol=1e-9)
    # Each lies in the plane of a triangle, also those that landed in the last step of a window.
    corners = np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    landed = np.asarray(result.positions)[np.asarray(result.active) & (np.asarray(result.contact_time) > 0)]
    heights = np.abs(np.einsum("tk,ntk->nt", normals, landed[:, None] - corners[None, :, 0])).min(axis=1)
    assert len(landed) > 30 and heights.max() < 1e-12
    assert abs(float(result.energy.balance_error)) < 2e-3


@pytest.mark.long
@pytest.mark.parametrize("damping", [0.2, 10.0])
def test_reversed_steps_give_the_slopes_of_checkpoints(damping: float) -> None:
    """Also where damping is too strong to invert steps, and where nodes land in the last step of a window."""
    scene = _smooth(scenes.cup())

    def look(result: jaxform.Result) -> jax.Array:
        energies = result.energy.contact_loss + result.energy.balance_error
        return jnp.log(jnp.var(result.element_thickness)) + energies + jnp.sum(result.contact_time) / 100.0

    def slopes(vertices: jax.Array, numbers: dict[str, jax.Array], adjoint: jaxform.Adjoint) -> Any:
        assert scene.mold is not None
        moved = dataclasses.replace(scene, mold=dataclasses.replace(scene.mold, vertices=vertices))
        return look(jaxform.simulate(jaxform.replace(moved, numbers), adjoint=adjoint))

    assert scene.mold is not None
    numbers = {"parison.thickness": scene.parison.thickness, "material.density": scene.material.density}
    numbers |= {"pressure.time": jnp.asarray([0.5, 1.5]), "solver.damping": jnp.asarray(damping)}
    both = jax.jit(jax.grad(slopes, argnums=(0, 1)), static_argnums=2)
    back, forth = (both(scene.mold.vertices, numbers, way) for way in (jaxform.Reversed(), jaxform.Checkpointed()))
    for own, values in zip(jax.tree.leaves(back), jax.tree.leaves(forth), strict=True):
        assert np.abs(values).max() > 0.0
        np.testing.assert_allclose(own, values, atol=1e-8 * np.abs(values).max())


def test_it_is_refused_where_nodes_slide() -> None:
    scene = _smooth(scenes.cup())
    assert scene.mold is not None
    mold = jaxform.make_mold(np.asarray(scene.mold.vertices), np.asarray(scene.mold.triangles), contact=Slide())
    with pytest.raises(jaxform.InputError, match="needs tools at rest that the sheet sticks to"):
        jaxform.build_scene(**_parts(scene), mold=mold)
