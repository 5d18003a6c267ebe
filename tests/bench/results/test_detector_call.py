"""Detectors of every manner: what they do is scored as what it is."""

from __future__ import annotations

import asyncio
import builtins
import ctypes
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import bench
from bench.config import read_calibration
from bench.record.reader import TrialRecord
from bench.record.recording import TruthRow
from bench.results.answers import (
    MOST_STAGES,
    OUTSIDE,
    Answer,
    Examiner,
    close_detectors,
    examine,
    score_answer,
)
from bench.results.working_volume import outside_volume
from bench.rig.loading import RIGS
from bench.run.rows import detection_rows, stage_pictures
from bench.scoring.scene import scene_from_dict
from bench.script.model import TRIALS, load_script
from detector.calibration import Calibration
from detector.protocol import (
    Detection,
    DetectionFailure,
    DetectorProcess,
    Frames,
    Outcome,
    Stage,
    Teat,
)
from instruments.camera.frame import FrameSet

TRUTH = [
    TruthRow("ideal", "1", (0.0, 0.0, 100.0), True, 0.2),
    TruthRow("ideal", "2", (50.0, 0.0, 100.0), True, 0.2),
]
FRAMES = FrameSet(np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8))


@dataclass(frozen=True)
class Scripted:
    """A detector that does what a function says."""

    does: Callable[[], Any]
    name: str = "scripted"
    version: str = "1"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        found: Detection = self.does()
        return found


CALIBRATION = cast("Calibration", None)  # none of these detectors looks at it
scored = partial(score_answer, truth=TRUTH, limit_mm=5.0, time_limit_s=2.0)


def asked(does: Callable[[], Any], **more: Any) -> Answer:
    """The answer of a detector that does this, held to be one that record and report can take."""
    answer = examine(Scripted(does), FRAMES, CALIBRATION, **more)
    head, _ = detection_rows("t", answer)
    (str(head["reason"]) + str(head["trace"])).encode("utf-8")
    assert answer.detection.reason is None or answer.detection.reason.isprintable()
    assert all(min(picture.shape) > 0 for picture in stage_pictures([answer]).values())
    return answer


def teat(*xyz: float, **more: Any) -> Teat:
    return Teat(np.array(xyz), **more)


def answered(*teats: Any, **more: Any) -> Callable[[], Detection]:
    return lambda: Detection(teats, **more)


def test_a_good_answer_is_scored_and_stored() -> None:
    answer = asked(answered(teat(1, 0, 100), teat(50, 2, 100)))
    assert (answer.outcome, answer.cold) == (Outcome.ANSWERED, False)
    assert (answer.start_up_s, answer.stderr) == (None, "")
    score = scored(answer)
    assert score.success
    slow = replace(answer, seconds=9.0)
    first = replace(slow, cold=True)  # in which a network may be made ready
    given_up = replace(first, outcome=Outcome.TIMEOUT)
    in_time = [scored(one).in_time for one in (slow, first, given_up)]
    assert in_time == [False, True, False]
    assert sorted(score.radial_mm) == [1.0, 2.0]
    row = TrialRecord({"id": "t"}, scores={"scripted": score}).score_rows[0]
    assert "seconds" not in json.loads(str(row["score"]))
    again = scene_from_dict({**json.loads(str(row["score"])), **json.loads(str(row["wall_score"]))})
    assert again.as_dict() == score.as_dict()


ENDS = [
    [2100.0, 205.0, 136.0],
    [2180.0, 270.0, 134.0],
    [2100.0, 330.0, 136.0],
    [2020.0, 270.0, 134.0],
]


def seen_from(shift_mm: tuple[float, float, float]) -> Calibration:
    """The shipped rig with its world's origin that far from the table."""
    here = read_calibration(RIGS / "calibration.toml")
    world = here.world_from_right
    return replace(here, world_from_right=replace(world, T=world.T + np.array(shift_mm)))


