"""The state in which a run begins: the sheet at rest, with what lies on the mold held there."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.adapt.remeshing import initial_mesh
from jaxform.core.pytree import as_real
from jaxform.loads import first_pressure
from jaxform.mechanics.nodes import Nodes
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.sheet.discretization import RefinedMesh, discretize, present_discretization
from jaxform.sheet.energy_balance import enclosed_volume
from jaxform.sheet.heat import ThermalState, initial_heat
from jaxform.sheet.state import (
    Control,
    EnergyBalance,
    InitialNodeState,
    Replay,
    State,
    initial_node_state,
    noise_vector,
)


def _first_memory(scene: Scene, mesh: RefinedMesh | None, heat: ThermalState | None) -> jax.Array | None:
    """The stress of viscous modes (4 n_mode, n_element) of a sheet that was never strained; None without such."""
    modes, adaptivity, pairs = scene.material.viscous, scene.adaptivity, scene.tables.assembly.pairs
    if modes is None:
        return None
    if scene.material.shift is not None and scene.parison.temperature is not None:
        modes = present_discretization(scene, mesh, discretize(scene)).with_zones(heat, scene.material).modes or modes
    if mesh is not None and adaptivity is not None:
        return modes.initial_stress(adaptivity.forest.sheet.inverse_metric[:, mesh.element])
    # In the basis that elements are worked through in.
    return modes.initial_stress(scene.tables.sheet.inverse_metric if pairs is None else pairs.inverse_metric)


def initial_state(scene: Scene) -> State:
    """The sheet at rest in its initial shape."""
    mesh = None if scene.adaptivity is None else initial_mesh(scene, scene.adaptivity)
    positions, sheet = scene.parison.positions.T, scene.tables.sheet
    start = initial_node_state(scene)
    fields = {name: own.start(scene.parison.positions) for name, own in scene.fields.items()}
    if mesh is not None:
        # Nodes that do not exist yet are held where the first node is.
        there = jnp.arange(mesh.node.size) < mesh.node_count
        start = initial_node_state(scene, mesh.node)
        start = InitialNodeState(
            start.stuck | ~there, jnp.where(there, start.contact_time, 0.0), jnp.where(there, start.wall, 0)
        )
        positions, fields = positions[:, mesh.node], {name: values[mesh.node] for name, values in fields.items()}
    zero, none = as_real(0.0), jnp.int32(0)
    elements = sheet.area.size if mesh is None else mesh.element.size
    heat = None if scene.cooling is None else initial_heat(elements)
    volume = enclosed_volume(positions, sheet)
    pressed = first_pressure(scene.pressure, volume) if scene.pressure.follows_volume else None
    return State(
        nodes=Nodes(
            positions=positions,
            velocities=jnp.zeros_like(positions),
            stuck=start.stuck,
            contact_time=start.contact_time,
            wall=start.wall,
            mode=noise_vector(positions) if scene.solver.sharp_step else None,
            fields=fields,
        ),
        account=EnergyBalance(
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
