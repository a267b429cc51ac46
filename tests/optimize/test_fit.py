"""Numbers of a material from tests: Treloar's rubber, exact discs, relaxation, intervals, stability, files."""

from __future__ import annotations

import csv
import io
import json
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import InputError, InputWarning
from jaxform.cli import command, session
from jaxform.core.errors import collect_warnings
from jaxform.io import files
from jaxform.materials import LAWS
from optimize import fitting
from optimize.fitting import bubble, numbers, solving, states
from optimize.fitting.tables import Bubble, Pull, Table
from tests.scenes import FILE, real

TRELOAR = Path(__file__).parent / "treloar"
DISCS = Path(__file__).parents[2] / "benchmarks" / "accuracy" / "exact" / "discs.csv"


def _pull(state: str, stretch: np.ndarray, stress: np.ndarray, time: np.ndarray | None = None) -> Pull:
    return Pull(state, "relaxation" if time is not None else state, state, stretch, stress, time)


def _values(fit: fitting.Fit) -> dict[str, float]:
    return {row["name"]: row["value"] for row in fit.summary([], 1.0)["numbers"]}


@pytest.fixture(scope="module")
def treloar() -> fitting.Fit:
    tables = [fitting.read_table(str(TRELOAR / f"{name}.csv")) for name in ("uniaxial", "equibiaxial")]
    with collect_warnings(lambda _: None) as warned:
        found = fitting.fit(tables, "ogden", terms=3)
    assert len(warned) == 2 and "mu[2], mu[3]: uncertain by as much" in warned[0]
    return found


def test_three_terms_of_ogdens_law_fit_treloars_rubber(treloar: fitting.Fit) -> None:
    uniaxial, equibiaxial = (match.errors for match in treloar.matches)
    assert len(uniaxial) == 24 and len(equibiaxial) == 16
    assert uniaxial.mean() < 0.053 and equibiaxial.mean() < 0.049
    found = treloar.table(1000.0)
    for k, state in enumerate(("uniaxial", "equibiaxial")):
        stretch, power = treloar.matches[k].table.stretch[1], -0.5 if state == "uniaxial" else -2.0  # pyright: ignore[reportAttributeAccessIssue]
        terms = zip(found["mu"], found["alpha"], strict=True)
        stress = sum(mu * (stretch ** (alpha - 1) - stretch ** (power * alpha - 1)) for mu, alpha in terms)
        np.testing.assert_allclose(treloar.matches[k].fitted[1], stress, rtol=1e-6)
    # Ogden's own for these data are 6.3e5, -1e4 and 1.2e3 Pa with 1.3, -2 and 5.
    np.testing.assert_allclose(found["alpha"], [1.3, -2.0, 5.0], rtol=0.15)
    assert treloar.solution.unstable is None


def test_the_table_is_one_that_a_scene_takes(treloar: fitting.Fit, tmp_path: Path) -> None:
    from jaxform.io.output import material_text

    begin, end = FILE.index("[material]"), FILE.index("[pressure]")
    text = material_text(treloar.table(950.0), ["fitted to\nTreloar"])
    (tmp_path / "scene.toml").write_text(FILE[:begin] + text + FILE[end:])
    law = files.read_scene(tmp_path / "scene.toml").model.material
    assert law.law is jaxform.Ogden and law.density == 950.0
    numbers = [row["value"] for row in treloar.summary([], 1.0)["numbers"]]
    np.testing.assert_allclose([*getattr(law, "mu"), *getattr(law, "alpha")], numbers, rtol=1e-7)  # noqa: B009


def test_a_linear_law_and_its_interval_are_those_of_regression() -> None:
    rng = np.random.default_rng(1)
    stretch = np.linspace(1.1, 3.0, 15)
    stress = 2.0 * 1.3e5 * (stretch - stretch**-2) * (1.0 + 0.05 * rng.standard_normal(15))
    row = fitting.fit([_pull("uniaxial", stretch, stress)], "neo-hookean").summary([], 1.0)["numbers"][0]
    slope = 2.0 * (stretch - stretch**-2) / stress
    c = slope.sum() / (slope @ slope)
    half = 2.1447866879 * np.sqrt(np.sum((slope * c - 1.0) ** 2) / 14 / (slope @ slope))
    np.testing.assert_allclose([row["value"], *row["interval"]], [c, c - half, c + half], rtol=1e-7)