@pytest.mark.parametrize(
    "far",
    [
        (2100.0, 270.0, 2600.0),
        (0.0, 0.0, 100.0),
        (2100.0, 12_000.0, 136.0),
        (0.0, 0.0, 1e9),
        (-1e308, 1e308, 0.0),
    ],
)
def test_one_answer_far_away_is_one_false_end_and_the_others_stand(far: tuple[float, ...]) -> None:
    """On a table whose origin is 2 m away, too: the volume is what that rig's cameras see."""
    answers = Scripted(answered(*[teat(*end) for end in ENDS], teat(*far)))
    answer = examine(answers, FRAMES, seen_from((2260.0, 0.0, 0.0)))
    truth = [TruthRow("calm", str(n), (x, y, z), True) for n, (x, y, z) in enumerate(ENDS)]
    score = score_answer(answer, truth, limit_mm=5.0, time_limit_s=1.0)
    counts = score.counts
    assert (counts.matched, counts.missed, counts.false) == (4, 0, 1)
    assert np.isfinite(score.gospa_mm)
    said = answer.detection.reason or ""
    assert said.count(OUTSIDE) == 1
    assert said.startswith("teat 5 of its answer is at")


@pytest.mark.parametrize("shift_mm", [(0.0, 0.0, 0.0), (2260.0, 0.0, 0.0), (0.0, -3e5, 40.0)])
def test_the_working_volume_goes_with_the_rig(shift_mm: tuple[float, float, float]) -> None:
    """All planned ends of the shipped scripts, and 200 mm around each, are in it."""
    calibration = seen_from(shift_mm)
    planned = load_script(TRIALS / "six-situations.toml").planned
    ends_mm = np.concatenate([one.phantom.moved(one.pose).ends_mm for one in planned]) + shift_mm
    around = np.concatenate([ends_mm + 200.0 * step for step in (*np.eye(3), *-np.eye(3))])
    assert not outside_volume(around, calibration).any()
    elsewhere = ends_mm - shift_mm if any(shift_mm) else np.add(ends_mm, (0, 0, 2500))
    assert outside_volume(elsewhere, calibration).all()


def raising(error: BaseException) -> Callable[[], Detection]:
    def fails() -> Detection:
        raise error

    return fails


crash = raising(RuntimeError("out of\ncheese"))


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise ZeroDivisionError


