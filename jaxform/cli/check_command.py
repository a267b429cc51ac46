"""Output of `jaxform check` for a scene or a study, line by line; no step is run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxform.core.errors import InputError, format_extent, format_number, format_percent
from jaxform.core.pytree import as_real
from jaxform.core.store import Store
from jaxform.io import files, schema
from jaxform.io.files import SceneDocument
from jaxform.io.scene_checks import Survey, survey
from jaxform.loads import RegionalLoad
from jaxform.mesh import volumes
from jaxform.model import mesh_connectivity
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.prepare import planning
from jaxform.results.summary import QUASI_STATIC_LIMIT
from jaxform.runs.host import is_compiled
from jaxform.tools.contact_law import Coulomb, Slide
from jaxform.tools.mold import Mold, Motion

# Measured on one core of a 2-core machine (docs/speed.md says more): of an element and of a step by itself, and what a
# process takes before it has a scene.
_PER_ELEMENT, _PER_STEP, _SECONDS_TO_COMPILE = 12e-9, 10e-6, {False: 6, True: 20}  # uniform, refined
# Growth of a step's program over that with one tool that nodes stick to, measured by its text, for further tools, tools
# on which nodes slide, Prony terms and a pressure that follows the volume; and the power of its length with which the
# time to compile grows: from 10.5 to 22.8 s of one core for 1.78 times the length.
_LONGER, _POWER = {"tool": 0.4, "slip": 0.8, "modes": 0.25, "gas": 0.15}, 4.0 / 3.0
_MEASURED_TO_BOUND = 1.6  # of the built-in scenes' first steps, 1.5 to 1.9
_BYTES_AT_FIRST, _COPIES = 350e6, 3.0


def read_study(source: str, store: Store) -> tuple[SceneDocument, Scene, list[str]]:
    """A study's scene, and the settings of the study, line by line.

    Raises:
        InputError: Something in the study or its scene is wrong.
    """
    study = files.read_study(source)
    tables = study.model.objective if isinstance(study.model.objective, list) else [study.model.objective]
    others = [getattr(getattr(table, "thickness", None), "scene", None) for table in tables]
    lines = list(_study_lines(study.file, study.model, tables))
    if any(others):
        # To build it would be to run the other scene.
        for other in filter(None, others):
            files.read_scene(other, study.folder)
        return study.scene, files.build(study.scene, store), lines
    import optimize

    built = optimize.load_study(source, store)
    try:
        optimize.check(built)
    except InputError as error:
        raise error.with_context(file=study.file) from None
    return study.scene, built.scene, [*lines, *(f"doubtful: {sentence}" for sentence in optimize.doubts(built))]


def _study_lines(file: str, model: schema.StudyFile, tables: list[Any]) -> Iterator[str]:
    yield f"study {file} of the scene {model.scene}"
    for variable in model.variable:
        yield f"variable: {_words(variable, 'kind')}"
    for table in tables:
        yield f"objective: {_words(table, 'kind')}"
    yield f"search: {_words(model.solver, 'method')}"


def _words(table: Any, name: str) -> str:
    """A table of a study in words: its kind, then its settings."""
    options = {key: value for key, value in table.model_dump(warnings=False).items() if value not in (None, False)}
    kind = options.pop(name)
    return ", ".join([kind, *(f"{key} {_short(value)}" for key, value in options.items())])


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return f"({', '.join(f'{key} {_short(item)}' for key, item in value.items() if item is not None)})"
    if isinstance(value, list):
        items = [_short(item) for item in value]
        return f"[{', '.join(items if len(items) <= 6 else [*items[:2], '...', *items[-2:]])}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def scene_lines(document: SceneDocument, scene: Scene, store: Store) -> Iterator[str]:
    """Lines on the simulation, its settings, and what is skipped."""
    seen = survey(scene)
    yield from _sheet_lines(document, scene, seen)
    yield from _mold_lines(scene, seen)
    for tool in scene.tools:
        yield from _tool_lines(tool)
    if document.model.part is not None:
        given = document.model.part.model_dump(exclude_defaults=True)
        chosen = ", ".join(f"{key} {_short(value)}" for key, value in given.items())
        yield f"part: {chosen}; all statistics count the part alone"
    tables = [document.model.mold, *document.model.tool]
    if any(table is not None and table.land is not None for table in tables):
        keeps = document.model.part is not None and document.model.part.flash
        words = "counts as part" if keeps else "is not part of the product; its mass is in summary.json"
        yield f"flash on the land of the mold {words}"
    yield from _run_lines(scene, store)
    skipped = {
        "contact (no mold)": not scene.surfaces,
        "damping (none given)": scene.solver.damping is None,
        "gravity (none given)": scene.solver.gravity is None,
        "viscous stress (no Prony terms)": scene.material.viscous is None,
        "the second invariant (not in this material model)": not scene.material.depends_on_second_invariant,
        "refinement (none given)": scene.refinement is None,
        "cooling (none given)": scene.cooling is None,
        "frames (none requested)": document.model.output.frames == 0,
    }
    yield "skipped: " + (", ".join(what for what, skip in skipped.items() if skip) or "nothing")


def _sheet_lines(document: SceneDocument, scene: Scene, seen: Survey) -> Iterator[str]:
    parison = scene.parison
    modes = scene.material.viscous
    terms = 0 if modes is None else modes.modulus.size
    viscous = [] if modes is None else [f"{terms} Prony term{'s' * (terms > 1)} ({modes.kind})"]
    law = ", ".join([document.model.material.model, *(f"{name} in zones" for name in scene.material.zones), *viscous])
    law += ", tension field (wrinkles instead of compression)" if scene.material.tension_field else ""
    yield f"{scene.name}: {len(parison.triangles)} elements, {scene.first_nodes} nodes, {law}"
    if parison.temperature is not None:
        yield _temperature_line(scene, np.asarray(parison.temperature, float))
    images = " with its images" if document.model.parison.shape != "file" and _is_cut_at_planes(scene) else ""
    yield f"sheet{images}: {format_extent(*seen.sheet)}; its thickness is {seen.thinness:.3g} times its size"
    found = mesh_connectivity.parison_connectivity(parison)
    first = scene.first_nodes
    held = int(np.asarray(parison.clamped)[:first].sum())
    pieces = f"{found.part_count} piece" if found.part_count == 1 else f"{found.part_count} pieces"
    rims = f"{found.rims} rim" if found.rims == 1 else f"{found.rims} rims"
    on_planes = (
        f", {int(np.asarray(parison.fixed)[:first].any(1).sum())} on symmetry planes"
        if _is_cut_at_planes(scene)
        else ""
    )
    until = "" if parison.clamp_until is None else f" until {float(parison.clamp_until):g} s"
    yield f"{pieces}, {rims}, {held} of {first} nodes clamped{until}{on_planes}"
    turns = ", and changes sign" if seen.changes_sign else ""
    loads = "the pressure" if scene.solver.gravity is None else "the pressure with the weight of the sheet"
    if scene.pressure.follows_volume:
        yield f"{loads} follows the enclosed volume, and pushes the sheet {seen.direction}{turns}"
    else:
        yield f"{loads}, up to {format_number(scene.strongest_push(), 4)} Pa, pushes the sheet {seen.direction}{turns}"
    if isinstance(scene.pressure, RegionalLoad):
        yield f"the sheet is clamped along the borders of regions; {_regions(scene, scene.pressure)}"


def _regions(scene: Scene, load: RegionalLoad) -> str:
    """The number and the area of the elements that each load of a region pushes."""
    positions, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    area, masks = volumes.areas(positions, triangles), np.asarray(load.regions)
    rows = zip(load.names, masks, strict=True)
    said = [f"{name} pushes {own.sum()} elements ({1e4 * area[own].sum():.4g} cm^2)" for name, own in rows]
    rest = int((~masks.any(0)).sum())
    return ", ".join([*said, *([f"{rest} elements are in no region"] if rest else [])])


def _is_cut_at_planes(scene: Scene) -> bool:
    return bool((np.asarray(scene.parison.fixed) & ~np.asarray(scene.parison.clamped)[:, None]).any())


def _mold_lines(scene: Scene, seen: Survey) -> Iterator[str]:
    if scene.mold is None or seen.mold is None:
        return
    dropped = f" ({scene.mold.dropped} degenerate or duplicate ones left out)" if scene.mold.dropped else ""
    yield f"mold: {len(scene.mold.triangles)} triangles{dropped}; {format_extent(*seen.mold)}"
    if not scene.mold.contact.sticks:
        yield f"nodes on the mold {_contact_words(scene.mold)}"
    if scene.mold.motion is not None:
        yield f"the mold {_way(scene.mold.motion)}"
        return
    on = 1.0 - seen.ahead - seen.behind
    sides = f"{format_percent(seen.ahead, 3)} of the mold's area lies on that side"
    sides += f", {format_percent(seen.behind, 3)} on the other, {format_percent(on, 3)} next to the sheet"
    if seen.overlap is not None:
        sides += f"; {format_percent(seen.overlap, 3)} of the sheet has mold in front of it"
    yield sides


def _tool_lines(tool: Mold) -> Iterator[str]:
    """Lines on a tool: its triangles and box, its way and its contact law."""
    places = np.asarray(tool.vertices, float)[np.unique(np.asarray(tool.triangles))]
    dropped = f" ({tool.dropped} degenerate or duplicate ones left out)" if tool.dropped else ""
    extent = format_extent(places.min(0), places.max(0))
    yield f"tool {tool.name}: {len(tool.triangles)} triangles{dropped}; {extent}"
    way = "rests" if tool.motion is None else _way(tool.motion)
    yield f"the tool {tool.name} {way}; nodes on it {_contact_words(tool)}"
    numbers = (("temperature", tool.temperature, "degC"), ("heat transfer", tool.heat_transfer, "W/(m² K)"))
    own = [f"{name} {float(value):.4g} {unit}" for name, value, unit in numbers if value is not None]
    if own:
        yield f"the tool {tool.name} cools the sheet with its own {', '.join(own)}"


def _way(motion: Motion) -> str:
    """A motion in words: direction, and displacements at the knots."""
    along = ", ".join(f"{value:.4g}" for value in np.asarray(motion.direction, float))
    far, time = np.asarray(motion.displacement, float), np.asarray(motion.time, float)
    steps = [f"{value:.4g} m at {at:.4g} s" for value, at in zip(far[1:], time[1:], strict=True)]
    begins = f"from {time[0]:.4g} s on, " if time[0] > 0.0 else ""
    return f"moves along ({along}), {begins}by {', '.join(steps if len(steps) <= 4 else [steps[0], '...', steps[-1]])}"


def _contact_words(tool: Mold) -> str:
    """The contact law of a mold or tool, in words."""
    law = tool.contact
    if isinstance(law, Coulomb):
        low, high = float(law.friction.min()), float(law.friction.max())
        if law.temperature is not None:
            return f"slide with friction (coulomb, friction {low:.4g} to {high:.4g} over the sheet's temperature)"
        return f"slide with friction (coulomb, friction {high:.4g})"
    return "stick" if law.sticks else "slide without friction" if isinstance(law, Slide) else f"follow {law.kind}"


def _run_lines(scene: Scene, store: Store) -> Iterator[str]:
    elements = len(scene.parison.triangles)
    if scene.adaptivity is not None:
        limits, forest = scene.adaptivity
        yield (
            f"refined up to level {limits.deepest} of {forest.depth}, checked every {limits.interval} steps: "
            f"{forest.bound.size} triangles bisected beforehand, capacity for {limits.elements} elements at once"
        )
        elements = limits.elements
    sharper = _MEASURED_TO_BOUND if scene.solver.sharp_step else 1.0
    step, end = sharper * planning.first_step(scene), float(scene.solver.end_time)
    longest = int(scene.tables.longest_window)
    steps_each = f"{SHORT_WINDOW} to {longest}" if longest > SHORT_WINDOW else f"{SHORT_WINDOW}"
    windows = f"at most {scene.tables.window_count} windows of {steps_each} steps"
    yield f"end time {end:.4g} s; the first step takes about {step:.3g} s; {windows}"
    steps = end / step + sum(planning.tool_steps(each.mold.motion, each.grid, end, step) for each in scene.surfaces)
    seconds = steps * (_PER_STEP + elements * _PER_ELEMENT)
    stored = sum(leaf.nbytes for leaf in jax.tree.leaves(scene))
    most = "up to " if scene.refinement is not None else ""
    longer = ", or many times as long with sides at sharp edges (solver.edge_contact)" if scene.tables.edges else ""
    yield (
        f"about {format_number(steps, 2)} steps, fewer if the whole sheet is in contact earlier: "
        f"{most}{_duration(seconds)}{longer}; {most}{(_BYTES_AT_FIRST + _COPIES * stored) / 1e9:.2g} GB of memory"
    )
    if is_compiled(scene, store):
        yield "its programs are compiled already"
    else:
        wait = f"{_seconds_to_compile(scene):.0f} s"
        yield f"compiles first, for about {wait}: no scene of this kind and size was run on this machine before"
    if scene.solver.quasi_static:
        most = format_percent(QUASI_STATIC_LIMIT)
        yield f"quasi-static process: a warning follows if inertia or damping change the wall by more than {most}"


def _seconds_to_compile(scene: Scene) -> float:
    """Time [s] to compile the programs for a run, on one core."""
    counts = {
        "tool": max(len(scene.surfaces) - 1, 0),
        "slip": any(not surface.mold.contact.sticks for surface in scene.surfaces),
        "modes": scene.material.viscous is not None,
        "gas": scene.pressure.follows_volume,
    }
    size = 1.0 + sum(_LONGER[name] * count for name, count in counts.items())
    return _SECONDS_TO_COMPILE[scene.refinement is not None] * size**_POWER


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1g} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _temperature_line(scene: Scene, temperature: np.ndarray) -> str:
    """Line on the temperature of the sheet and its initial cooling rates."""
    low, high = temperature.min(), temperature.max()
    text = f"{low:.4g} degC" if low == high else f"{low:.4g} to {high:.4g} degC"
    cooling, wall, second = scene.cooling, scene.parison.thickness.mean(), as_real(1e-3)
    if cooling is None:
        return f"temperature of the sheet: {text}, constant"
    warm, density = as_real(temperature.mean()), scene.material.density.mean()
    later = (cooling.cooled(warm, wall, as_real(share), density, second) for share in (0.0, 1.0))
    air, mold = (float((warm - each) / second) for each in later)
    return f"temperature of the sheet: {text}; at first it loses {air:.3g} K/s in the air, {mold:.3g} K/s on the mold"