@pytest.fixture(scope="module")
def exact_bubble() -> tuple[Bubble, np.ndarray]:
    """A disc of c = 2e5 Pa and alpha = 0.5, 40 mm in radius and 0.8 mm thick, by shooting."""
    with DISCS.open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["alpha"]) == 0.5]
    column = lambda name: np.array([float(row[name]) for row in rows])  # noqa: E731
    pressure = 2e5 * 8e-4 / 0.04 * column("P_a_over_c_h0")
    wall = 8e-4 * column("pole_h_over_h0")
    return Bubble("bubble", 0.04 * column("pole_height_over_a"), pressure, None, None, 0.04, 8e-4), wall


def test_an_exact_bubble_gives_its_numbers(exact_bubble: tuple[Bubble, np.ndarray]) -> None:
    found = _values(fitting.fit([exact_bubble[0]], "mooney-rivlin"))
    np.testing.assert_allclose([found["c"], found["alpha"]], [2e5, 0.5], rtol=1e-5)


def test_the_wall_and_the_slopes_of_a_bubble(exact_bubble: tuple[Bubble, np.ndarray]) -> None:
    table, wall = exact_bubble
    plan = bubble.plan(table.height / table.radius, None)
    law = lambda free: jaxform.MooneyRivlin(free[0], free[1], real(1.0))  # noqa: E731
    pressure = jax.jit(lambda free: bubble.inflate_bubble(law(free), plan, 2e5, False))
    slopes = np.asarray(jax.jit(jax.jacfwd(lambda free: pressure(free)[0]))(jnp.array([2e5, 0.5])))
    ahead, behind = (np.asarray(pressure(jnp.array([2e5, alpha]))[0]) for alpha in (0.5001, 0.4999))
    np.testing.assert_allclose(slopes[:, 1], (ahead - behind) / 2e-4, rtol=1e-5)
    found, ratio = pressure(jnp.array([2e5, 0.5]))
    np.testing.assert_allclose(slopes[:, 0], found / 2e5, rtol=1e-8)
    np.testing.assert_allclose(ratio, wall / table.sheet, rtol=1e-6)


def test_a_height_without_equilibrium_spoils_no_other() -> None:
    @jaxform.law
    class Bursting(jaxform.Law):
        a: jax.Array = jaxform.parameter("Pa", above=0.0)
        density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

        def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
            return -self.a * jnp.log(1.5 - (i1 - 3.0))

    plan = bubble.plan(np.array([0.4, 1.0, 0.4]), None)
    found = jax.jit(lambda: bubble.inflate_bubble(Bursting(real(1.0), real(1.0)), plan, 1.0, False))()
    pressure, wall = map(np.asarray, found)
    assert np.isfinite([pressure[0], wall[0]]).all() and np.isnan([pressure[1], wall[1]]).all()
    np.testing.assert_allclose([pressure[2], wall[2]], [pressure[0], wall[0]], rtol=1e-9)


def test_a_bubble_that_is_held_relaxes() -> None:
    """Maxwell modes at constant strain scale the stress of rubber, whatever its shape."""
    law = jaxform.NeoHookean(real(1.0), real(1.0), viscous=jaxform.Maxwell(jnp.array([2.0]), jnp.array([4.0])))
    plan = bubble.plan(np.full(4, 0.6), np.array([1e-9, 1.0, 4.0, 1e4]))
    pressure, wall = jax.jit(lambda: bubble.inflate_bubble(law, plan, 1.0, True))()
    alone = bubble.inflate_bubble(law.elastic, bubble.plan(np.array([0.6]), None), 1.0, False)[0]
    np.testing.assert_allclose(pressure / alone, [2.0, 1.0 + np.exp(-0.25), 1.0 + np.exp(-1.0), 1.0], rtol=1e-7)
    np.testing.assert_allclose(wall, wall[0], rtol=1e-9)