HERE = np.array([1.0, 2.0, 3.0])
LEANING = np.eye(3) + np.array([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ("does", "reason"),
    [
        (crash, "the detector failed: RuntimeError: out of cheese"),
        (raising(SystemExit(3)), "the detector failed: SystemExit: 3"),
        (raising(asyncio.CancelledError()), "the detector failed: CancelledError"),
        (raising(SpeechlessError()), "the detector failed: SpeechlessError"),
        (
            raising(RuntimeError("no \ud800 such\x1b[31m")),
            "the detector failed: RuntimeError: no \N{REPLACEMENT CHARACTER} such",
        ),
        (
            lambda: Detection(None),  # type: ignore[arg-type]
            "the teats of its answer are a NoneType, not a tuple of Teat",
        ),
        (
            answered(Teat(np.array(["1", "2", "3"]))),
            "teat 1 of its answer is ['1', '2', '3'], not three finite numbers",
        ),
        (
            answered(Teat(np.ma.masked_array(HERE, [True, False, False]))),
            "not three finite numbers",
        ),
        (
            answered(Teat(HERE, np.eye(3) * 1e308)),
            "the covariance of teat 1 has an entry of 1e+308 mm2; at most 1e+12 are taken",
        ),
        (
            answered(Teat(HERE, np.eye(3) * 1e-300)),
            "claims a standard deviation of 1e-150 mm; at least 1e-06 mm are taken",
        ),
        (
            answered(teat(np.nan, np.nan, np.nan, left_px=np.array([np.nan, 1]))),
            "left_px of teat 1 is [nan, 1.0]",
        ),
        (lambda: None, "its answer is a NoneType, not a Detection"),
        (answered([1, 2, 3]), "teat 1 of its answer is a list, not a Teat"),
        (answered(teat(1, 2)), "not three finite numbers"),
        (answered(teat(1, 2, 3), teat(1, np.inf, 3)), "teat 2 of its answer is [1.0, inf, 3.0]"),
        (answered(*[teat(i, 0, 0) for i in range(17)]), "17 teats; 16 are taken at most"),
        (answered(hidden=-1), "counts -1 teats as hidden"),
        (answered(hidden=99), "counts 99 teats as hidden"),
        (answered(hidden=1.5), "counts 1.5 teats as hidden"),
        (answered(hidden=True), "counts True teats as hidden"),
        (answered(hidden=tuple(range(999))), "20, 21... teats as hidden"),
        (
            answered(teat(1, 2, 3, covariance_mm2=np.full((3, 3), np.nan))),
            "not 3 x 3 finite numbers",
        ),
        (
            answered(teat(1, 2, 3, covariance_mm2=LEANING)),
            "the covariance of teat 1 is not symmetric",
        ),
        (
            answered(teat(1, 2, 3, covariance_mm2=np.diag([1.0, 1, 0]))),
            "the covariance of teat 1 is not positive definite",
        ),
    ],
)
def test_a_bad_answer_is_reported_and_stops_nothing(does: Callable[[], Any], reason: str) -> None:
    answer = asked(does)
    assert answer.outcome is Outcome.FAILED
    assert answer.detection.teats == ()
    assert reason in str(answer.detection.reason)
    assert "\n" not in str(answer.detection.reason)
    assert answer.seconds > 0
    assert not scored(answer).success


def test_ctrl_c_is_not_a_failure_of_the_detector() -> None:
    def interrupted() -> Detection:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        asked(interrupted)


def test_no_answer_is_no_success_where_there_is_nothing_to_find() -> None:
    unseen = [replace(row, visible=False) for row in TRUTH]
    silent = asked(answered(hidden=2))
    assert scored(silent, truth=unseen).success
    crashed = asked(crash)
    failed = scored(crashed, truth=unseen)
    assert (failed.success, failed.hidden_claimed) == (False, None)


def test_an_answer_after_the_limit_is_a_timeout() -> None:
    answer = asked(answered(teat(0, 0, 100)), timeout_s=1e-9)
    assert (answer.outcome, answer.detection.teats) == (Outcome.TIMEOUT, ())
    assert "it answered after 1e-09 s, which counts as no answer" in str(answer.detection.reason)
    score = scored(answer)
    assert (score.in_time, score.success) == (False, False)


def test_the_first_call_is_the_cold_one() -> None:
    examiner = Examiner(CALIBRATION)
    one, two = Scripted(answered(), "one"), Scripted(crash, "two")
    cold = [examiner.ask(d, FRAMES).cold for d in (one, two, one, two, one)]
    assert cold == [True, True, False, False, False]


@pytest.mark.parametrize("part", ["left", "right", "thermal", "amplitude"])
@pytest.mark.parametrize("by_flag", [False, True])
def test_no_detector_can_change_what_is_stored_and_others_see(part: str, by_flag: bool) -> None:
    """As torch.from_numpy does: it gives memory that can be written to, whatever NumPy's flag."""
    grey, depth = np.zeros((3, 4, 6), np.uint8), np.ones((2, 4, 6), np.uint16)
    frames = FrameSet(grey[0], grey[1], grey[2], depth_dmm=depth[0], amplitude=depth[1])

    class Writer(Scripted):
        def detect(self, frames: Frames, calibration: Calibration) -> Detection:
            picture = getattr(frames, part)
            with pytest.raises(ValueError, match="read-only"):
                picture[:] = 255
            if by_flag:
                picture.setflags(write=True)
                picture[:] = 255
            ctypes.memset(picture.ctypes.data, 255, picture.nbytes)
            return Detection()

    assert examine(Writer(answered()), frames, CALIBRATION).outcome is Outcome.ANSWERED
    assert [*grey.ravel(), *depth.ravel()] == [0] * grey.size + [1] * depth.size
    frames.left[0, 0] = 1  # the bench itself may


def test_an_answer_stays_as_it_is_where_its_detector_fills_its_buffers_again() -> None:
    mask, point = np.ones((4, 4), dtype=bool), np.zeros(3)
    said = Detection((Teat(point),), 0, None, (Stage("seen", {"mask": mask}),))
    first = asked(lambda: said)
    mask[:], point[:] = False, 9.0
    assert first.detection.trace[0].data["mask"].all()
    assert not first.detection.teats[0].world_mm.any()


def test_a_detector_changes_nothing_of_the_benchs_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])

    def odd() -> Detection:
        sys.meta_path.clear()
        threading.stack_size(1 << 40)
        builtins.open = time.sleep = crash  # type: ignore[assignment]
        os.chdir("/")
        return Detection()

    before = Path.cwd(), open, time.sleep, [*sys.meta_path]
    assert asked(odd).outcome is Outcome.ANSWERED
    assert (Path.cwd(), open, time.sleep, sys.meta_path) == before
    worker = threading.Thread(target=lambda: None)
    worker.start()
    worker.join()


