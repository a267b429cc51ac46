"""The command `jaxform warm`: compiles the programs for runs of common scenes, or of the given ones.

Programs depend on the kind of a scene (its material model, refinement and interpolation of pressure) and on its bucket
sizes, not on its meshes and parameters. A small scene of each kind, padded to capacity, represents all.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from jaxform.cli import session
from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real
from jaxform.core.store import Store
from jaxform.io import files
from jaxform.kernels import capacities
from jaxform.loads import make_pressure
from jaxform.materials import Law, ModifiedMooneyRivlin, MooneyRivlin, NeoHookean
from jaxform.mesh import shapes
from jaxform.model.scene import Scene, make_parison, make_refinement, make_solver
from jaxform.prepare.scene_builder import build_scene
from jaxform.runs.host import compile_for, is_compiled
from jaxform.tools import molds
from jaxform.tools.mold import make_mold

_LARGEST = 5000  # elements of a mesh that stays as it is
_LARGEST_ROOTS = 400  # of one that is refined
_MAX_LEVEL = 6  # as a scene file has it where it says nothing


def warm(arguments: argparse.Namespace) -> int:
    """Runs `jaxform warm` with its arguments and returns its exit status.

    Raises:
        InputError: A scene that is named is wrong, or there is no folder to keep programs in.
    """
    say, store = session.prepare(arguments)
    if store.folder is None:
        raise InputError(
            "there is no cache folder for compiled programs", "set HOME or XDG_CACHE_HOME to a folder of yours"
        )
    wanted = [_kind_of_file(source, store) for source in arguments.sources] or list(kinds())
    done = new = 0
    with session.progress(not arguments.quiet, "compiling") as bar:
        try:
            for words, make, elements in wanted:
                if bar is not None:
                    bar(done / len(wanted), words)
                fresh = compile_kind(make, elements, store)
                done, new = done + 1, new + fresh
                if bar is None:
                    say(f"{done} of {len(wanted)}: {words}{'' if fresh else ' (compiled already)'}")
        except KeyboardInterrupt:
            say(f"interrupted; {done} of {len(wanted)} are compiled and remain stored")
            return session.INTERRUPTED
    say(f"{new} compiled, {len(wanted) - new} were compiled already; stored in {store.folder.parent}")
    return session.DONE


SceneKind = tuple[str, Callable[[], Scene], int]
"""Scenes that share their programs: a description, a function that returns a small one, their capacity for elements."""


def _kind_of_file(source: str, store: Store) -> SceneKind:
    scene = files.build(files.read_scene(source), store)
    return scene.name, lambda: scene, 0


def compile_kind(make: Callable[[], Scene], elements: int, store: Store) -> bool:
    """Compiles the programs of a kind of scenes; True if any was missing."""
    scene = make()
    if is_compiled(scene, store, elements):
        return False
    compile_for(scene, store, elements)
    # Compiled programs are in files; in memory they would only take space.
    store.clear_memory()
    jax.clear_caches()
    return True


def kinds() -> Iterator[SceneKind]:
    """The common kinds: each material model's sheet in a mold, fixed or refined, by bucket size; small ones first."""
    laws: dict[str, Law] = {
        "mooney-rivlin": MooneyRivlin(as_real(2e5), as_real(0.1), as_real(1e3)),
        "neo-hookean": NeoHookean(as_real(2e5), as_real(1e3)),
        "modified-mooney-rivlin": ModifiedMooneyRivlin(as_real(2e5), as_real(0.1), as_real(1e3)),
    }
    for size in _bucket_sizes(capacities.element_capacity, _LARGEST):
        for (name, law), ramp in itertools.product(laws.items(), ("linear", "cubic-ramp")):
            words = f"{name}, {ramp}, up to {size - 1} elements"
            yield words, lambda law=law, ramp=ramp: _scene(law, ramp), size - 1
    for size in _bucket_sizes(capacities.root_capacity, _LARGEST_ROOTS):
        words = f"mooney-rivlin, linear, refined from up to {size} elements"
        yield words, lambda size=size: _scene(laws["mooney-rivlin"], "linear", roots=size), size


def _bucket_sizes(capacity_of: Callable[[int], int], largest: int) -> list[int]:
    found = [capacity_of(1)]
    while found[-1] < largest:
        found.append(capacity_of(found[-1] + 1))
    return found


def _scene(law: Law, ramp: str, roots: int | None = None) -> Scene:
    sheet = shapes.disc(radius=0.1, elements=20, symmetry="quarter")
    wall = molds.revolved(profile=[[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]], segments=24)
    options: dict[str, Any] = {}
    if roots is not None:
        capacity = files.default_capacity(roots)
        options["refinement"] = make_refinement(angle=4.0, interval=100, max_level=_MAX_LEVEL, elements=capacity)
    return build_scene(
        parison=make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=law,
        pressure=make_pressure(np.array([0.0, 0.2]), np.array([0.0, 2e4]), ramp),
        solver=make_solver(end_time=0.24, damping=100.0),
        mold=make_mold(wall.vertices, wall.triangles),
        **options,
    )
