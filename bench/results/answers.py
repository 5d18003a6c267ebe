"""Asks a detector for its answer on a frame set, checks the answer, and scores it.

An answer is refused as a whole. A detector that fails, answers nonsense or is too slow is scored as
what it did and never stops a run. Every detector is timed around the same `detect` call.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.arguments import bare
from bench.record.recording import TruthRow
from bench.results.working_volume import outside_volume
from bench.scoring.scene import SceneScore, score_scene
from detector.calibration import Calibration
from detector.protocol import (
    Context,
    Detection,
    DetectionFailure,
    Detector,
    DetectorProcess,
    Frames,
    Outcome,
    Stage,
    Teat,
    WithContext,
    depth_of,
)
from instruments.clock import load_per_processor, processor_s, stopwatch_s
from instruments.drivers.entry_points import undisturbed
from reports.sanitize import sanitized
from textfiles.text import named, short

# an end that is farther from the world's origin is kept at so far, so that what is made of it stays
# a number; it is a false one, as all are that lie outside of the working volume
MOST_MM = 1e6
MOST_TEATS = 16  # four, and what else a detector may take for one; each costs the scorer time
LONGEST_REASON = 500
OUTSIDE = "outside of what both cameras see"
LEFT_OUT = "its covariances leave out"  # of a detector under test, in its own words
LEAST_SD_MM, MOST_SD_MM = 1e-6, 1e6  # beyond, figures made of it are no longer numbers
# what a run keeps of the trace of one answer
MOST_STAGES, LONGEST_NAME, MOST_PICTURE_PX = 64, 60, 8192
_SYMMETRY = 1e-6  # of the greatest entry: six printed digits
_PIXELS = ("left_px", "right_px", "thermal_px")


def checked(detection: Any, calibration: Calibration | None = None) -> Detection:
    """The answer as it may be used, with what is outside of the working volume of ``calibration``.
    Raises DetectionFailure that names the part that can't be used.
    """
    if not isinstance(detection, Detection):
        raise DetectionFailure(f"its answer is a {type(detection).__name__}, not a Detection")
    hidden, teats = detection.hidden, detection.teats
    whole = isinstance(hidden, int | np.integer) and not isinstance(hidden, bool)
    if not whole or not 0 <= hidden <= MOST_TEATS:
        raise DetectionFailure(
            f"its answer counts {short(repr(hidden), 80)} teats as hidden; a whole number from 0 to"
            f" {MOST_TEATS} is asked for"
        )
    if not isinstance(teats, tuple | list):
        raise DetectionFailure(
            f"the teats of its answer are a {type(teats).__name__}, not a tuple of Teat"
        )
    if len(teats) > MOST_TEATS:
        raise DetectionFailure(f"its answer has {len(teats)} teats; {MOST_TEATS} are taken at most")
    trace, lost = _trace(detection.trace)
    found = tuple(map(_teat, range(1, 1 + len(teats)), teats))
    reasons = [detection.reason, *_outside(teats, found, calibration), lost]
    said = [one_line(str(part)) for part in reasons if part is not None]
    reason = "; ".join(filter(None, said))[:LONGEST_REASON] or None
    return Detection(found, int(hidden), reason, trace)


def one_line(text: str) -> str:
    """Another's words on one line."""
    return sanitized(" ".join(text.split()))


def _teat(number: int, teat: Any) -> Teat:
    if not isinstance(teat, Teat):
        raise DetectionFailure(
            f"teat {number} of its answer is a {type(teat).__name__}, not a Teat"
        )
    seen = {
        name: _numbers(given, (2,), f"{name} of teat {number}", "two finite numbers")
        for name in _PIXELS
        if (given := getattr(teat, name)) is not None
    }
    point = _numbers(teat.world_mm, (3,), f"teat {number} of its answer", "three finite numbers")
    if (largest := np.abs(point).max()) > MOST_MM:
        point = point / largest * MOST_MM
    spread = None if teat.covariance_mm2 is None else _covariance(number, teat.covariance_mm2)
    return replace(teat, world_mm=point, covariance_mm2=spread, **seen)


def _outside(
    given: Sequence[Teat], kept: Sequence[Teat], calibration: Calibration | None
) -> Iterator[str]:
    """What is said of each end that is where this rig can't have one."""
    if calibration is None:
        return
    points_mm = np.array([teat.world_mm for teat in kept]).reshape(-1, 3)
    for number in np.flatnonzero(outside_volume(points_mm, calibration)).tolist():
        text = ", ".join(f"{float(value):.4g}" for value in given[number].world_mm)
        yield f"teat {number + 1} of its answer is at ({text}) mm, {OUTSIDE}"


