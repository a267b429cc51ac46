"""Do the tests find what is wrong? Single-line faults, planted one at a time in a copy of the tree: `make planted`.

`python -m benchmarks.planted_faults AREA ...` plants those of some areas; `--tests PATH ...` asks other tests than the
area's own; `--short` leaves out those marked `long`. A fault that no test finds is a line that nobody holds.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
_SECONDS = 1800  # for the tests of one fault: a fault that makes them hang is found


class Fault(NamedTuple):
    """A line's part that stands in a file once, and what is put in its place."""

    area: str
    file: str
    right: str
    wrong: str


TESTS = {
    "element": ["tests/mechanics", "tests/runs/test_exact.py", "tests/runs/test_features.py"],
    "step": [
        "tests/runs/test_features.py",
        "tests/runs/test_simulation.py",
        "tests/loads",
        "tests/tools/test_motion.py",
    ],
    "contact": ["tests/contact", "tests/runs/test_features.py"],
    "refinement": ["tests/adapt", "tests/runs/test_features.py", "tests/model/test_fields.py"],
    "adjoint": ["tests/dynamics/test_windows.py", "tests/runs/test_features.py", "tests/dynamics/test_rims.py"],
    "models": ["tests/materials", "tests/runs/test_features.py"],
    "padding": ["tests/runs/test_padding.py", "tests/runs/test_features.py"],
    "readers": ["tests/mesh"],
    "friction": ["tests/contact/test_sliding.py", "tests/runs/test_features.py"],
    "edges": ["tests/contact/test_edge_contact.py"],
    "motion": ["tests/tools/test_motion.py", "tests/contact/test_sliding.py", "tests/runs/test_features.py"],
    "gas": ["tests/loads"],
    "closing": ["tests/contact/test_pinch.py", "tests/tools/test_parting.py"],
    "clamp": ["tests/dynamics/test_clamp.py"],
    "recovery": ["tests/results/test_recovery.py"],
    "sizes": ["tests/results/test_recovery.py", "tests/adapt/test_mesher.py", "tests/io/test_adaptation.py"],
    "sweeps": ["tests/sweeps", "tests/cli/test_sweep.py"],
    "balance": ["tests/results/test_energy.py", "tests/dynamics", "tests/runs/test_features.py"],
    "cooling": [
        "tests/materials/test_cooling.py",
        "tests/materials/test_temperature.py",
        "tests/runs/test_features.py",
    ],
}
"""The tests that are asked, by area; the first that fails ends the search."""