@pytest.mark.parametrize("load", [bench.detectors, lambda: bench.open_detector("odd").__enter__()])
def test_a_detector_that_is_loaded_changes_nothing_of_the_benchs_process(
    load: Callable[[], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "odd_detector-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Name: odd\nVersion: 1.0\n", encoding="utf-8")
    points = "[teatbench.detectors]\nodd = odd_detector:Odd\n"
    (info / "entry_points.txt").write_text(points, encoding="utf-8")
    (tmp_path / "odd_detector.py").write_text(ODD, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "odd_detector", raising=False)
    before = Path.cwd(), json.dumps, time.sleep, signal.getsignal(signal.SIGTERM)
    load()
    assert "odd_detector" in sys.modules
    assert (Path.cwd(), json.dumps, time.sleep, signal.getsignal(signal.SIGTERM)) == before


ODD = """
import json, os, signal, time

os.chdir("/")
json.dumps = time.sleep = None
signal.signal(signal.SIGTERM, signal.SIG_IGN)


class Odd:
    def detect(self, frames, calibration): ...
"""


def test_no_detector_can_change_the_calibration_under_the_others() -> None:
    calibration = read_calibration(RIGS / "calibration.toml")
    before = calibration.homographies.left.copy()

    class Scaling(Scripted):
        def detect(self, frames: Frames, calibration: Calibration) -> Detection:
            for matrix in (calibration.right_from_left.R, calibration.homographies.left):
                with pytest.raises(ValueError, match="read-only"):
                    matrix /= 2.0
            return Detection()

    assert examine(Scaling(answered()), FRAMES, calibration).outcome is Outcome.ANSWERED
    assert np.array_equal(calibration.homographies.left, before)


def test_a_covariance_as_printed_is_symmetric_enough() -> None:
    printed = np.array([[1.0, 0.3333334, 0], [0.3333333, 1, 0], [0, 0, 1]])
    answer = asked(answered(teat(1, 2, 3, covariance_mm2=printed)))
    kept = answer.detection.teats[0].covariance_mm2
    assert kept is not None
    assert np.array_equal(kept, kept.T)


def test_stages_are_kept_points_in_the_record_and_masks_as_pictures() -> None:
    mask = np.eye(30, dtype=bool)
    ends = Stage("teat ends", {"points_px": np.array([[1.5, 2.5]])})
    stages = (Stage("edges", {"mask": mask}), ends)
    answer = asked(answered(hidden=2, trace=stages))
    head, found = detection_rows("t", answer)
    trace = json.loads(str(head["trace"]))
    assert trace["teat ends"]["points_px"] == [[1.5, 2.5]]
    assert trace["edges"]["mask"]["shape"] == [30, 30]
    assert (head["outcome"], head["cold"]) == ("answered", 0)
    assert found == []
    pictures = stage_pictures([answer])
    assert list(pictures) == ["scripted-edges"]
    assert (pictures["scripted-edges"] == mask * np.uint8(255)).all()


def test_stages_that_the_record_cannot_hold_are_left_out_with_a_word() -> None:
    text = asked(answered(reason="dark\n and   cold"))
    assert text.detection.reason == "dark and cold"
    masked = {"mask": np.ones((9, 4), bool)}
    good, again = (Stage(name, masked) for name in ("good", "GOOD"))
    for bad in (
        Stage("../up", {"p": np.zeros(2)}),
        Stage("things", {"p": np.array([object()])}),
        "no stage",
        Stage("fine", None),  # type: ignore[arg-type]
        Stage("a" * 1000, masked),
        Stage("empty", {"mask": masked["mask"][:0]}),
        Stage("long", {"mask": np.ones((1, 100_000), bool)}),
        Stage("text", {"said": np.array(["\ud800"])}),
        Stage("key", {"\ud800": HERE}),
        again,  # of two that would be one file, the first
    ):
        answer = asked(answered(reason="dark", trace=(good, bad)))
        assert answer.outcome is Outcome.ANSWERED
        assert [stage.name for stage in answer.detection.trace] == ["good"]
        assert str(answer.detection.reason).startswith("dark; 1 of its stages can't be kept")


def test_a_trace_without_end_is_cut_and_prints_are_not_the_benchs_output(
    capsys: pytest.CaptureFixture[str],
) -> None:
    stages = tuple(Stage(f"s{number}", {"mask": np.ones((9, 4), bool)}) for number in range(500))
    answer = asked(lambda: (print("debug"), Detection((), trace=stages))[1])
    assert len(answer.detection.trace) == MOST_STAGES
    assert f"{500 - MOST_STAGES} of its stages" in str(answer.detection.reason)
    assert capsys.readouterr() == ("", "debug\n")


@dataclass
class Remote:
    """A detector that lives elsewhere, with a diary of what it was asked to do."""

    fails: dict[str, DetectionFailure] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)
    name: str = "remote"
    version: str = "1"
    patience_s: float = 1.0
    most_s: float = 1.0
    start_up_s: float | None = 0.75
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def _do(self, what: str) -> None:
        self.done.append(what)
        if what in self.fails:
            raise self.fails[what]

    def introduce(self) -> None:
        self._do("introduce")

    def prepare(self, frames: Frames, calibration: Calibration) -> None:
        self._do("prepare")

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        self._do("detect")
        return Detection((teat(0, 0, 100),))

    def check(self) -> None:
        self._do("check")

    def said(self) -> str:
        return "cheese is low"

    def close(self) -> None:
        self._do("close")