@pytest.mark.parametrize("kind", ["christensen", "maxwell"])
def test_relaxation_gives_moduli_and_times(kind: str) -> None:
    slow = 1.0 if kind == "christensen" else 1e3
    c, modulus, own, stretch = 1.2e5, np.array([1.5e5, 6e4]), slow * np.array([0.3, 5.0]), 2.0
    time = slow * np.geomspace(0.01, 30.0, 25)
    left = np.exp(-time[:, None] / own) @ modulus
    rubber = stretch - stretch**-2
    strain = 0.5 * ((stretch**3 - stretch) - (stretch**-2 * (1.0 / stretch - 1.0)))
    stress = 2.0 * c * rubber + left * (strain if kind == "christensen" else rubber)
    modes = None if kind == "christensen" else 2
    table = _pull("uniaxial", np.full(25, stretch), stress, time)
    fit = fitting.fit([table], "neo-hookean", modes=modes, viscous=kind)
    found = _values(fit)
    assert len(found) == 5, "as many modes as there are"
    assert not fit.confidence.at_bound.any() and np.isfinite(fit.confidence.high).all()
    expected = {"c": c, "viscous.modulus[1]": 1.5e5, "viscous.modulus[2]": 6e4}
    expected |= {"viscous.time[1]": own[0], "viscous.time[2]": own[1]}
    np.testing.assert_allclose([found[name] for name in expected], list(expected.values()), rtol=1e-5)


def test_a_ramp_told_by_its_two_ends_is_followed_between_them() -> None:
    """A Maxwell mode by Lodge's integral, stretched evenly to 1.8 in 0.4 s and then held."""
    c, modulus, own, time = 1e5, 3e5, 0.5, np.array([0.0, 0.4, 0.6, 1.5])
    past = np.linspace(0.0, 1.5, 150_001)
    stretch = 1.0 + 2.0 * np.minimum(past, 0.4)
    stress = []
    for end, now in zip(time, np.interp(time, past, stretch), strict=True):
        before = past <= end
        strain = np.square(now / stretch[before]) - stretch[before] / now
        kept = np.trapezoid(strain * np.exp((past[before] - end) / own) / own, past[before])
        kept += np.exp(-end / own) * (now**2 - 1.0 / now)
        stress.append((2.0 * c * (now**2 - 1.0 / now) + modulus * kept) / now)
    law = jaxform.NeoHookean(real(c), real(1000.0), viscous=jaxform.Maxwell(jnp.full(1, modulus), jnp.full(1, own)))
    known = np.interp(time, past, stretch)
    found = states.nominal_stress(law, "uniaxial", jnp.asarray(known), states.history(known, time))
    np.testing.assert_allclose(found, stress, rtol=3e-4, atol=1e-6 * c)


def test_numbers_that_these_tests_cannot_tell_apart() -> None:
    stretch = np.linspace(1.2, 3.0, 12)
    stress = 2e5 * (stretch - stretch**-3)  # of pure shear: of c (1 + alpha) alone
    stress *= 1.0 + 0.01 * np.sin(np.arange(12))
    with collect_warnings(lambda _: None) as warned:
        found = _values(fitting.fit([_pull("pure-shear", stretch, stress)], "mooney-rivlin"))
    assert "c and alpha: these tests hardly distinguish them" in warned[-1]
    np.testing.assert_allclose(2.0 * found["c"] * (1.0 + found["alpha"]), 2e5, rtol=5e-3)


def test_a_number_that_the_tests_do_not_need_is_at_its_bound() -> None:
    stretch = np.linspace(1.2, 3.0, 12)
    stress = 2e5 * (stretch - stretch**-2)
    with collect_warnings(lambda _: None) as warned:
        fit = fitting.fit([_pull("uniaxial", stretch, stress)], "modified-mooney-rivlin")
    assert fit.confidence.at_bound.tolist() == [False, True] and "a02 ended at the bound" in warned[0]
    assert fit.summary([], 1.0)["numbers"][1]["interval"] is None
    np.testing.assert_allclose(_values(fit)["a01"], 1e5, rtol=1e-4)


def test_a_number_that_changes_nothing_is_told_as_such() -> None:
    stretch = np.linspace(1.05, 1.3, 10)
    with collect_warnings(lambda _: None) as warned:
        fit = fitting.fit([_pull("uniaxial", stretch, 2e5 * (stretch - stretch**-2))], "gent")
    assert warned == ["j_max: no influence on the measured values; a simpler model may be sufficient for these tests"]
    mu, limit = fit.summary([], 1.0)["numbers"]
    np.testing.assert_allclose(mu["interval"], [2e5, 2e5], rtol=1e-6)
    assert limit["without_influence"] and not limit["at_bound"] and limit["interval"] is None


