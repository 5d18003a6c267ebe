"""What is drawn over a frame lies where it should: ellipses of a stated covariance, stages of any
detector, models of the fused one.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from bench.record.reader import TrialRecord
from bench.report.trials import NAMES, overlays, project_all
from bench.rig.loading import find_rig, load_rig
from detector.calibration import Calibration
from reports.frames import Ellipse, Overlay, Polyline, Rect

END = np.array([-110.0, 284.0, 136.0])


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_rig(find_rig("emulated")).calibration


def trial(trace: dict[str, Any], covariance: list[list[float]] | None = None) -> TrialRecord:
    place = dict(zip(("x_mm", "y_mm", "z_mm"), END.tolist(), strict=True))
    truth = {"teat": "1", "visible": 1, **place}
    found = {"detector": "d", "number": 1, "left_px": "[10.0, 20.0]", "right_px": None, **place}
    found["covariance_mm2"] = None if covariance is None else json.dumps(covariance)
    detection = {"detector": "d", "trace": json.dumps(trace)}
    return TrialRecord({"number": 1, "id": "001"}, (), (), (truth,), (detection,), (found,), {})


def shapes(found: tuple[Overlay, ...], tone: str) -> tuple[Any, ...]:
    return next(one.shapes for one in found if one.tone == tone)


def test_a_covariance_is_the_ellipse_that_samples_fill(calibration: Calibration) -> None:
    """Drawn ends, projected one by one: 95 % of them lie in the ellipse, in each camera."""
    covariance = np.array([[0.09, 0.02, 0.0], [0.02, 4.0, 0.3], [0.0, 0.3, 0.16]])
    drawn = np.random.default_rng(5).multivariate_normal(END, covariance, 40_000)
    for camera in ("left", "right", "thermal"):
        seen = project_all(calibration, drawn)[camera]
        assert seen is not None
        found = overlays(trial({}, covariance.tolist()), camera, None, calibration)
        (ellipse,) = shapes(found, "spread")
        assert isinstance(ellipse, Ellipse)
        turn = np.radians(ellipse.turn_deg)
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        off = (seen - [ellipse.x_px, ellipse.y_px]) @ axes.T
        along = off / [ellipse.major_px, ellipse.minor_px]
        assert (np.linalg.norm(along, axis=1) <= 1).mean() == pytest.approx(0.95, abs=0.005)
        assert ellipse.major_px >= ellipse.minor_px


@pytest.mark.parametrize("stated", [None, [[np.nan] * 3] * 3, [[1.0, 2.0]]])
def test_what_is_no_covariance_is_not_drawn(
    calibration: Calibration, stated: list[list[float]] | None
) -> None:
    found = overlays(trial({}, stated), "left", None, calibration)
    assert "spread" not in [one.tone for one in found]


def test_any_detector_shows_its_stages_by_their_pixels(calibration: Calibration) -> None:
    trace = {
        "nominations": {"left_px": [[1.0, 2.0]]},
        "my stage": {"left_px": [[3.0, 4.0], [None, 5.0]]},
        "odd": {"left_px": "nonsense"},
    }
    found = overlays(trial(trace), "left", None, calibration)
    assert {one.tone for one in found if len(one.shapes) == 1} == {"nomination", "point", "other"}
    assert len(found) == 3
    assert shapes(found, "other")[0].title == "d: my stage"
    assert {one.name for one in found} <= set(NAMES.values())


def test_stages_of_a_known_name_and_another_form_are_not_drawn(calibration: Calibration) -> None:
    """Whoever writes a detector may call a stage as the bench's own are called."""
    rows: list[Any] = [["a", "b"], [[1.0, 2.0], [3.0]], [1.0, 2.0, 3.0]]
    for value in [*rows, {"shape": [500], "type": "float64"}, 7, None]:
        keys = ("left", "left_px", "points_px", "teats", "reasons", "end_px")
        stages = ("regions", "nominations", "decisions", "teat ends", "thermal", "mine")
        odd_trial = trial(dict.fromkeys(stages, dict.fromkeys(keys, value)))
        for camera in ("left", "thermal"):
            found = overlays(odd_trial, camera, None, calibration)
            assert {one.tone for one in found} <= {"point"}


def test_regions_lie_round_their_nominations(calibration: Calibration) -> None:
    trace = {
        "nominations": {"left_px": [[100.0, 50.0]]},
        "regions": {"left": {"shape": [1, 41, 21]}},
    }
    (region,) = shapes(overlays(trial(trace), "left", None, calibration), "region")
    assert isinstance(region, Rect)
    assert (region.x_px, region.y_px, region.width_px, region.height_px) == (89.5, 29.5, 21, 41)


def test_a_fitted_teat_s_outline_goes_over_its_end(calibration: Calibration) -> None:
    """A ball on an upright axis: the outline's highest point lies at the end's pixel."""
    end = calibration.world_from_right.inverse().apply(END[None])[0]
    teat = [end[0], end[1] + 11.0, end[2], 0.0, 0.0, 11.0, 0.0, 1.0]
    trace = {"decisions": {"teats": [teat, teat], "reasons": ["", "its place is too unsure"]}}
    at = project_all(calibration, END[None])
    for camera in ("left", "right", "thermal"):
        found = overlays(trial(trace), camera, None, calibration)
        (model,) = shapes(found, "model")
        assert isinstance(model, Polyline)
        top = min(model.points_px, key=lambda point: point[1])
        assert np.allclose(top, at[camera][0], atol=3.0)  # type: ignore[index]
        assert shapes(found, "other")[-1].title == "d: rejected, its place is too unsure"


def test_truth_is_named_and_hidden_ends_are_reported(calibration: Calibration) -> None:
    one = trial({})
    hidden = TrialRecord(one.head, (), (), ({**one.truth[0], "visible": 0},), (), (), {})
    found = overlays(hidden, "left", np.array([[5.0, 6.0]]), calibration)
    ring, name = shapes(found, "truth")
    assert (ring.title, name.text) == ("truth 1 (hidden)", "1")
    assert overlays(hidden, "left", np.array([[np.nan, 6.0]]), calibration) == ()
