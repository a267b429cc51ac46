"""The state in which a run begins: the sheet at rest, with what lies on the mold held there."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.adapt.remeshing import started_mesh
from jaxform.core.pytree import as_real
from jaxform.loads import first_pressure
from jaxform.mechanics.nodes import Nodes
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.sheet.account import enclosed_volume
from jaxform.sheet.discretization import Mesh, discretize, present_discretization
from jaxform.sheet.heat import Heat, none_lost
from jaxform.sheet.state import Account, AtStart, Control, Replay, State, any_mode, at_start


def _first_memory(scene: Scene, mesh: Mesh | None, heat: Heat | None) -> jax.Array | None:
    """The stress of viscous modes (4 n_mode, n_element) of a sheet that was never strained; None without such."""
    modes, adaptivity, pairs = scene.material.viscous, scene.adaptivity, scene.tables.assembly.pairs
    if modes is None:
        return None
    if scene.material.shift is not None and scene.parison.temperature is not None:
        modes = present_discretization(scene, mesh, discretize(scene)).having(heat, scene.material).modes or modes
    if mesh is not None and adaptivity is not None:
        return modes.at_first(adaptivity.forest.sheet.inverse_metric[:, mesh.element])
    # In the basis that elements are worked through in.
    return modes.at_first(scene.tables.sheet.inverse_metric if pairs is None else pairs.inverse_metric)


def initial_state(scene: Scene) -> State:
    """The sheet at rest in its initial shape."""
    mesh = None if scene.adaptivity is None else started_mesh(scene, scene.adaptivity)
    positions, sheet = scene.parison.positions.T, scene.tables.sheet
    start = at_start(scene)
    fields = {name: own.start(scene.parison.positions) for name, own in scene.fields.items()}
    if mesh is not None:
        # Nodes that do not exist yet are held where the first node is.
        there = jnp.arange(mesh.node.size) < mesh.node_count
        start = at_start(scene, mesh.node)
        start = AtStart(
            start.stuck | ~there, jnp.where(there, start.contact_time, 0.0), jnp.where(there, start.wall, 0)
        )
        positions, fields = positions[:, mesh.node], {name: values[mesh.node] for name, values in fields.items()}
    zero, none = as_real(0.0), jnp.int32(0)
    elements = sheet.area.size if mesh is None else mesh.element.size
    heat = None if scene.cooling is None else none_lost(elements)
    volume = enclosed_volume(positions, sheet)
    pressed = first_pressure(scene.pressure, volume) if scene.pressure.follows_volume else None
    return State(
        nodes=Nodes(
            positions=positions,
            velocities=jnp.zeros_like(positions),
            stuck=start.stuck,
            contact_time=start.contact_time,
            wall=start.wall,
            mode=any_mode(positions) if scene.solver.sharp_step else None,
            fields=fields,
        ),
        account=Account(
            volume,
            pressed,
            *[zero] * 8,
            viscous_loss=None if scene.material.viscous is None else zero,
            cooling_loss=zero if scene.stiffens else None,
            tool_work=None if scene.motion is None else zero,
            tool_last=None if scene.motion is None else zero,
            rim=None if scene.tables.rim is None else zero,
        ),
        control=Control(
            step_length=zero,
            span=jnp.minimum(SHORT_WINDOW, jnp.int32(scene.tables.longest_window)),
            retries=none,
            bound=zero,
            sharpness=zero,
            last_length=zero,
            last_count=none,
            pace=None if scene.cooling is None else zero,
        ),
        replay=Replay(none, zero),
        mesh=mesh,
        memory=_first_memory(scene, mesh, heat),
        time=zero,
        steps=none,
        windows=none,
        shortened=none,
        status=none,
        heat=heat,
    )