FAULTS = [
    Fault("element", "jaxform/mechanics/constitutive.py", "sqrt(0.25 * jnp.square(h11", "sqrt(0.2 * jnp.square(h11"),
    Fault("element", "jaxform/mechanics/corners.py", "(p + a + b, p - a, p - b)", "(p + a + b, p - a, p + b)"),
    Fault("element", "jaxform/mechanics/membrane.py", "g[2] * scale, -g[1] * scale", "g[2] * scale, g[1] * scale"),
    Fault(
        "step",
        "jaxform/sheet/scheme.py",
        "half = 0.5 * damping * velocity_step",
        "half = 0.6 * damping * velocity_step",
    ),
    Fault(
        "step",
        "jaxform/sheet/scheme.py",
        "return new, velocity_step * damping",
        "return new, 0.9 * velocity_step * damping",
    ),
    Fault(
        "step",
        "jaxform/sheet/scheme.py",
        "(mass * (speed - before) - velocity_step * own)",
        "(mass * (speed - before))",
    ),
    Fault("step", "jaxform/dynamics/step.py", "2.0 * velocity_step - length, volume)", "length, volume)"),
    Fault("step", "jaxform/dynamics/step.py", "0.5 * (last.pressure + load_state.pressure)", "load_state.pressure"),
    Fault("step", "jaxform/dynamics/step.py", "jnp.where(current.count == 0, 0.5, 1.0) * length", "1.0 * length"),
    Fault("step", "jaxform/dynamics/step.py", "advanced.volume + data.active.inactive_volume", "advanced.volume"),
    Fault(
        "contact",
        "jaxform/dynamics/contact_step.py",
        "jnp.where(lands, known.chosen, -1)",
        "jnp.where(lands, known.chosen - 1, -1)",
    ),
    Fault("contact", "jaxform/contact/sticking.py", "a - length * v for", "a - 0.9 * length * v for"),
    Fault("contact", "jaxform/contact/sticking.py", "meets & used & ~blocked", "meets & ~blocked"),
    Fault("refinement", "jaxform/adapt/insertion.py", "lost[0] / (lost[0] + lost[1])", "lost[1] / (lost[0] + lost[1])"),
    Fault("refinement", "jaxform/adapt/insertion.py", "share * share * (3.0 - 2.0 * share)", "share"),
    Fault(
        "refinement",
        "jaxform/adapt/insertion.py",
        "lambda first, second: 0.5 * (first + second)",
        "lambda first, second: first",
    ),
    Fault("refinement", "jaxform/adapt/refinement.py", "inherit_stress(state.memory, element, parts)", "state.memory"),
    Fault(
        "adjoint",
        "jaxform/adjoint/reversed_scheme.py",
        "jnp.where(taken, work * gains, 0.0)",
        "jnp.where(taken, 0.0 * gains, 0.0)",
    ),
    Fault(
        "adjoint",
        "jaxform/adjoint/reversed_scheme.py",
        "kept.count > 0, -work * mean[0]",
        "kept.count > 0, work * mean[0]",
    ),
    Fault(
        "adjoint",
        "jaxform/adjoint/reversed_scheme.py",
        "half = 0.5 * damping * jnp.maximum",
        "half = 0.0 * damping * jnp.maximum",
    ),
    Fault("adjoint", "jaxform/adjoint/reversed_scheme.py", "back.summed[0][0] / now.thickness", "back.summed[0][0]"),
    Fault(
        "adjoint",
        "jaxform/adjoint/reversed_scheme.py",
        "share[None] * now.compliance",
        "0.5 * share[None] * now.compliance",
    ),
    Fault("models", "jaxform/materials/viscous.py", "modulus * (left - 1.0 + lag)", "modulus * (left + lag)"),
    Fault(
        "models", "jaxform/materials/viscous.py", "1.0 / (self.modulus * self.time)", "0.5 / (self.modulus * self.time)"
    ),
    Fault("models", "jaxform/materials/temperature.py", "-jnp.log(10.0) * self.c1 * above", "-jnp.log(10.0) * above"),
    Fault("models", "jaxform/sheet/cooling.py", "[ratio * row for row in memory]", "[row for row in memory]"),
    Fault("models", "jaxform/sheet/cooling.py", "area * thickness * (1.0 - ratio)", "area * thickness * (ratio - 1.0)"),
    Fault("models", "jaxform/materials/tension_field.py", "turn=(width - 1.0) * both", "turn=width * both"),
    Fault("models", "jaxform/materials/ogden.py", "jnp.square(thickness) - 3.0)", "thickness - 3.0)"),
    Fault(
        "padding", "jaxform/runs/padding.py", "self.order.triangle_capacity, NEVER)", "self.order.triangle_capacity, 0)"
    ),
    Fault("padding", "jaxform/runs/padding.py", "np.asarray(split)[order.triangle]", "np.asarray(split)"),
    Fault("readers", "jaxform/mesh/ply.py", '"binary_big_endian": ">"', '"binary_big_endian": "<"'),
    Fault("readers", "jaxform/mesh/solver_decks.py", 'word.lower().replace("d", "e")', "word.lower()"),
    Fault("readers", "jaxform/mesh/ply.py", '("uchar", "uint8"), "u1"', '("uchar", "uint8"), "i1"'),
    Fault(
        "friction",
        "jaxform/tools/contact_law.py",
        "1.0 - self.friction * push / speed",
        "1.0 - 0.9 * self.friction * push / speed",
    ),
    Fault("friction", "jaxform/tools/contact_law.py", "square > jnp.square(self", "square > 0.5 * jnp.square(self"),
    Fault("friction", "jaxform/tools/surface_walk.py", "(1.0 - share) * glide.left", "share * glide.left"),
    Fault("friction", "jaxform/contact/facet_slip.py", "(gamma + delta <= 1.0 + OUT)", "(gamma + delta <= 2.0)"),
    Fault(
        "edges",
        "jaxform/contact/edge_contact.py",
        "far = jnp.clip((b * share + e) / length",
        "far = jnp.clip((b * share - e) / length",
    ),
    Fault("edges", "jaxform/contact/edge_contact.py", "(b * e - c * d) / area", "(b * e + c * d) / area"),
    Fault("edges", "jaxform/contact/edge_contact.py", "OVERHANG = 0.5", "OVERHANG = 1.0"),
    Fault("edges", "jaxform/contact/edge_forces.py", "jnp.where(move > 0.0, weight, 0.0)", "weight"),
    Fault("edges", "jaxform/contact/edge_forces.py", "0.0, own) - factor * row", "0.0, own) + factor * row"),
    Fault("motion", "jaxform/tools/mold.py", "s * s * (3.0 - 2.0 * s) * (end - begin)", "s * (end - begin)"),
    Fault("motion", "jaxform/contact/sliding.py", "else frame.offset[k] - length * c)", "else frame.offset[k])"),
    Fault("gas", "jaxform/loads/gas.py", "0.5 * slope * passed)", "slope * passed)"),
    Fault("gas", "jaxform/loads/gas.py", "(before / middle) ** power", "(middle / before) ** power"),
    Fault("gas", "jaxform/loads/gas.py", "self.at_knots(self.vent, time) * self.vent_area", "self.vent_area"),
    Fault("closing", "jaxform/prepare/component_validation.py", "level - side * _BEHIND", "level + side * _BEHIND"),
    Fault("closing", "jaxform/tools/parting.py", "*(low - width), *(high + width)", "*low, *(high + width)"),
    Fault("clamp", "jaxform/sheet/state.py", "jnp.minimum(end, until)", "end"),
    Fault("clamp", "jaxform/sheet/scheme.py", "return 1.0 / 3.0 if", "return 1.0 if"),
    Fault("recovery", "jaxform/results/recovery.py", "mean - jnp.sum(slope * first, axis=0), slope", "mean, slope"),
    Fault(
        "recovery",
        "jaxform/results/recovery.py",
        "even = (mobile[:, None] & mobile",
        "even = (mobile[:, None] | mobile",
    ),
    Fault(
        "sizes", "jaxform/adapt/mesher.py", "_heights(*parts).min() >= height.min()", "_heights(*parts).min() >= 0.0"
    ),
    Fault("sizes", "jaxform/results/size_field.py", "** (-0.5 * _POWER)", "** (0.5 * _POWER)"),
    Fault("sizes", "jaxform/results/size_field.py", ".mean(1)) - recovered", ".mean(1)) + recovered"),
    Fault("sweeps", "jaxform/sweeps/designs.py", "int(share * (most - least + 1))", "int(share * (most - least))"),
    Fault("sweeps", "jaxform/sweeps/designs.py", "low * (high / low) ** share", "low + (high - low) * share"),
    Fault("balance", "jaxform/sheet/energy_balance.py", "way)) / 12.0", "way)) / 6.0"),
    Fault("balance", "jaxform/contact/sticking.py", "(beta - 0.5) * dot(impulse", "(0.5 - beta) * dot(impulse"),
    Fault(
        "balance",
        "jaxform/sheet/scheme.py",
        "if not conserves_energy(scene):\n        return 1.0",
        "if False:\n        return 1.0",
    ),
    Fault(
        "balance", "jaxform/sheet/energy_balance.py", "0.5 * jnp.sum(mass * membrane.dot", "jnp.sum(mass * membrane.dot"
    ),
    Fault("cooling", "jaxform/materials/temperature.py", "/ (6.0 * self.conductivity)", "/ (3.0 * self.conductivity)"),
    Fault("cooling", "jaxform/sheet/heat.py", "return share / 3.0", "return share / 2.0"),
]


