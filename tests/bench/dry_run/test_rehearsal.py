"""A rehearsal: it names what would end the run by its trial, and leaves nothing behind."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from bench.dry_run.rehearsal import Rehearsal, rehearse
from bench.rig.loading import LoadedRig, load_rig
from bench.script.model import LoadedScript, load_script
from detector.protocol import Detection, DetectionFailure
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files

pytestmark = pytest.mark.slow

FAR = "{ x_mm = 12.0, y_mm = -8.0 }"
ANSWERS = (
    '[[answers]]\nto = "touch"\nanswer = "{}"\n\n[otherwise]\nhoming = "go"\n"set up" = "go"\ntouch'
    ' = "go"\n"check point" = "go"\n'
)


@pytest.fixture(autouse=True)
def nothing_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Temporary folders go where the test sees them."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def loaded(folder: Path, **more: Any) -> tuple[LoadedRig, LoadedScript]:
    files(folder, **more)
    return load_rig(folder / "rig.toml"), load_script(folder / "script.toml")


def found(rehearsal: Rehearsal) -> list[tuple[str, str]]:
    return [(one.trial, one.kind) for one in rehearsal.findings]


def test_a_gate_that_never_opens_and_an_interlock_are_met(tmp_path: Path) -> None:
    late = SCRIPT.replace("window_s = 2.0", "window_s = 60.0\ntimeout_s = 30.0")
    rig, script = loaded(tmp_path, script=late)
    never = rehearse(rig, script, ())
    assert found(never) == [("place-1", "fault")]
    assert "not stable within 30 s" in never.findings[0].text
    assert never.trials == 0
    limits = rig.rig.limits.model_copy(update={"bath_max_c": 33.005})
    hot = replace(rig, rig=rig.rig.model_copy(update={"limits": limits}))
    tripped = rehearse(hot, load_script(tmp_path / "script.toml"), ())
    assert [kind for _, kind in found(tripped)] == ["interlock"], (
        "told once, though the run ends by it too"
    )
    assert "33.005" in tripped.findings[0].text


def test_what_the_arm_does_not_reach_is_reported_by_the_trial_and_the_others_are_gone_through(
    tmp_path: Path,
) -> None:
    rig, script = loaded(tmp_path, script=SCRIPT.replace(FAR, "{ y_mm = 300.0 }"))
    rehearsal = rehearse(rig, script, ())
    assert set(found(rehearsal)) == {("place-1", "reach")}
    assert rehearsal.findings[0].text.startswith(
        "the arm doesn't reach the end of right front (RF) at "
    )
    assert rehearsal.trials == 2


def test_a_check_point_out_of_reach_ends_it(tmp_path: Path) -> None:
    far = CHECK_POINT.replace("120.0", "900.0")
    rehearsal = rehearse(*loaded(tmp_path, check_point=far), ())
    (reach,) = rehearsal.findings
    assert (reach.trial, reach.kind) == ("before the trials", "reach")
    assert reach.text == "the arm doesn't reach the check point at [-190, 900, 15] mm"


def test_what_the_run_gets_over_is_reported_and_is_no_finding(tmp_path: Path) -> None:
    faults = 'faults = [{ instrument = "stage", name = "disconnect", amount = 0.2 }]'
    rehearsal = rehearse(*loaded(tmp_path, stage=STAGE, emulation=faults), ())
    assert dict(rehearsal.recovered) == {"an instrument dropped out and came back": 1}
    assert rehearsal.findings == ()
    assert rehearsal.trials == 3


def test_frames_that_fail_the_rigs_checks_and_a_detector_that_fails(tmp_path: Path) -> None:
    rig, script = loaded(tmp_path)
    checks = rig.rig.cameras.checks.model_copy(update={"black_dn": 250})
    cameras = rig.rig.cameras.model_copy(update={"checks": checks})
    dark = replace(rig, rig=rig.rig.model_copy(update={"cameras": cameras}))
    rehearsal = rehearse(dark, script, ())
    assert found(rehearsal) == [(f"place-{number}", "frames") for number in (1, 2, 3)]
    assert "black" in rehearsal.findings[0].text
    assert (rehearsal.trials, rehearsal.rendered) == (3, 0)
    failing = rehearse(rig, script, (Failing(),))
    assert found(failing) == [("place-1", "detector")]
    assert failing.findings[0].text.startswith("failing: the detector failed: no licence")


class Failing:
    name, version = "failing", "1"
    parameters: Mapping[str, object] = MappingProxyType({})

    def detect(self, frames: object, calibration: object) -> Detection:
        raise DetectionFailure("no licence")


def test_answers_that_are_left_over_are_found_and_one_that_skips_is_reported(
    tmp_path: Path,
) -> None:
    answers = tmp_path / "answers.toml"
    answers.write_text(ANSWERS.format("skip the teat came off"), encoding="utf-8")
    rig, script = loaded(tmp_path, operator="script:answers.toml")
    skipped = rehearse(rig, script, ())
    assert skipped.findings == ()
    assert dict(skipped.recovered) == {"the operator's script skips a trial": 1}
    assert skipped.trials == 2
    never = ANSWERS.format("go").replace('answer = "go"', 'answer = "go"\nsays = "teat 9"')
    answers.write_text(never, encoding="utf-8")
    left = rehearse(rig, script, ())
    assert found(left) == [("after the trials", "fault")]
    assert "1 answer of answers.toml was never asked for" in left.findings[0].text


def test_ctrl_c_leaves_nothing_behind(tmp_path: Path, nothing_stays: Path) -> None:
    rig, script = loaded(tmp_path)

    def interrupted(done: int, _of: int) -> None:
        assert list(nothing_stays.iterdir()), "it is amid its work"
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rehearse(rig, script, (), shown=interrupted)
    assert list(nothing_stays.iterdir()) == []
    assert not (tmp_path / "runs").exists()