def _covariance(number: int, given: Any) -> Any:
    what = f"the covariance of teat {number}"
    matrix = _numbers(given, (3, 3), what, "3 x 3 finite numbers")
    if np.abs(matrix - matrix.T).max() > _SYMMETRY * np.abs(matrix).max():
        raise DetectionFailure(f"{what} is not symmetric")
    if np.abs(matrix).max() > MOST_SD_MM**2:
        raise DetectionFailure(
            f"{what} has an entry of {np.abs(matrix).max():.3g} mm2; at most {MOST_SD_MM**2:g} are"
            " taken"
        )
    matrix = 0.5 * (matrix + matrix.T)
    least = float(np.linalg.eigvalsh(matrix).min())
    if least <= 0.0:
        raise DetectionFailure(f"{what} is not positive definite")
    if least < LEAST_SD_MM**2:
        raise DetectionFailure(
            f"{what} claims a standard deviation of {np.sqrt(least):.3g} mm; at least"
            f" {LEAST_SD_MM:g} mm are taken"
        )
    return matrix


def _numbers(given: Any, shape: tuple[int, ...], what: str, wanted: str) -> Any:
    try:
        found = np.ma.asarray(given) if isinstance(given, np.ma.MaskedArray) else np.asarray(given)
    except (TypeError, ValueError, OverflowError):
        raise DetectionFailure(f"{what} is {short(repr(given), 80)}, not {wanted}") from None
    plain = found.shape == shape and found.dtype.kind in "iuf" and not np.ma.is_masked(found)
    if not plain or not np.isfinite(found).all():
        raise DetectionFailure(f"{what} is {short(repr(found.tolist()), 80)}, not {wanted}")
    return np.array(found, dtype=np.float64)


def _trace(trace: Any) -> tuple[tuple[Stage, ...], str | None]:
    """The stages that the record can hold, and a note of how many it can't."""
    stages = trace if isinstance(trace, tuple | list) else (trace,)
    kept = {
        # copies, as the detector may fill its buffers again
        stage.name.casefold().replace(" ", "-"): Stage(
            stage.name, {key: value.copy() for key, value in stage.data.items()}
        )
        for stage in reversed(stages[:MOST_STAGES])
        if _holds(stage)
    }
    lost = len(stages) - len(kept)
    why = "a stage has a plain name of its own, and arrays of numbers or text by name"
    return tuple(reversed(kept.values())), (
        f"{lost} of its stages can't be kept: {why}" if lost else None
    )


def _holds(stage: Any) -> bool:
    """Whether record and report can show a stage: arrays of numbers, text, or masks as pictures."""
    if not isinstance(stage, Stage) or not isinstance(stage.data, Mapping):
        return False
    name = stage.name
    plain = isinstance(name, str) and name.replace(" ", "").replace("-", "").isalnum()
    if not plain or len(name) > LONGEST_NAME:
        return False
    return all(
        isinstance(key, str) and key.isprintable() and _keeps(value)
        for key, value in stage.data.items()
    )


def _keeps(value: Any) -> bool:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufU":
        return False
    if value.dtype.kind == "U":
        return all(text.isprintable() for text in value.ravel().tolist())
    picture = value.dtype.kind == "b" and value.ndim == 2
    return not picture or 0 < min(value.shape) <= max(value.shape) <= MOST_PICTURE_PX


LIMIT_MM = 5.0  # of the error of each teat end; thesis, section 1.4.3
TIMEOUT_S = 30.0  # a slower answer counts as none; a rig says its own (limits.detection_timeout_s)


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer on one frame set and its real time; ``cold``: the first call of a process.
    ``cpu_s`` is None for a detector in another process; ``load`` is that of the machine.
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


def name_of(detector: str | Detector) -> str:
    """As it is called in sentences: its class's name for an object that has none."""
    return (
        detector
        if isinstance(detector, str)
        else str(getattr(detector, "name", type(detector).__name__))
    )


class Examiner:
    """Asks detectors, and marks first calls. An answer slower than ``timeout_s`` is none."""

    def __init__(self, calibration: Calibration, timeout_s: float = TIMEOUT_S) -> None:
        self._calibration, self._timeout_s = calibration, timeout_s
        self._asked: set[str] = set()

    def ask(self, detector: Detector, frames: Frames, context: Context | None = None) -> Answer:
        """One detector on one frame set, with what is known beside it."""
        first = name_of(detector) not in self._asked
        self._asked.add(name_of(detector))
        return examine(
            detector,
            frames,
            self._calibration,
            first=first,
            timeout_s=self._timeout_s,
            context=context,
        )