def test_stability_is_that_of_the_energys_second_derivatives() -> None:
    made = numbers.make_numbers("neo-hookean", 1, "christensen", 0, 1e5, None)
    own = solving.Stability([_pull("equibiaxial", np.array([1.5, 2.0]), np.array([1e5, 2e5]))], made, 1e5)
    least = []
    for _, one in own.places:
        third = one**-4
        matrix = 4.0 * np.array([[one**2 + third, third], [third, one**2 + third]])
        least.append(np.linalg.eigvalsh(matrix)[0])
    np.testing.assert_allclose(100.0 - own.deficit(np.array([1.0]), margin=100.0), least, rtol=1e-10)
    assert own.first_unstable(np.array([1.0])) is None
    assert own.first_unstable(np.array([-1.0])) == ("equibiaxial", 1.0)


def test_an_unstable_law_is_left_for_a_stable_one() -> None:
    stretch = np.linspace(1.05, 1.8, 14)
    invariant = stretch**2 + 2.0 / stretch - 3.0
    stress = 2.0 * (stretch - stretch**-2) * (1e5 - 8e4 * invariant + 2.2e4 * invariant**2)
    assert np.any(np.diff(stress * stretch) < 0.0)
    with collect_warnings(lambda _: None) as warned:
        found = fitting.fit([_pull("uniaxial", stretch, stress)], "yeoh")
    assert "fits better with unstable parameters" in warned[0]
    fine = np.linspace(1.05, 1.8, 500)
    law = np.asarray(states.nominal_stress(found.law, "uniaxial", jnp.asarray(fine)))
    assert np.all(np.diff(law * fine) > -1e-4 * law.max())


def test_a_place_where_a_law_is_not_finite_is_not_stable(monkeypatch: pytest.MonkeyPatch) -> None:
    @jaxform.law
    class Limited(jaxform.Law):
        a: jax.Array = jaxform.parameter("Pa", above=0.0)
        limit: jax.Array = jaxform.parameter(above=1.0)
        density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

        def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
            return -2.0 * self.a * jnp.sqrt(self.limit - (i1 - 3.0))

    monkeypatch.setitem(LAWS, "limited", Limited)
    made = numbers.make_numbers("limited", 1, "christensen", 0, 1e5, None)
    own = solving.Stability([_pull("equibiaxial", np.array([2.0]), np.array([1e5]))], made, 1e5)
    free = np.array([1.0, 2.0])
    beyond = np.array([2.0 * stretch**2 + stretch**-4 - 3.0 >= 2.0 for _, stretch in own.places])
    assert 0 < beyond.sum() < len(beyond)
    np.testing.assert_array_equal(own.deficit(free), np.where(beyond, 1.0, 0.0))
    assert np.isfinite(own.slopes(free, margin=1e3)).all()
    state, stretch = own.first_unstable(free) or ("", 0.0)
    assert state == "equibiaxial" and stretch == own.places[int(np.argmax(beyond))][1]


def test_a_law_of_ones_own_is_fitted_once_it_is_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    @jaxform.law
    class Power(jaxform.Law):
        a: jax.Array = jaxform.parameter("Pa", above=0.0)
        n: jax.Array = jaxform.parameter(above=0.0, most=3.0)
        density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

        def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
            return self.a / self.n * ((1.0 + (i1 - 3.0)) ** self.n - 1.0)

    monkeypatch.setitem(LAWS, "power", Power)
    stretch = np.linspace(1.1, 3.0, 12)
    stress = 2.0 * (stretch - 1.0 / stretch**5) * 7e4 * (2.0 * stretch**2 + stretch**-4 - 2.0) ** -0.3
    found = _values(fitting.fit([_pull("equibiaxial", stretch, stress)], "power"))
    np.testing.assert_allclose([found["a"], found["n"]], [7e4, 0.7], rtol=1e-6)


