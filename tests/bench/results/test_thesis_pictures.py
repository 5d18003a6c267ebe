"""The thesis's criterion on ends that are put off by known pixels."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from bench.record.reader import TrialRecord
from bench.results.thesis_pictures import in_pictures
from bench.rig.loading import find_rig, load_rig
from detector.geometry import Array
from tests.bench.results.test_error_rows import trial

CALIBRATION = load_rig(find_rig(None)).calibration
ENDS = np.array([[-110.2, 284.2, 134.2], [-161.9, 192.6, 137.6], [-260.6, 267.1, 136.3]])


def answered(off_px: Array, refined_px: Array, extra: bool = False) -> TrialRecord:
    """Three ends of which each picture's nominations are off by (3, 2) px, and refined ones."""
    left, right = CALIBRATION.project(ENDS)
    lens, pose = CALIBRATION.thermal.lens, CALIBRATION.thermal_from_right
    assert lens is not None
    assert pose is not None
    thermal = lens.project(pose.apply(CALIBRATION.world_from_right.inverse().apply(ENDS)))

    def points(true: Array, off: Array) -> list[list[float]]:
        return [*(true + off).tolist(), *([[20.0, 20.0]] if extra else [])]

    trace: dict[str, Any] = {"thermal": {}, "edges": {}}
    trace["teat ends"] = {"points_px": points(thermal, off_px)}
    for stage, off in {"nominations": off_px, "ends": refined_px}.items():
        trace[stage] = {"left_px": points(left, off), "right_px": points(right, off)}
    one = trial(1, "a", 1, ENDS, ENDS, situation="spurious_teat")
    detections = ({"detector": "thesis", "trace": json.dumps(trace)},)
    return TrialRecord(one.head, truth=one.truth, detections=detections)


def test_what_lies_on_the_rounded_end_counts_and_what_lies_beside_it_does_not() -> None:
    # above the end, at the middle of the rounded end, beside the teat; a radius is 13 px
    off = np.array([[0.0, -6.0], [0.0, 12.0], [17.0, 0.0]])
    refined = np.array([[0.0, -18.0], [3.0, 4.0], [0.0, 5.0]])
    seen = in_pictures([answered(off, refined, extra=True)], "thesis", CALIBRATION)
    assert seen is not None
    np.testing.assert_array_equal(seen.on_end[:, 1], [True, True, False])
    np.testing.assert_array_equal(seen.on_end[:, (2, 4)].all(axis=1), [False, True, True])
    np.testing.assert_allclose(seen.off_px[:, 3], [6.0, 12.0, 17.0])
    np.testing.assert_allclose(seen.off_px[:, 4], [18.0, 5.0, 5.0])
    assert seen.moved(seen.of("spurious_teat")) == (4, 2)  # in either picture
    assert seen.moved(seen.of(teat="1")) == (0, 2)
    assert seen.astray == {"spurious_teat": 1}
    # the same way in both pictures: across the line of sight, some 0.85 mm a pixel
    assert seen.off_mm[2, 0] == pytest.approx(17 * 0.85, abs=1.0)


def test_no_answer_is_no_end_and_other_detectors_have_no_such_score() -> None:
    one = answered(np.zeros((3, 2)), np.zeros((3, 2)))
    nothing: dict[str, Any] = {"thermal": {}, "edges": {}}
    silent = TrialRecord(
        one.head,
        truth=one.truth,
        detections=({"detector": "thesis", "trace": json.dumps(nothing)},),
    )
    seen = in_pictures([silent], "thesis", CALIBRATION)
    assert seen is not None
    assert not seen.on_end.any()
    assert np.isnan(seen.off_px).all()
    assert in_pictures([one], "fused", CALIBRATION) is None
    odd = {**nothing, "teat ends": {"points_px": [["a"]]}}
    other = TrialRecord(
        one.head, truth=one.truth, detections=({"detector": "thesis", "trace": json.dumps(odd)},)
    )
    found = in_pictures([other], "thesis", CALIBRATION)
    assert found is not None
    assert not found.on_end.any()
