"""The gate for calibrations: none that a camera has is refused, each that none has is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, assume, example, given, settings
from hypothesis import strategies as st

from detector.calibration.gate import folds, lens_faults, pair_faults
from detector.geometry import Camera, Motion
from tests.examples import examples

FEW = examples(10)


@st.composite
def sound_lenses(draw: st.DrawFn) -> Camera:
    """Over the range that cameras have: phones to telescopes, chips of 80 to 12 000 columns."""
    width = draw(st.integers(80, 12_000))
    height = max(60, int(width * draw(st.floats(0.5, 1.4))))
    focal = max(width, height) * 10 ** draw(st.floats(-0.5, 1.3))
    aspect = draw(st.sampled_from((1.0, 1.0, 1.0005, 0.97, 12 / 11, 10 / 11)))
    centre = [n * (0.5 + draw(st.floats(-0.15, 0.15))) for n in (width, height)]
    lens = Camera((width, height), (focal, focal * aspect), (centre[0], centre[1]))
    rim = math.hypot(width, height) / focal / 1.6  # tangent of the angle at the farthest corner
    kc = [draw(st.floats(-limit, limit)) for limit in (0.28, 0.12, 0.004, 0.004, 0.03)]
    scale = (rim**2, rim**4, rim, rim, rim**6)
    k1, k2, p1, p2, k3 = (one / max(each, 1e-9) for one, each in zip(kc, scale, strict=True))
    return replace(lens, kc=(k1, k2, p1, p2, k3))


def one_to_one(lens: Camera) -> bool:
    """By a witness of its own: pixels go out with the angle, in steps towards 36 places of the
    picture's rim, until there.
    """
    width, height = lens.image_size
    places = [(x, y) for x in (0, 0.5, 1) for y in np.linspace(0.0, 1.0, 12)]
    for x, y in places:
        towards = (np.array([x * width, y * height]) - lens.cc) / lens.fc
        ray = np.outer(np.linspace(0.0, 4.0, 2000), towards)
        pixels = lens.project(np.column_stack([ray, np.ones(len(ray))]))
        outside = (pixels < 0).any(axis=1) | (pixels > (width, height)).any(axis=1)
        last = int(np.argmax(outside)) if outside.any() else len(pixels)
        away = np.hypot(*((pixels[:last] - lens.cc) / lens.fc).T)
        if (np.diff(away) <= 0).any():
            return False
    return True


def check_sound(lens: Camera) -> None:
    assume(one_to_one(lens))
    assert not list(lens_faults(lens))


@pytest.mark.slow
@settings(max_examples=FEW, phases=[Phase.generate])
@given(sound_lenses())
def test_no_lens_that_cameras_have_is_refused(lens: Camera) -> None:
    check_sound(lens)


@pytest.mark.parametrize(
    "kc",
    [
        (-0.5, 0.0, 0.0, 0.0, 0.0),
        (0.1, -0.2, 0.0, 0.0, -3.0),  # k3 for k2
        (-0.2, 0.0, 0.6, 0.0, 0.0),  # k2 for p1
        (0.5, -5.0, 0.0, 0.0, 0.0),
    ],
)
def test_a_lens_that_folds_is_found_by_both_witnesses(kc: tuple[float, ...]) -> None:
    k1, k2, p1, p2, k3 = kc
    lens = Camera((1280, 960), (800.0, 800.0), (640.0, 480.0), 0.0, (k1, k2, p1, p2, k3))
    assert not one_to_one(lens)
    assert folds(lens)
    far = replace(lens, fc=(20_000.0, 20_000.0))  # a narrow lens uses its middle alone
    assert one_to_one(far)
    assert not folds(far)


ANY_SIZE = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.tuples(*[ANY_SIZE.filter(bool)] * 2), st.tuples(*[ANY_SIZE] * 2), st.tuples(*[ANY_SIZE] * 5)
)
@example((1e-310, 800.0), (640.0, 480.0), (0.1, 0.0, 0.0, 0.0, 0.0))
@example((800.0, -1e-310), (1e308, 480.0), (1e308, -1e308, 0.0, 0.0, 0.0))
def test_numbers_of_any_size_make_sentences(
    fc: tuple[float, float], cc: tuple[float, float], kc: tuple[float, float, float, float, float]
) -> None:
    """A warning of numpy fails a test."""
    for key, said in lens_faults(Camera((1280, 960), fc, cc, 1e300, kc)):
        assert key in ("fc", "cc", "kc", "alpha_c")
        assert said


@given(
    st.floats(3.5, 4000.0),
    st.lists(st.floats(-0.35, 0.35), min_size=3, max_size=3),
    st.lists(st.floats(-0.3, 0.3), min_size=2, max_size=2),
)
def test_no_pair_that_sees_depth_is_refused(
    baseline_mm: float, om_rad: list[float], off: list[float]
) -> None:
    place = baseline_mm * np.array([1.0, *off])
    turn = Motion.from_vectors(om_rad, np.zeros(3)).R
    pair = Motion(turn, -turn @ place)
    assert not list(pair_faults(pair)) or np.linalg.norm(place) > 5000.0


@pytest.mark.parametrize(
    ("om_rad", "T_mm", "why"),
    [
        ((0.0, 0.0, 0.0), (-0.12, 0.0, 0.0), "looks like metres: 120 mm are meant"),
        ((0.0, 0.0, 0.0), (-120_000.0, 0.0, 0.0), "looks like micrometres: 120 mm are meant"),
        ((0.0, 0.0, 0.0), (120.0, 0.0, 0.0), "120 mm to the left of the left one"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "is none that a stereo pair has"),
        ((0.0, 2.0, 0.0), (-50.0, 0.0, 110.0), "look 115 degrees apart"),
    ],
)
def test_a_pair_that_sees_no_depth_is_named(
    om_rad: tuple[float, ...], T_mm: tuple[float, ...], why: str
) -> None:
    assert any(why in one for one in pair_faults(Motion.from_vectors(om_rad, T_mm)))
