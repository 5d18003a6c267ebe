"""Runs a detector on a frame set and scores its answer, for runs and recordings alike.

A detector that fails, gives nonsense or is too slow is scored as what it did; it never stops a run. The same stopwatch stands around the
same call for every detector, in the bench's process or in one of its own: `detect`, and nothing else.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.detecting.answer_checks import LONGEST_REASON, checked, one_line
from bench.scoring.scene import SceneScore, score_scene
from detector.calibration import Calibration
from detector.protocol import Detection, DetectionFailure, Detector, Frames, Outcome, Served
from instruments.clock import load_per_processor, processor_s, stopwatch_s

TIMEOUT_S = 30.0  # a slower answer counts as none; a rig says its own (limits.detection_timeout_s)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a detector said of one frame set, and how long it took (real seconds).

    cold: the detector's first call since it was made, or since its process was started; no latency is taken from it. start_up_s: what a
    process took to start before this call, not part of ``seconds``. stderr: what it wrote to its standard error. cpu_s: seconds of
    processors that the bench's process used meanwhile, None where the detector isn't in it; load: of the machine, a processor.
    """

    detector: str
    detection: Detection
    seconds: float
    outcome: Outcome = Outcome.ANSWERED
    cold: bool = False
    start_up_s: float | None = None
    stderr: str = ""
    cpu_s: float | None = None
    load: float | None = None


@dataclass(frozen=True, slots=True)
class TruthRow:
    """One teat as the scorer takes it. ``u_mm`` is the standard uncertainty along an axis."""

    teat: str
    point_mm: tuple[float, float, float]
    visible: bool
    u_mm: float | None


class Examiner:
    """Asks detectors, and knows which of them has been asked before. An answer slower than ``timeout_s`` counts as none."""

    def __init__(self, calibration: Calibration, timeout_s: float = TIMEOUT_S) -> None:
        self._calibration, self._timeout_s = calibration, timeout_s
        self._asked: set[str] = set()

    def ask(self, detector: Detector, frames: Frames) -> Answer:
        """One detector on one frame set."""
        first = detector.name not in self._asked
        self._asked.add(detector.name)
        return examine(detector, frames, self._calibration, first=first, timeout_s=self._timeout_s)


def examine(detector: Detector, frames: Frames, calibration: Calibration, *, first: bool = False, timeout_s: float = TIMEOUT_S) -> Answer:
    """Detect, timed. Whatever the detector does but answer well becomes an answer without teats that gives it as the reason."""
    served = detector if isinstance(detector, Served) else None
    shown = _Shown(frames)
    seconds, used_s, outcome = 0.0, 0.0, Outcome.ANSWERED
    try:
        if served:
            served.prepare(shown, calibration)
        start_s, used_before_s = stopwatch_s(), processor_s()
        try:
            with redirect_stdout(sys.stderr):  # the bench's own output may be read by a program
                given = detector.detect(shown, calibration)
        finally:
            seconds, used_s = stopwatch_s() - start_s, processor_s() - used_before_s
        if seconds > timeout_s:
            raise DetectionFailure(f"it answered after {timeout_s:g} s, which counts as no answer", Outcome.TIMEOUT)
        detection = checked(given)
        if served:
            served.check()
    except DetectionFailure as failure:
        outcome, detection = failure.outcome, _nothing(failure)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # anyone's code: it may fail in any way, and not every library's errors are Exceptions
        outcome, detection = Outcome.FAILED, _nothing(_named(error))
    start_up_s, stderr = (served.start_up_s, served.said()) if served else (None, "")
    cpu_s, load = None if served else used_s, load_per_processor()
    return Answer(detector.name, detection, seconds, outcome, first or start_up_s is not None, start_up_s, stderr, cpu_s, load)


def close_detectors(detectors: Iterable[Detector]) -> None:
    """End what detectors hold outside of the bench's process."""
    for detector in detectors:
        if isinstance(detector, Served):
            detector.close()


def score_answer(answer: Answer, truth: Sequence[TruthRow], *, limit_mm: float, time_limit_s: float) -> SceneScore:
    """The score of one answer against the teats of its scene. No answer is no success, also where there was nothing to be found."""
    known = [row.u_mm for row in truth if row.u_mm is not None]
    score = score_scene(
        points_of(answer.detection),
        np.array([row.point_mm for row in truth]),
        np.array([row.visible for row in truth]),
        u_mm=max(known, default=0.0),
        seconds=answer.seconds,
        limit_mm=limit_mm,
        time_limit_s=time_limit_s,
        hidden_claimed=answer.detection.hidden if answer.outcome is Outcome.ANSWERED else None,
    )
    if answer.outcome is Outcome.ANSWERED:
        return score
    return replace(score, success=False, in_time=score.in_time and answer.outcome is not Outcome.TIMEOUT)


def points_of(detection: Detection) -> NDArray[np.float64]:
    """The teat ends (n, 3) in world mm."""
    return np.array([teat.world_mm for teat in detection.teats], dtype=np.float64).reshape(-1, 3)


def _nothing(why: object) -> Detection:
    return Detection((), 0, f"the detector failed: {one_line(str(why))}"[:LONGEST_REASON], ())


def _named(error: BaseException) -> str:
    """What a failure is called, and its own words where it has any."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:  # its own words fail
        return type(error).__name__


class _Shown:
    """A frame set as a detector sees it: it can't change the pictures under those that are asked after it, nor what is stored."""

    def __init__(self, frames: Frames) -> None:
        self.left, self.right = _fixed(frames.left), _fixed(frames.right)
        self.thermal = None if frames.thermal is None else _fixed(frames.thermal)
        kelvin = frames.thermal_k
        self.thermal_k = None if kelvin is None else _fixed(kelvin)


def _fixed(picture: NDArray[Any]) -> NDArray[Any]:
    view = picture.view()
    view.setflags(write=False)
    return view