def test_bounds_of_numbers_are_all_that_their_ranges_say(monkeypatch: pytest.MonkeyPatch) -> None:
    @jaxform.law
    class Bounded(jaxform.Law):
        first: jax.Array = jaxform.parameter("Pa", above=0.0, least=2e4, most=8e4)
        second: jax.Array = jaxform.parameter("Pa", above=0.0)
        third: jax.Array = jaxform.parameter("Pa", above=-3e4)
        power: jax.Array = jaxform.parameter(above=1.0)
        share: jax.Array = jaxform.parameter(above=0.0, least=0.25, most=4.0)
        density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

        def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
            return self.first * i1

    monkeypatch.setitem(LAWS, "bounded", Bounded)
    made = numbers.make_numbers("bounded", 1, "christensen", 0, 1e5, None)
    np.testing.assert_allclose(made.values(made.lower), [2e4, 1e-4, -3e4, 1.0, 0.25], rtol=1e-12)
    np.testing.assert_allclose(made.values(made.upper), [8e4, np.inf, np.inf, np.inf, 4.0], rtol=1e-12)


def test_a_number_without_influence_is_not_at_its_bound() -> None:
    made = numbers.make_numbers("mooney-rivlin", 1, "christensen", 0, 1e5, None)
    slopes, left = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), np.array([0.1, 0.0, -0.1])
    problem: Any = SimpleNamespace(
        numbers=made, used=np.ones(3, bool), slopes=lambda free: slopes, differences=lambda free: left
    )
    found = solving.confidence_of(problem, np.array([2.0, 0.7]))
    assert found.at_bound.tolist() == [False, False] and found.without_influence.tolist() == [False, True]
    half = 1e5 * 12.7062047364 * np.sqrt(0.02 / 3)  # Student's t of one degree of freedom
    np.testing.assert_allclose([found.low[0], found.high[0]], [2e5 - half, 2e5 + half], rtol=1e-9)
    slopes[:, 1] = 1.0, 2.0, 3.0
    found = solving.confidence_of(problem, np.array([2.0, 1e-9]))
    assert found.at_bound.tolist() == [False, True] and not found.without_influence.any()


def _read(tmp_path: Path, text: str, name: str = "uniaxial.csv", before: str = "") -> Table:
    (tmp_path / name).write_text(text)
    return fitting.read_table(f"{before}{tmp_path / name}")


def test_what_columns_and_settings_mean(tmp_path: Path) -> None:
    strained = _read(tmp_path, "strain;Stress [Pa]\n0;0\n0.5;1e5\n1.0;2e5\n")
    assert isinstance(strained, Pull) and strained.stretch.tolist() == [1.5, 2.0]
    true = _read(tmp_path, "stretch\tcauchy_stress\n2\t4e5\n", "x.csv", before="pure-shear=")
    assert isinstance(true, Pull) and true.state == "pure-shear" and true.stress.tolist() == [2e5]
    held = _read(tmp_path, "# kind = relaxation\n# state = equibiaxial\n# stretch = 1.5\ntime,stress\n1,9e4\n2,8e4\n")
    assert isinstance(held, Pull) and (held.kind, held.state) == ("relaxation", "equibiaxial")
    assert held.stretch.tolist() == [1.5, 1.5] and held.time is not None and held.time.tolist() == [1.0, 2.0]
    blown = _read(tmp_path, "# radius = 0.05\n# thickness = 1e-3\npressure,height\n0,0\n2e3,0.02\n", "y.csv")
    assert isinstance(blown, Bubble) and blown.height.tolist() == [0.02] and blown.sheet == 1e-3


@pytest.mark.parametrize(
    ("before", "times"), [("0,0,0\n10,0,0\n", [0.125, 0.5]), ("", [10.125, 10.5])], ids=["late", "at once"]
)
def test_the_time_of_a_bubble_counts_from_its_last_flat_row(tmp_path: Path, before: str, times: list[float]) -> None:
    text = f"{DISC}time,pressure,height\n{before}10.125,2e3,0.02\n10.5,3e3,0.03\n"
    blown = _read(tmp_path, text, "y.csv")
    assert isinstance(blown, Bubble) and blown.time is not None and blown.time.tolist() == times
    assert blown.height.tolist() == [0.02, 0.03]


