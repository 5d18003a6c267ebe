"""The bench's own check of its cameras: touched ends against where the pictures show them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.record.reader import RunRecord, TrialRecord
from bench.results.attribution import Cause, attributed
from bench.results.cameras_agree import (
    answers_of,
    cameras_of,
    decide_cameras,
    shift_text,
    unchecked_of,
)
from bench.rig.loading import RIGS, find_rig, load_rig
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.scene import score_scene
from bench.script.model import CamerasRequirement
from tests.bench.commands import Said, teatbench
from tests.plain_text import plain_text

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
                | dict.fromkeys(("x_mm", "y_mm", "z_mm"), 0.0)
            )
        head = {"id": str(pose), "name": str(pose), "invalid": None, "bath_state": "stable"}
        found.append(TrialRecord(head, truth=truth))
    return found


def run_of(made: list[TrialRecord]) -> RunRecord:
    return RunRecord(Path(), {"detectors": ["d"], "ending": "finished"}, tuple(made))


def decided(disparity_px: float, **more: int) -> Decision:
    return decide_cameras(RULE, cameras_of(run_of(trials(disparity_px, **more))))


@pytest.mark.slow
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
    unseen = [
        TrialRecord(
            {"id": "1", "name": "1", "invalid": None}, truth=[{"teat": "1", "cameras": None}]
        )
    ]
    assert decide_cameras(RULE, cameras_of(run_of(unseen))).verdict is Verdict.NOT_MEASURED
    assert (
        decide_cameras(RULE, cameras_of(run_of(trials(0.0, thermal_px=2.0)))).verdict
        is Verdict.NOT_MET
    )


def blind(told: int, ends: int = 48) -> list[TrialRecord]:
    """Twelve poses of which so many ends tell, by chance, a disparity of 9 px."""
    found = trials(9.0, thermal_px=None)
    nothing = {"disparity_px": None, "rows_px": None}
    for at in range(told, ends):
        row: dict[str, Any] = dict(found[at % 12].truth[at // 12])
        row["cameras"] = json.dumps(json.loads(row["cameras"]) | nothing)
        rows = list(found[at % 12].truth)
        rows[at // 12] = row
        found[at % 12] = replace(found[at % 12], truth=rows)
    return found


def test_what_is_off_beyond_what_can_be_measured_is_no_figure() -> None:
    for told in (0, 4):
        found = decide_cameras(RULE, cameras_of(run_of(blind(told))))
        assert found.verdict is Verdict.INCONCLUSIVE
        assert f"nly {told} of 48 ends measured in left and right" in found.sentence
        assert "more than 25 px of columns or 10 px of rows" in found.sentence
        assert found.measured is None
    cold = decide_cameras(RULE, cameras_of(run_of(trials(0.0, thermal_px=None))))
    assert cold.verdict is Verdict.INCONCLUSIVE
    assert "nly 0 of 48 ends measured in the thermal picture" in cold.sentence
    assert "48 of 48 ends measured" in decided(0.0).sentence


ENDS = np.array([[-110.2, 284.2, 134.2], [-161.9, 192.6, 137.6], [-260.6, 267.1, 136.3]])
TOLD = load_rig(find_rig(None)).calibration


def answered(seen_px: float, answers_px: float | None) -> list[TrialRecord]:
    """Six poses of cameras that are off by so much, and a detector whose answers are."""
    stated = TOLD if answers_px is None else TOLD.moved("right", "cx", answers_px)
    found_mm = stated.place(*TOLD.project(ENDS)) if answers_px is not None else ENDS[:0]
    truth: list[dict[str, Any]] = [
        {f"{axis}_mm": value for axis, value in zip("xyz", end, strict=True)}
        for end in ENDS.tolist()
    ]
    made = []
    for one in trials(seen_px, poses=6):
        rows = [{**row, **place} for row, place in zip(one.truth, truth, strict=False)]
        score = score_scene(
            found_mm, ENDS, [True] * 3, u_mm=0.3, seconds=0.1, limit_mm=5.0, time_limit_s=2.0
        )
        detections = ({"detector": "d", "reason": "cameras disagree"},)
        made.append(TrialRecord(one.head, truth=rows, detections=detections, scores={"d": score}))
    return made


@pytest.mark.parametrize(
    ("seen_px", "answers_px", "words", "cause"),
    [
        (0.8, 0.8, "calibration, not detector", Cause.CALIBRATION),
        (0.0, 0.8, "detector, not calibration", Cause.DETECTOR),
        (-0.8, 0.8, "detector, not calibration", Cause.DETECTOR),
        (0.8, None, "", Cause.CALIBRATION),  # it found nothing at all
        (0.0, None, "", Cause.DETECTOR),
        (0.8, 0.0, "", None),
    ],
)
def test_a_shift_of_the_answers_is_the_cameras_only_where_they_have_it_too(
    seen_px: float, answers_px: float | None, words: str, cause: Cause | None
) -> None:
    run = run_of(answered(seen_px, answers_px))
    answers = answers_of(run, "d", TOLD)
    apart = shift_text(cameras_of(run), answers, 0.25)
    assert apart.endswith(words)
    assert bool(words) == bool(apart)
    if answers_px is not None:
        assert answers is not None
        assert answers.value == pytest.approx(answers_px, abs=0.02)
    assert {one.cause for one in attributed(run, "d", TOLD)} == ({cause} if cause else set())


def test_a_run_says_how_many_ends_its_cameras_were_checked_on() -> None:
    def said(made: list[TrialRecord]) -> str:
        return unchecked_of(made, cameras_of(run_of(made)))

    assert said(trials(0.0)) == ""
    few = trials(0.0, poses=2)
    assert said(few).endswith("where they are (8 of 8 visible ends measured in 2 poses)")
    for trial in few:
        for row in trial.truth:
            row["cameras"] = None  # type: ignore[index]  # rows are dicts here
    assert said(few).endswith("(0 of 8 visible ends measured in 2 poses)")
    assert said([]).endswith("(0 of 0 visible ends measured in 0 poses)")


@pytest.fixture(scope="module")
def off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose calibration is off by half a pixel of column."""
    out = tmp_path_factory.mktemp("off") / "recording"
    line = "scene record --situation ideal --seeds 3 --seed 7 --perturb column=0.5 --out {}"
    assert teatbench(line, out) == 0
    return out


