"""The bench's own check of its cameras: touched ends against where the pictures show them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench.record.reader import RunRecord, TrialRecord
from bench.results.attribution import Cause, attributed
from bench.results.cameras_agree import decide_cameras
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.scene import score_scene
from bench.script.model import CamerasRequirement

RULE = CamerasRequirement(kind="cameras_agree", name="cameras agree")
RNG_SEEDS = range(200)


def trials(
    disparity_px: float, poses: int = 12, seed: int = 0, thermal_px: float | None = 0.0
) -> list[TrialRecord]:
    """Poses of four ends that are measured with the scatter of rendered scenes (0.03 px)."""
    rng, found = np.random.default_rng(seed), []
    common = rng.normal(0.0, 0.3) / 9.0  # a truth that is off alike all through the run
    for pose in range(poses):
        truth = []
        for teat in range(4):
            seen = {
                "disparity_px": disparity_px + common + rng.normal(0, 0.03),
                "rows_px": rng.normal(0, 0.02),
                "thermal_px": [thermal_px, None],
                "mm_a_px": 9.0,
                "thermal_mm_a_px": 2.0,
                "deg_a_px": 0.0445,
            }
            truth.append(
                {"teat": str(teat), "cameras": json.dumps(seen), "u_mm": 0.3, "visible": 1}
            )
        head = {"id": str(pose), "name": str(pose), "invalid": None, "bath_state": "stable"}
        found.append(TrialRecord(head, truth=truth))
    return found


def decided(disparity_px: float, **more: int) -> Decision:
    return decide_cameras(RULE, trials(disparity_px, **more))


def test_twelve_poses_notice_half_a_pixel_and_accuse_no_sound_rig() -> None:
    off = [decided(0.5, seed=seed).verdict for seed in RNG_SEEDS]
    sound = [decided(0.0, seed=seed).verdict for seed in RNG_SEEDS]
    assert off.count(Verdict.NOT_MET) >= 0.95 * len(off)
    assert sound.count(Verdict.NOT_MET) <= 0.05 * len(sound)
    assert sound.count(Verdict.MET) >= 0.9 * len(sound)


def test_it_says_by_how_much_and_as_if_by_what() -> None:
    found = decided(0.5)
    assert found.measured == pytest.approx(0.5, abs=0.1)
    assert "as if the right camera were turned by 0.02°" in found.sentence
    assert "not a detector's" in found.sentence
    assert decided(0.25).verdict is Verdict.INCONCLUSIVE


def test_few_poses_and_other_pictures_show_nothing() -> None:
    assert decided(0.5, poses=2).verdict is Verdict.NOT_MEASURED
    unseen = [TrialRecord({"id": "1", "name": "1"}, truth=[{"teat": "1", "cameras": None}])]
    assert decide_cameras(RULE, unseen).verdict is Verdict.NOT_MEASURED
    assert decide_cameras(RULE, trials(0.0, thermal_px=2.0)).verdict is Verdict.NOT_MET


@pytest.mark.parametrize(("px", "cause"), [(0.0, Cause.DETECTOR), (0.8, Cause.CALIBRATION)])
def test_what_the_cameras_put_off_is_the_calibrations(px: float, cause: Cause) -> None:
    ends = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 60.0, 0.0], [60.0, 60.0, 0.0]])
    score = score_scene(
        ends + np.array([[0.0, 7.0, 0.0]] * 3 + [[0.0] * 3]),
        ends,
        np.ones(4, dtype=bool),
        u_mm=0.1,
        seconds=0.1,
        limit_mm=5.0,
        time_limit_s=2.0,
    )
    seen = trials(px)
    judged = TrialRecord(
        seen[0].head,
        truth=seen[0].truth,
        detections=({"detector": "d", "reason": None},),
        scores={"d": score},
    )
    facts = {"detectors": ["d"], "ending": "finished"}
    run = RunRecord(Path(), facts, (judged, *seen[1:]))
    assert {one.cause for one in attributed(run, "d")} == {cause}