@pytest.mark.parametrize(
    ("name", "kind"),
    [("planar-tension", "pure-shear"), ("Biaxial_tension", "equibiaxial"), ("tension-2", "uniaxial")],
)
def test_a_name_that_says_what_test_it_is(tmp_path: Path, name: str, kind: str) -> None:
    assert _read(tmp_path, "stretch,stress\n2,1e5\n", f"{name}.csv").kind == kind


@pytest.mark.parametrize(
    ("name", "words"), [("uniaxial-relaxation", "more than one type"), ("simple-shear", "does not name its type")]
)
def test_a_name_that_does_not(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        _read(tmp_path, "stretch,stress\n2,1e5\n", f"{name}.csv")


DISC = "# radius = 0.05\n# thickness = 1e-3\n"
BAD = [
    ("", "is empty"),
    ("stretch,stress\n", "has no rows"),
    ("1.1,2e5\n1.2,3e5\n", "line of column names"),
    ("stretch,stress\n1.1,abc\n", "stress = 'abc': is not a finite number in line 2"),
    ("stretch,stress\n1.1,nan\n", "is not a finite number"),
    ("stretch;stress\n1,1;2e5\n", "stretch = '1,1'"),
    ("stretch,stress\n1.1,2,3\n", "3 cells in line 2"),
    ("stretch,stress [MPa]\n1.1,0.2\n", "is in MPa; give it in Pa"),
    ("strain [%],stress\n1.1,2e5\n", "is in %"),
    ("stretch,strain,stress\n1.1,0.1,2e5\n", "both stretch and strain"),
    ("stretch,stress,cauchy_stress\n1.1,2e5,2e5\n", "both stress and cauchy_stress"),
    ("stretch,stress,stress\n1.1,2e5,2e5\n", "two columns of the same name"),
    ("stretch,time\n1.1,1\n", "has no column stress"),
    ("stretch,stress\n0,0\n0.1,2e5\n", "name the column strain"),
    ("stretch,stress\n150,2e5\n", "more than any sheet withstands"),
    ("stretch,stress\n1,1e3\n", "no row with a strain"),
    ("stretch,stress\n1.1,0\n", "is 0 throughout"),
    ("# kind = relaxation\nstretch,stress\n1.1,2e5\n", "no column time"),
    ("# kind = relaxation\ntime,stretch,stress\n2,2,1e5\n1,2,1e5\n", "time = 1.0: does not increase"),
    ("# kind = relaxation\ntime,stretch,stress\n-2,2,1e5\n", "starts before 0"),
    ("# kind = relaxation\ntime,stretch,stress\n0,2,1e5\n", "time = 0.0: has no time after 0"),
    ("# kind = twisting\nstretch,stress\n1.1,2e5\n", "kind = 'twisting'"),
    ("pressure,height\n1e3,0.01\n", "radius: is missing"),
    ("# radius = wide\npressure,height\n1e3,0.01\n", "radius = 'wide': is not a positive number"),
    ("# radius = 0.05\n# thickness = 1e-3\npressure,height\n1e3,20\n", "give both in m"),
    (
        "# radius = 0.05\n# thickness = 1e-3\npressure,height,thickness\n1e3,0.02,0.9\n",
        "the wall thickness at the pole",
    ),
    ("# radius = 0.05\n# thickness = 1e-3\npressure,height\n0,0\n", "is inflated"),
    (
        f"{DISC}time,pressure,height\n1,2e3,0.02\n2,2e3,0\n3,2e3,0.02\n",
        "height = 0.0: is flat, or has no pressure, at 2 s",
    ),
    (f"{DISC}time,pressure,height\n2,2e3,0.02\n1,2e3,0.03\n", "time = 1.0: does not increase"),
    ("# kind = relaxation\n# stretch = 200\ntime,stress\n1,1e5\n", "stretch: reaches a stretch of"),
    ("# kind = relaxation\n# stretch = abc\ntime,stress\n1,1e5\n", "such as `# stretch = 2.0`, a ratio of lengths"),
]


@pytest.mark.parametrize(("text", "words"), BAD, ids=range(len(BAD)))
def test_a_table_that_is_refused(tmp_path: Path, text: str, words: str) -> None:
    name = "data.csv" if "pressure" in text or "kind" in text else "uniaxial.csv"
    with pytest.raises(InputError) as error:
        _read(tmp_path, text, name)
    assert words in str(error.value) and name in str(error.value) and error.value.remedy


DOUBTFUL = [
    ("strain,stress\n20,1e5\n50,2e5\n", "divide by 100 if it is in per cent"),
    ("stretch,stress\n1.5,0.1\n2,0.2\n", "give it in Pa, if it is in MPa"),
    ("stretch,stress\n0.5,1e5\n0.8,2e5\n", "is the column stretch a strain"),
    ("stretch,stress\n1.5,1e5\n2,0\n", "is slack or has torn"),
    ("stretch,stress,stres\n1.5,1e5,1\n", "did you mean stress"),
    ("# kin = uniaxial\nstretch,stress\n1.5,1e5\n", "did you mean kind"),
]


@pytest.mark.parametrize(("text", "words"), DOUBTFUL, ids=range(len(DOUBTFUL)))
def test_a_table_that_is_doubtful(tmp_path: Path, text: str, words: str) -> None:
    with pytest.warns(InputWarning, match=re.escape(words)):
        _read(tmp_path, text)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"model": "ogden", "weights": "none"}, "--weights = 'none'"),
        ({"model": "gent", "viscous": "foo"}, "--viscous = 'foo': is unknown; use christensen"),
        ({"model": "rubber"}, "--model = 'rubber'"),
        ({"model": "gent", "terms": 2}, "--terms = 2: has no effect on gent"),
        ({"model": "ogden", "terms": 7}, "--terms = 7: is out of range"),
        ({"model": "gent", "modes": 2}, "--modes = 2: needs tests with a column time"),
        ({"model": "gent"}, "2 measured values cannot determine 2 parameters"),
    ],
)
def test_options_that_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as error:
        fitting.fit([_pull("uniaxial", np.array([1.5, 2.0]), np.array([1e5, 2e5]))], **options)
    assert words in str(error.value)


