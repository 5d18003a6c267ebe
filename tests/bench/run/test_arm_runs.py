"""The arm's place in a run: moved elsewhere on the table it scores the same, and what ruins its
readings is found out.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.calibrate.arm import VerificationPlan, touch_frame, verify
from bench.calibrate.simulated_arm import SimulatedArm, TouchStep
from bench.config import write_file
from bench.record.reader import RunRecord, read_run
from bench.results.stated_arm import unmoved_mm
from bench.results.verdicts import judge, stored_rules
from bench.rig.arm_files import VerificationLimits, frame_text, verification_text
from bench.rig.model import ArmTable
from bench.scoring.decisions import Verdict
from bench.truth.arm_check import check_arm, location_of, moved_mm, new_touches, shift_mm
from bench.truth.touching import TipReader
from detector.geometry import Motion
from instruments.clock import wall_time
from instruments.operators.operator import CheckPoint, Request
from tests.bench.calibrate.arm_rig import Follower, emulated
from tests.bench.commands import teatbench
from tests.bench.operated_runs import shipped_rig, texts

pytestmark = pytest.mark.slow

WARM = "bath_start_c = 33.0\n"  # heating twelve litres would be half of each run
PLACED = Motion.from_vectors((0.015, -0.01, 0.4), (-40.0, -60.0, 9.0))
REQUIREMENT = "arm verified before and after"


@pytest.fixture(scope="module")
def script(short_script: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first trial of the six situations."""
    first = "[[trials]]".join(short_script.read_text(encoding="utf-8").split("[[trials]]")[:2])
    path = tmp_path_factory.mktemp("script") / "one.toml"
    path.write_text(first.replace("thesis", "fused"), encoding="utf-8")
    return path


@dataclass(frozen=True)
class Done:
    code: int
    run: RunRecord

    @property
    def verdict(self) -> Verdict:
        (judgement,) = judge(self.run, stored_rules(self.run.folder))
        return next(
            decision.verdict for decision in judgement.decisions if decision.name == REQUIREMENT
        )

    @property
    def page(self) -> str:
        return (self.run.folder / "report" / "index.html").read_text(encoding="utf-8")

    @property
    def off_mm(self) -> np.ndarray:
        """How far each touched truth lies from the scene's exact end (n, 3)."""
        rows = [row for trial in self.run.trials for row in trial.truth]
        return np.array(
            [np.array([r["x_mm"], r["y_mm"], r["z_mm"]]) - json.loads(r["exact_mm"]) for r in rows]
        )


def done(rig: Path, script: Path, out: Path) -> Done:
    code = teatbench("run {} --rig {} --out {}", script, rig, out)
    (folder,) = out.iterdir()
    return Done(code, read_run(folder))


def arm_files(folder: Path) -> None:
    """The frame and the verification of the arm that stands at PLACED, made as a person would."""
    now = wall_time().replace(microsecond=0)
    with emulated(seed=1, placed=PLACED) as (arm, trying):
        write_file(
            folder / "arm-frame.toml", frame_text(touch_frame(Follower(arm, trying), [None], now))
        )
        found = verify(Follower(arm, trying), VerificationPlan(1, 5, 300.0, 2), now)
        write_file(
            folder / "arm-verification.toml",
            verification_text(found, VerificationLimits(0.46, 0.7)),
        )