def examine(
    detector: Detector,
    frames: Frames,
    calibration: Calibration,
    *,
    first: bool = False,
    timeout_s: float = TIMEOUT_S,
    context: Context | None = None,
) -> Answer:
    """Detect, timed. Any failure becomes an answer without teats that gives the reason."""
    detector = bare(detector)
    served = detector if isinstance(detector, DetectorProcess) else None
    shown = _ReadOnlyFrames(frames)
    seconds, used_s, outcome = 0.0, 0.0, Outcome.ANSWERED
    try:
        if served:
            served.prepare(shown, calibration)
        start_s, used_before_s = stopwatch_s(), processor_s()
        try:
            # the bench's own output may be read by a program
            with undisturbed(), redirect_stdout(sys.stderr):
                if context and isinstance(detector, WithContext):
                    given: Any = detector.detect_with(shown, calibration, context)
                else:
                    given = detector.detect(shown, calibration)
        finally:
            seconds, used_s = stopwatch_s() - start_s, processor_s() - used_before_s
        if seconds > timeout_s:
            raise DetectionFailure(
                f"it answered after {timeout_s:g} s, which counts as no answer", Outcome.TIMEOUT
            )
        detection = checked(given, calibration)
        if served:
            served.check()
    except DetectionFailure as failure:
        outcome, detection = failure.outcome, _nothing(str(failure))
    except KeyboardInterrupt:
        raise
    # anyone's code: it may fail in any way, and not every library's errors are Exceptions
    except BaseException as error:
        outcome, detection = Outcome.FAILED, _nothing(named(error))
    start_up_s = served.start_up_s if served else None
    return Answer(
        name_of(detector),
        detection,
        seconds,
        outcome,
        cold=first or start_up_s is not None,
        start_up_s=start_up_s,
        stderr=served.said() if served else "",
        cpu_s=None if served else used_s,
        load=load_per_processor(),
    )


def close_detectors(detectors: Iterable[Detector]) -> None:
    """End what detectors hold outside of the bench's process."""
    for detector in detectors:
        if isinstance(detector, DetectorProcess):
            detector.close()


def score_answer(
    answer: Answer, truth: Sequence[TruthRow], *, limit_mm: float, time_limit_s: float
) -> SceneScore:
    """The score of one answer; no answer is no success, also where nothing was to be found. A first
    call (cold) is in time unless it was given up: a network may be made ready in it.
    """
    answered = answer.outcome is Outcome.ANSWERED
    score = score_scene(
        points_of(answer.detection),
        np.array([row.xyz_mm for row in truth]),
        np.array([row.visible for row in truth]),
        u_mm=max((row.u_mm for row in truth if row.u_mm is not None), default=0.0),
        seconds=answer.seconds,
        limit_mm=limit_mm,
        time_limit_s=math.inf if answer.cold else time_limit_s,
        hidden_claimed=answer.detection.hidden if answered else None,
    )
    in_time = score.in_time and answer.outcome is not Outcome.TIMEOUT
    return score if answered else replace(score, success=False, in_time=in_time)


def score_answers(
    answers: Iterable[Answer], truth: Sequence[TruthRow], *, limit_mm: float, time_limit_s: float
) -> dict[str, SceneScore]:
    """Scores by detector for all answers on one frame set; none without truth."""
    return {
        answer.detector: score_answer(answer, truth, limit_mm=limit_mm, time_limit_s=time_limit_s)
        for answer in (answers if truth else ())
    }


def points_of(detection: Detection) -> NDArray[np.float64]:
    """The teat ends (n, 3) in world mm."""
    return np.array([teat.world_mm for teat in detection.teats], dtype=np.float64).reshape(-1, 3)


def _nothing(why: str) -> Detection:
    return Detection((), 0, f"the detector failed: {one_line(why)}"[:LONGEST_REASON], ())


class _ReadOnlyFrames:
    """A frame set for one detector: read-only, and copied, since a library in C does not ask. So it
    can't change what others see and what is stored.
    """

    def __init__(self, frames: Frames) -> None:
        self.left, self.right = _fixed(frames.left), _fixed(frames.right)
        self.thermal, self.thermal_k = _fixed(frames.thermal), _fixed(frames.thermal_k)
        self.depth_mm, self.amplitude = map(_fixed, depth_of(frames))


def _fixed(picture: Any) -> Any:
    own = None if picture is None else picture.copy()
    if own is not None:
        own.setflags(write=False)
    return own
