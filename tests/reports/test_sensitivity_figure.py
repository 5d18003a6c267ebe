"""The plot of errors over a quantity: any amount of data, stable bytes, the style sheet's colours,
and what it refuses.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from reports.figures.drawing import COLOURS
from reports.figures.sensitivity import Bound, Curve, sensitivity
from reports.trust import svg_facts

X = np.array([0.1, 1.0, 10.0])


def _curve(name: str, n: int = 3) -> Curve:
    return Curve(name, X[:n], [0.2, 0.3, 0.9][:n], [0.5, 0.8, 4.0][:n], X, [1.0, 1.0, 0.25])


def _bound() -> Bound:
    return Bound(X, [0.01, 0.02, 0.05], [0.2] * 3, 0.03, X, [1.0, 1.0, 0.9])


@pytest.mark.parametrize("found", [0, 1, 3])
@pytest.mark.parametrize("logarithmic", [True, False])
def test_any_amount_of_data_makes_a_sound_and_stable_drawing(found: int, logarithmic: bool) -> None:
    svg = sensitivity(
        [_curve("fused", found), _curve("thesis")], _bound(), "NETD (K)", logarithmic=logarithmic
    )
    assert svg == sensitivity(
        [_curve("fused", found), _curve("thesis")], _bound(), "NETD (K)", logarithmic=logarithmic
    )
    facts = svg_facts(svg, "drawing")
    assert facts.ids == tuple(dict.fromkeys(facts.ids))
    assert set(re.findall(r'(?:fill|stroke)="([^"]*)"', svg)) <= {"none", *COLOURS.values()}
    for text in (
        "fused",
        "thesis",
        "NETD (K)",
        "limit by noise",
        "disparity to 0.03 px",
        "found of visible",
    ):
        assert text in svg
    assert "nan" not in svg.lower()


def test_a_quantity_without_a_measurement_says_so() -> None:
    empty = Curve("fused", [], [], [], [], [])
    assert "not measured" in sensitivity([empty], Bound([], [], [], 0.03), "range (m)")


def test_a_limit_of_no_share_is_left_out() -> None:
    without = replace(_bound(), share_x=(), share=())
    assert sensitivity([_curve("fused")], without, "range (m)") != sensitivity(
        [_curve("fused")], _bound(), "range (m)"
    )


def test_what_has_no_place_is_refused() -> None:
    with pytest.raises(ValueError, match="not above 0 mm has no place"):
        sensitivity([replace(_curve("a"), median_mm=[0.0, 0.1, 0.2])], _bound(), "x")
    with pytest.raises(ValueError, match="lengths differ: x 3, median_mm 2"):
        sensitivity([replace(_curve("a"), median_mm=[0.1, 0.2])], _bound(), "x")
    with pytest.raises(ValueError, match="not finite"):
        sensitivity([_curve("a")], replace(_bound(), median_mm=[0.1, np.nan, 0.2]), "x")
    with pytest.raises(ValueError, match="5 curves; at most 4"):
        sensitivity([_curve(name) for name in "abcde"], _bound(), "x")