def plant(fault: Fault, tree: Path) -> None:
    """Puts a fault into a copy of the tree.

    Raises:
        ValueError: If the file does not have the line once.
    """
    path = tree / fault.file
    text = path.read_text(encoding="utf-8")
    if text.count(fault.right) != 1:
        raise ValueError(f"{fault.file}: {fault.right!r} stands there {text.count(fault.right)} times, not once")
    path.write_text(text.replace(fault.right, fault.wrong), encoding="utf-8")


def is_found(fault: Fault, tests: list[str], *, short: bool = False) -> str:
    """The name of the first test that fails with the fault, of the short ones alone if wanted; empty where all pass."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        hidden = shutil.ignore_patterns(".*", "out", "__pycache__", "*.egg-info")
        shutil.copytree(ROOT, tree, ignore=hidden)
        plant(fault, tree)
        programs = ROOT / ".pytest_cache" / "programs"  # what the fault does not change is not compiled again
        known = {"JAX_COMPILATION_CACHE_DIR": str(programs)} | os.environ | {"PYTHONPATH": str(tree)}
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no", *tests]
        command += ["-m", "not long"] if short else []
        try:
            done = subprocess.run(
                command, cwd=tree, env=known, capture_output=True, text=True, timeout=_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            return "(no end)"
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split(" - ")[0] if failed else "" if done.returncode == 0 else done.stdout[-300:]


def main() -> None:
    """Plants the faults of the named areas, or all, and prints what finds them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("areas", nargs="*", help=f"of {', '.join(TESTS)}; all by default")
    parser.add_argument("--tests", nargs="+", default=None, help="files, folders or tests instead of the area's own")
    parser.add_argument("--short", action="store_true", help="without the tests marked `long`, as `make test`")
    arguments = parser.parse_args()
    missed = 0
    for fault in FAULTS:
        if arguments.areas and fault.area not in arguments.areas:
            continue
        found = is_found(fault, arguments.tests or TESTS[fault.area], short=arguments.short)
        missed += not found
        print(f"{fault.area:11}{fault.file}: {fault.wrong}\n           {found or 'NOT FOUND'}", flush=True)
    raise SystemExit(f"{missed} not found" if missed else 0)


if __name__ == "__main__":
    main()
