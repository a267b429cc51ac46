"""The command `jaxform fit`: parameters of a material from tables of tests."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxform.cli import session
from jaxform.core import disk
from jaxform.core.errors import InputError, format_percent

_NAMES = ("file", "kind", "column", "stretch", "time", "height", "measured", "fitted")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    words = "tables of tests, each as PATH or KIND=PATH; kinds: uniaxial, equibiaxial, pure-shear, relaxation, bubble"
    parser.add_argument("sources", metavar="DATA.csv", nargs="+", help=words)
    parser.add_argument("--model", metavar="NAME", required=True, help="the material model, named as in a scene file")
    words = "Python file that declares the model, if it is not built in"
    parser.add_argument("--model-file", metavar="FILE.py", type=Path, help=words)
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for material.toml, summary.json and fit.png")
    words = (
        "number of terms of a model with lists of parameters (ogden); by default as many as the tests need, 3 at most"
    )
    parser.add_argument("--terms", metavar="N", type=int, help=words)
    words = "number of Prony terms; by default, with relaxation tests, as many as they need, 4 at most"
    parser.add_argument("--modes", metavar="N", type=int, help=words)
    words = "kind of the Prony terms; christensen by default"
    parser.add_argument("--viscous", choices=("christensen", "maxwell"), help=words)
    words = (
        "divide differences by the measured value (relative, the default) or by the table's largest value (absolute)"
    )
    parser.add_argument("--weights", choices=("relative", "absolute"), default="relative", help=words)
    words = "density in material.toml [kg/m^3]; 1000 by default, since no test determines it"
    parser.add_argument("--density", metavar="RHO", type=float, default=1000.0, help=words)
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.add_argument("--force", action="store_true", help="overwrite results in DIR")
    parser.set_defaults(dtype="float64")


def fit(arguments: argparse.Namespace) -> int:
    """Runs `jaxform fit` with its arguments and returns its exit status.

    Raises:
        InputError: A table or an option is wrong, or the tests do not determine the model's parameters.
    """
    say, _ = session.prepare(arguments)
    import optimize
    from jaxform.core.ranges import RANGES, check_one
    from jaxform.io import output
    from jaxform.io.files import import_models

    if arguments.model_file is not None:
        import_models(disk.expand_path(arguments.model_file))
    check_one("--density", arguments.density, RANGES["material.density"])
    tables = [optimize.fitting.read_table(source) for source in arguments.sources]
    names = [table.name for table in tables]
    if len(set(names)) < len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise InputError("is given twice", "name each table once", value=repeated)
    folder: Path | None = arguments.out
    if folder is not None:
        session.open_folder(folder, arguments.force)
    options = {"terms": arguments.terms, "modes": arguments.modes, "viscous": arguments.viscous}
    found = optimize.fitting.fit(tables, arguments.model, weights=arguments.weights, **options)
    facts = found.summary(arguments.warned, arguments.density)
    words = list(_error_lines(facts))
    for line in (*_number_lines(facts), *words):
        say(line)
    table = found.table(arguments.density)
    if arguments.model_file is not None:
        table |= {"model_file": str(disk.expand_path(arguments.model_file).resolve())}
    if folder is None:
        say("")
        print(output.material_text(table, words), end="")
        return session.DONE
    output.write_material(folder / "material.toml", table, words)
    output.write_json(folder / "summary.json", facts)
    output.write_rows(folder / "fit.csv", _NAMES, _rows(found))
    output.fit_picture(folder / "fit.png", _title(facts), list(_curves(found)))
    say(f"results in {folder}")
    return session.DONE


def _number_lines(facts: dict[str, Any]) -> Iterator[str]:
    level = format_percent(facts["confidence_level"], 3)
    for number in facts["numbers"]:
        unit = f" {number['unit']}" if number["unit"] else ""
        how = (
            f"{level} interval {number['interval'][0]:.5g} to {number['interval'][1]:.5g}" if number["interval"] else ""
        )
        if number["at_bound"]:
            how = "at its bound, no interval"
        elif number["without_influence"]:
            how = "no influence on these tests, no interval"
        yield f"{number['name']} = {number['value']:.6g}{unit} ({how or 'no interval: the tests do not determine it'})"


def _error_lines(facts: dict[str, Any]) -> Iterator[str]:
    for table in facts["tables"]:
        mean, largest = table["mean_relative_error"], table["largest_relative_error"]
        if mean is not None:
            what = f"{Path(table['file']).name} ({table['kind']}, {table['rows']} rows): {table['column']}"
            yield f"{what} off by {format_percent(mean, 3)} on average, {format_percent(largest, 3)} at most"


def _title(facts: dict[str, Any]) -> str:
    modes = sum(number["name"].startswith("viscous.time") for number in facts["numbers"])
    return facts["model"] + (f", {modes} Prony terms ({facts['viscous']})" if modes else "")


def _rows(found: Any) -> Iterator[list[Any]]:
    for match in found.matches:
        table, none = match.table, [""] * len(match.measured)
        places = [getattr(table, key, None) for key in ("stretch", "time", "height")]
        columns = [none if place is None else place for place in places]
        for *where, measured, fitted in zip(*columns, match.measured, match.fitted, strict=True):
            yield [table.name, table.kind, match.column, *where, measured, fitted]


def _curves(found: Any) -> Iterator[Any]:
    from jaxform.io.output import FitCurve

    for match in found.matches:
        table, used = match.table, match.used
        label = f"{table.kind}: {Path(table.name).name}"
        measured, fitted = match.measured[used], match.fitted[used]
        if table.kind == "bubble":
            unit, size = ("kPa", 1e-3) if match.column == "pressure" else ("mm", 1e3)
            panel, across = f"{match.column} [{unit}]", "height of the pole [mm]"
            yield FitCurve(panel, across, label, 1e3 * table.height[used], size * measured, size * fitted)
        elif found.kind and table.time is not None:
            yield _time_curve(label, table.time[used], measured, fitted)
        else:
            stretch, stress = found.curve(table)
            line, panel = (stretch, 1e-6 * stress), "nominal stress [MPa]"
            yield FitCurve(panel, "stretch", label, table.stretch[used], 1e-6 * measured, 1e-6 * fitted, line)


def _time_curve(label: str, time: Any, measured: Any, fitted: Any) -> Any:
    from jaxform.io.output import FitCurve

    shown = time > 0.0
    columns = (time[shown], 1e-6 * measured[shown], 1e-6 * fitted[shown])
    return FitCurve("nominal stress [MPa] over time", "time [s]", label, *columns, logarithmic=True)
