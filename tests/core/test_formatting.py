"""Numbers, shares and places in words."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jaxform.core import errors
from jaxform.io.report import page

ROOT = Path(__file__).parents[2]


def test_coordinates_do_not_show_what_rounding_makes_of_0() -> None:
    assert errors.format_place(np.array([-9.797e-18, -0.0, 0.02])) == "(0, 0, 0.02) m"
    assert errors.format_coordinate(-1e-18, 1e3, 3) == "0" and errors.format_coordinate(0.0123456, 1e3, 3) == "12.3"
    assert (
        errors.format_extent(np.array([-0.0376, -9.797e-18]), np.array([0.1624, 1e-9]))
        == "-0.0376 to 0.1624 x 0 to 1e-09 m"
    )


def test_numbers_are_rounded_and_have_exponents_only_where_they_are_long() -> None:
    numbers = [(103.0, 2), (7946.0, 2), (39000.0, 3), (1e6, 4), (0.0, 4), (0.012345, 3), (1.2e9, 2)]
    texts = ["100", "7900", "39000", "1000000", "0", "0.0123", "1.2e+09"]
    assert [errors.format_number(*each) for each in numbers] == texts


def test_shares_in_per_cent_have_two_digits_and_no_exponent() -> None:
    shares = {1.0: "100 %", 0.996: "100 %", 12.34: "1200 %", 0.01234: "1.2 %", 0.0: "0 %", 3e-8: "3e-06 %"}
    assert [errors.format_percent(share) for share in shares] == list(shares.values())


def test_large_shares_in_per_cent_have_no_exponent_anywhere() -> None:
    """One function formats each share in a text: a coefficient of variation of 1200 % was printed as 1.2e+03 %."""
    assert errors.format_percent(12.0, 3) == "1200 %" and errors.format_percent(0.1234, 3) == "12.3 %"
    assert page.number(12.345, 100, 3) == "1230"
    by_hand = re.compile(r"\.\dg\} ?%")
    modules = [path for folder in ("jaxform", "optimize") for path in (ROOT / folder).rglob("*.py")]
    assert len(modules) > 100
    found = [path.name for path in modules if by_hand.search(path.read_text(encoding="utf-8"))]
    assert found == ["page.py"]  # the width of a bar, in CSS
