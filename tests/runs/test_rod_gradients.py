"""Gradients through rod, preform, valve and mold at once are those of differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import jaxform
from tests.loads.slopes import assert_slopes_are_differences

_SCENE = """
[parison]
shape = "preform"
profile = [[0.01, 0.0], [0.01, 0.03], [0.007, 0.037], [0.0, 0.04]]
elements = 60
symmetry = "quarter"
thickness = 2.0e-3
[material]
model = "mooney-rivlin"
c = 2.0e5
alpha = 0.1
density = 1000.0
[gas]
time = [0.0, 0.02, 0.03, 0.05]
mass_flow = [0.0, 1.0e-4, 1.0e-4, 0.0]
supply_pressure = 4.0e5
orifice_area = 1.0e-5
valve = [0.01, 0.01, 0.5, 0.9]
dead_volume = 5.0e-6
[mold]
shape = "revolved"
fill = false
profile = [[0.0, 0.07], [0.018, 0.07], [0.02, 0.06], [0.02, 0.02], [0.0105, 0.0]]
segments = 32
[[tool]]
name = "rod"
shape = "rod"
radius = 0.005
length = 0.1
translate = [0.0, 0.0, 0.037]
direction = [0.0, 0.0, 1.0]
time = [0.0, 0.04]
displacement = [0.0, 0.028]
[solver]
end_time = 0.06
damping = 200.0
"""


@pytest.mark.long
def test_gradients_of_rod_valve_flow_and_thickness_are_those_of_differences(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(_SCENE)
    scene = jaxform.load(tmp_path / "scene.toml")
    rod = scene.tools[0].motion
    assert rod is not None
    reached = np.asarray(jaxform.run(scene).tool)
    assert np.any(reached == 0) and np.any(reached == 1), "some lie on the mold, some on the rod"
    values = {f"pressure.{name}": getattr(scene.pressure, name) for name in ("time", "mass_flow", "valve")}
    values |= {"tools.rod.motion.time": rod.time, "tools.rod.motion.displacement": rod.displacement}
    values |= {"parison.thickness": scene.parison.thickness}
    assert_slopes_are_differences(scene, values, least=1e-6, relative_step=1e-7)