def test_what_lives_elsewhere_is_prepared_outside_of_its_time_and_checked() -> None:
    remote = Remote()
    assert isinstance(remote, DetectorProcess)
    answer = examine(remote, FRAMES, CALIBRATION)
    assert (answer.outcome, answer.cold) == (Outcome.ANSWERED, True)
    assert (answer.start_up_s, answer.stderr) == (0.75, "cheese is low")
    close_detectors([remote, Scripted(crash)])
    assert remote.done == ["prepare", "detect", "check", "close"]
    head, _ = detection_rows("t", answer)
    kept = (head["cold"], head["wall_start_up_s"], head["wall_stderr"])
    assert kept == (1, 0.75, "cheese is low")


@pytest.mark.parametrize(
    ("where", "outcome"),
    [("prepare", Outcome.OFF), ("detect", Outcome.TIMEOUT), ("check", Outcome.FAILED)],
)
def test_its_failures_are_what_they_are(where: str, outcome: Outcome) -> None:
    answer = examine(Remote({where: DetectionFailure("no cheese", outcome)}), FRAMES, CALIBRATION)
    assert (answer.outcome, answer.detection.teats) == (outcome, ())
    assert answer.detection.reason == "the detector failed: no cheese"
    assert answer.stderr == "cheese is low"


@pytest.mark.slow
def test_what_the_processor_gave_is_measured_beside_the_time() -> None:
    def wait() -> Detection:
        threading.Event().wait(0.5)
        return Detection(())

    def work() -> Detection:
        end_s = time.thread_time() + 0.3
        while time.thread_time() < end_s:
            pass
        return Detection(())

    waited, worked = (asked(does) for does in (wait, work))
    assert waited.cpu_s is not None
    assert waited.cpu_s < 0.25
    assert waited.seconds >= 0.4
    assert worked.cpu_s is not None
    assert worked.cpu_s >= 0.27
    row = detection_rows("t", waited)[0]
    assert (row["wall_cpu_s"], row["wall_load"]) == (waited.cpu_s, waited.load)
    assert (waited.load is not None) is hasattr(os, "getloadavg")