def test_no_test_at_all_is_refused() -> None:
    with pytest.raises(InputError, match="tables: no test is given"):
        fitting.fit([], "gent")


def test_single_precision_is_refused() -> None:
    table = _pull("uniaxial", np.array([1.5, 2.0]), np.array([1e5, 2e5]))
    with jax.enable_x64(False), pytest.raises(InputError, match="double precision"):
        fitting.fit([table], "neo-hookean")


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(session, "cache_folder", lambda: None)
    stretch = np.linspace(1.1, 2.0, 10)
    lines = [f"{x},{3e5 * (x - x**-2)}" for x in stretch]
    (tmp_path / "tension.csv").write_text("\n".join(["stretch,stress", *lines]))
    arguments = ["fit", str(tmp_path / "tension.csv"), "--model", "neo-hookean"]
    assert command.main([*arguments, "--quiet"]) == 0
    assert tomllib.loads(capfd.readouterr().out)["material"] == {"model": "neo-hookean", "c": 1.5e5, "density": 1000.0}
    assert command.main([*arguments, "--out", str(tmp_path / "out"), "--density", "900"]) == 0
    assert "c = 150000 Pa (95 % interval" in capfd.readouterr().out
    written = tomllib.loads((tmp_path / "out" / "material.toml").read_text())
    assert written["material"]["density"] == 900.0
    facts = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert facts["tables"][0]["rows"] == 10 and facts["tables"][0]["mean_relative_error"] < 1e-9
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out" / "fit.csv").read_text())))
    np.testing.assert_allclose([float(row["fitted"]) for row in rows], 3e5 * (stretch - stretch**-2), rtol=1e-9)
    assert (tmp_path / "out" / "fit.png").read_bytes()[:4] == b"\x89PNG"
    assert command.main(arguments[:2] + arguments[1:]) == 2
    assert "is given twice" in capfd.readouterr().err


def test_a_kind_of_modes_that_no_test_tells_is_refused() -> None:
    stretch = np.linspace(1.1, 2.0, 8)
    table = _pull("uniaxial", stretch, 2e5 * (stretch - stretch**-2))
    with pytest.raises(InputError, match=r"--viscous = 'maxwell': cannot be used.*relaxation"):
        fitting.fit([table], "neo-hookean", viscous="maxwell")