@pytest.fixture(scope="module")
def in_place(script: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp("in-place")
    return done(shipped_rig(folder, "", WARM), script, folder / "runs")


@pytest.fixture(scope="module")
def elsewhere(script: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp("elsewhere")
    arm_files(folder)
    keys = 'frame = "arm-frame.toml"\nverification = "arm-verification.toml"\n'
    placed = f"arm_placed = {{ om = {PLACED.om.tolist()}, T = {PLACED.T.tolist()} }}\n"
    return done(shipped_rig(folder, keys, WARM + placed), script, folder / "runs")


def test_an_arm_elsewhere_scores_like_one_in_its_place(in_place: Done, elsewhere: Done) -> None:
    assert in_place.run.ending == elsewhere.run.ending == "finished"
    one, other = (d.run.trials[0].scores["fused"] for d in (in_place, elsewhere))
    assert one.counts == other.counts
    assert np.allclose(one.radial_mm, other.radial_mm, atol=1.5), (
        "the truth differs by the arm's noise and the frame's"
    )
    for run in (in_place, elsewhere):
        assert np.linalg.norm(run.off_mm, axis=1).max() < 1.5
    assert not np.allclose(one.radial_mm, other.radial_mm, atol=1e-6)


def test_the_frame_has_its_line_in_the_uncertainty_budget(in_place: Done, elsewhere: Done) -> None:
    def budget(run: Done) -> dict[str, float]:
        return {
            line["name"]: line["u_mm"]
            for line in json.loads(run.run.trials[-1].truth[-1]["budget"])["components"]
        }

    assert "registration" not in budget(in_place)
    assert 0.1 < budget(elsewhere)["registration"] < 0.8
    u_mm = [row["u_mm"] for row in elsewhere.run.trials[0].truth]
    assert min(u_mm) > max(row["u_mm"] for row in in_place.run.trials[0].truth)
    assert np.abs(elsewhere.off_mm).max() < 3.0 * max(u_mm)


def test_the_arm_is_checked_before_and_after(in_place: Done, elsewhere: Done) -> None:
    for run in (in_place, elsewhere):
        assert run.verdict is Verdict.MET
        first, last = (run.run.facts[f"arm check {when}"] for when in ("before", "after"))
        assert len(first["touches"]) == 5
        new = new_touches(last)
        assert new == 1 or (new == 5 and moved_mm(first, last) < 0.52), "as five after five may"
        assert last["touches"][:-new] == first["touches"][: 5 if new == 1 else 0]
        assert max(t["t_s"] for t in first["touches"]) < run.run.trials[0].head["started_s"]
        assert min(t["t_s"] for t in last["touches"][-new:]) > run.run.trials[-1].head["ended_s"]
        assert (location_of(first, "").swing_deg or 0.0) > 40.0


def test_the_report_shows_frame_verification_and_checks(in_place: Done, elsewhere: Done) -> None:
    page = elsewhere.page
    assert "World frame: the table" in page
    assert "arm-frame.toml" in page
    assert f"{wall_time():%Y-%m-%d}" in page
    assert "Verification of arm 40937" in page
    assert "A calibrated length, measured in several directions" in page
    for said in (page, in_place.page):
        assert "The arm before and after the trials" in said
        assert REQUIREMENT in said
    assert "the arm&#39;s own" in in_place.page or "the arm's own" in in_place.page
    assert "names no dated verification" in in_place.page


def test_the_runs_folder_keeps_the_files_of_the_arm(elsewhere: Done) -> None:
    rig = elsewhere.run.folder / "rig.toml"
    assert 'frame = "arm-frame.toml"' in rig.read_text(encoding="utf-8")
    assert (elsewhere.run.folder / "arm-frame.toml").is_file()
    assert (elsewhere.run.folder / "arm-verification.toml").is_file()
    assert teatbench("check {}", rig) == 0, "the folder's own rig file can be used again"


def test_the_frame_of_another_arm_ends_the_run_before_anything_is_heated(
    script: Path, tmp_path: Path
) -> None:
    arm_files(tmp_path)
    file = tmp_path / "arm-frame.toml"
    text = file.read_text(encoding="utf-8").replace('"40937"', '"40938"')
    file.write_text(text, encoding="utf-8")
    run = done(shipped_rig(tmp_path, 'frame = "arm-frame.toml"\n'), script, tmp_path / "runs")
    assert run.code == 3
    assert run.run.ending == "faulted"
    (fault,) = texts(run.run, "fault")
    assert "table frame is of the arm 40938, but the arm that answers is 40937" in fault
    assert not any("heating" in event["text"] for event in run.run.events)


class Checker:
    """Touches one place of an emulated arm's world, swung another way each time."""

    def __init__(self, trying: SimulatedArm) -> None:
        self._trying = trying

    def ask(self, request: Request) -> None:
        if isinstance(request, CheckPoint):
            self._trying.go(TouchStep("middle", request.touch - 1, ""))


def checked(
    spoil: Callable[[SimulatedArm], None], before: dict[str, Any] | None = None
) -> dict[str, Any]:
    settings = ArmTable(url="emulator:", check_point_mm=(330.0, 0.0, 20.0))
    near_mm = unmoved_mm([], settings)
    with emulated() as (arm, trying):
        spoil(trying)
        arm.sign_on()
        arm.confirm_homed()
        tip = TipReader(arm, settings, None)
        return check_arm(
            Checker(trying).ask, tip, settings, trying.clock, lambda: None, before, near_mm
        )


def test_an_arm_that_was_not_homed_is_found_out() -> None:
    """Switched on with the stylus off its peg, and a person who says that it was on."""

    def off_its_peg(trying: SimulatedArm) -> None:
        trying.go(TouchStep("near", 0, ""))
        trying.emulator.power_cycle()

    good = checked(lambda trying: None)
    assert shift_mm(good) < 1.0
    assert shift_mm(checked(off_its_peg)) > 20.0
    # one touch shows that nothing moved since an earlier check, whose touches count
    again = checked(lambda trying: None, good)
    assert (len(again["touches"]), new_touches(again)) == (len(good["touches"]) + 1, 1)
    assert moved_mm(good, again) < unmoved_mm([], ArmTable(url="emulator:"))
    spoilt = checked(off_its_peg, good)
    assert len(spoilt["touches"]) == new_touches(spoilt) == len(good["touches"])
    assert shift_mm(spoilt) > 20.0