@pytest.mark.slow
def test_a_calibration_is_checked_on_touched_ends(off: Path, said: Said, tmp_path: Path) -> None:
    line = "calibrate check {} --ends {} --page {}"
    found = said(1, line, off / "calibration.toml", off, tmp_path / "page")
    assert "12 of 12 ends measured\ndisparity off by 0.5" in found.out
    assert "It no longer holds." in found.out
    assert "calibrate again ('calibrate cameras'" in found.err
    assert "What touched teat ends are off" in plain_text(tmp_path / "page" / "index.html")
    sound = RIGS / "calibration.toml"
    assert "It still holds." in said(0, line, sound, off, tmp_path / "page").out
    refusal = said(2, "calibrate check {} PICTURES --ends {}", sound, off).err
    assert "in the place of pictures" in refusal
    shutil.copytree(off / "frames", tmp_path / "bare" / "frames")
    bare = said(2, "calibrate check {} --ends {}", sound, tmp_path / "bare").err
    assert "no frames with visible known ends" in bare


@pytest.mark.slow
def test_a_recording_s_cameras_are_checked_as_a_run_s(
    off: Path, said: Said, tmp_path: Path
) -> None:
    scored = said(1, "score {} --detector fused --out {}", off, tmp_path).out
    assert "The bench has to be put right first: cameras agree with the truth." in scored
    (run,) = tmp_path.iterdir()
    page = plain_text(run / "report" / "index.html")
    assert "Cameras and answers against the known ends" in page
    assert "12 of 12 ends measured" in page


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
    assert {one.cause for one in attributed(run_of([judged, *seen[1:]]), "d")} == {cause}
