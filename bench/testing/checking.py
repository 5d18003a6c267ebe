"""Asks a detector about a scene, and says in a sentence where it fails."""

from __future__ import annotations

import atexit
import importlib
import math
import sys
import threading
from collections.abc import Hashable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.api.loading import load_rig
from bench.api.shots import Shot, open_detector, score
from bench.arguments import bare
from bench.config import ConfigError, check_within
from bench.results.answers import LIMIT_MM, Answer, examine, name_of
from bench.rig.scenes import rig_renderer
from bench.scoring.scene import SceneScore
from bench.testing.scene import Scene
from detector.protocol import Detection, Detector, DetectorProcess, Outcome
from reports.frames import TRUTH_COLOUR, answer_colour, answer_mark, places_of, strokes
from textfiles.bounds import ABOVE_0

GATE_MM = 25.0  # a missed or false teat is as bad as an error so large
MOST_KEPT = 4096
PATIENCE_S = 600.0  # of an object that gives no answer
NEIGHBOURS = 24
WIDTH_PX = 640  # of each picture


@dataclass(frozen=True, slots=True)
class SceneResult:
    """What a detector made of a scene. ``grade_mm``: the largest error, or stated deviation; of a
    failure above the limit, `GATE_MM` a lost or invented teat. ``fault``: a clause, empty for a
    success; ``late``: no answer came in time.
    """

    score: SceneScore
    grade_mm: float
    fault: str
    late: bool = False


Look = SceneResult  # its name in earlier releases, for one more


class Neighbourhood(NamedTuple):
    """Scenes one step away: those that fail, looked at, there; and the plainest that passes."""

    failing: int
    of: int
    there: int
    passing: Scene | None

    def __str__(self) -> str:
        if not self.of:
            return "No simpler scene was looked for, and none beside it: each may take as long."
        sample = "" if self.of == self.there else f" looked at, a sample of {self.there},"
        passes = f"; {self.passing!r} passes" if self.passing else ""
        return f"{self.failing} of {self.of} scenes one step away{sample} fail too{passes}."


class SceneFailedError(AssertionError):
    """A detector failed on a scene, which hypothesis makes simpler."""

    def __init__(
        self, detector: str | Detector, scene: Scene, look: SceneResult, limit_mm: float, rig: str
    ) -> None:
        super().__init__(f"{name_of(detector)} {look.fault} in {scene!r}")
        self.detector, self.scene, self.look = detector, scene, look
        self.limit_mm, self.rig = limit_mm, rig

    def neighbourhood(self) -> Neighbourhood:
        """How many of the scenes one step away fail too: of `NEIGHBOURS` at most, those that are
        plainer first, and evenly of the others; none where an answer is late.
        """
        looks, near = list[tuple[Scene, SceneResult]](), self.scene.neighbours()
        if self.look.late:
            return Neighbourhood(0, 0, len(near), None)
        plainer = [one for one in near if one.differences() < self.scene.differences()]
        others = [one for one in near if one not in plainer]
        each = -(-len(others) // max(1, NEIGHBOURS - len(plainer))) or 1
        for one in (*plainer, *others[::each]):
            with suppress(ConfigError):  # too near a camera
                looks.append((one, look(self.detector, one, self.limit_mm, rig=self.rig)))
        passed = sorted((one for one, seen in looks if not seen.fault), key=Scene.differences)
        failing = len(looks) - len(passed)
        return Neighbourhood(failing, len(looks), len(near), next(iter(passed), None))

    def picture(self) -> NDArray[np.uint8]:
        """Left, right, thermal picture beside each other (BGR), with the true ends and the answers
        in the colours and with the marks of a report.
        """
        shot = self.scene.draw(self.rig)
        none = Answer(name_of(self.detector), Detection(), 0.0, Outcome.TIMEOUT)
        answer = none if self.look.late else asked(self.detector, shot)
        return marked(shot, answer, self.rig)

    def lines(self) -> str:
        """A test of this scene alone, to be pasted. An object is imported by the name that a
        module has for it; without one a comment says what ``detector`` has to be.
        """
        rig = f", rig={self.rig!r}" if self.rig != "emulated" else ""
        words = ("Scene", "Teat", "Pose", "Object", "Applied")
        names = sorted({"check", *(name for name in words if f"{name}(" in repr(self.scene))})
        called, needed = _as_python(self.detector)
        return (
            f"from bench.testing import {', '.join(names)}\n{needed}\n\n"
            f"def test_simplest_scene():\n    check({called}, {self.scene!r},"
            f" limit_mm={self.limit_mm:g}{rig})\n"
        )


def check(
    detector: str | Detector,
    scene: Scene,
    limit_mm: float = LIMIT_MM,
    *,
    rig: str | Path = "emulated",
    timeout_s: float | None = None,
) -> SceneScore:
    """Draw a scene, ask ``detector`` (a name, a file, ``exec:COMMAND``, or one in Python) and score
    its answer, which counts as none after ``timeout_s`` (None: a program's own limits; ten minutes
    of an object). In a test of hypothesis the error is also what its search maximises. Raises
    SceneFailedError, and ConfigError for a scene that can't be drawn.
    """
    hypothesis: Any = sys.modules.get("hypothesis")
    searched = hypothesis and hypothesis.currently_in_test_context()
    if searched and late and scene not in late:
        hypothesis.reject()  # a simpler scene may take as long again
    found = (late or {}).get(scene)
    try:
        if isinstance(found, BaseException):
            raise found
        found = found or look(detector, scene, limit_mm, rig=str(rig), timeout_s=timeout_s)
    except BaseException as error:
        if late is not None and not isinstance(error, Exception):
            late[scene] = error  # as pytest-timeout's, which comes once
        raise
    if late is not None and found.late:
        late[scene] = found
    if searched:
        errors = importlib.import_module("hypothesis.errors")
        with suppress(errors.InvalidArgument):  # a second scene in one example
            hypothesis.target(found.grade_mm, label=f"{name_of(detector)}, mm")
    if found.fault:
        raise SceneFailedError(detector, scene, found, limit_mm, str(rig))
    return found.score


# scenes without an answer in time, of one test: the plug-in for pytest tells tests apart
late: dict[Scene, SceneResult | BaseException] | None = None


def look(
    detector: str | Detector,
    scene: Scene,
    limit_mm: float = LIMIT_MM,
    *,
    rig: str = "emulated",
    timeout_s: float | None = None,
) -> SceneResult:
    """As `check`, without raising for a failure of the detector."""
    check_within(ABOVE_0, timeout_s=timeout_s)
    looked = _look if isinstance(detector, Hashable) else _look.__wrapped__
    return looked(cast(Any, detector), scene, limit_mm, rig, timeout_s)


@lru_cache(maxsize=MOST_KEPT)
def _look(
    detector: Any, scene: Scene, limit_mm: float, rig: str, timeout_s: float | None
) -> SceneResult:
    shot = scene.draw(rig)
    answer = asked(detector, shot, timeout_s)
    result = score(answer, shot, limit_mm=limit_mm)
    worst = max(result.radial_mm, default=0.0)
    if not result.success:
        lost = result.counts.missed + result.counts.false or int(not result.radial_mm)
        grade = limit_mm + GATE_MM * lost + max(0.0, worst - limit_mm)
        too_late = answer.outcome is Outcome.TIMEOUT
        return SceneResult(result, grade, _fault(answer, result, worst, limit_mm), too_late)
    spread = [one.covariance_mm2 for one in answer.detection.teats]
    sd = max((float(np.sqrt(np.trace(one))) for one in spread if one is not None), default=0.0)
    return SceneResult(result, min(limit_mm, max(worst, sd)), "")


def _fault(answer: Answer, result: SceneScore, worst_mm: float, limit_mm: float) -> str:
    if answer.outcome is not Outcome.ANSWERED:
        return f"gave no answer ({answer.detection.reason})"
    counts = result.counts
    parts = [f"misses {counts.missed} of {counts.visible} visible ends"] if counts.missed else []
    parts += [f"finds {counts.false} where no teat end is"] if counts.false else []
    if worst_mm > limit_mm:
        parts.append(f"is {worst_mm:.1f} mm off (limit {limit_mm:g} mm)")
    return " and ".join(parts)


def asked(detector: str | Detector, shot: Shot, timeout_s: float | None = None) -> Answer:
    """The answer of a detector whose process goes on to live. An object that hangs is left behind
    in its thread.
    """
    one = _named(detector) if isinstance(detector, str) else bare(detector)
    limit_s = timeout_s or PATIENCE_S
    if isinstance(one, DetectorProcess):
        one.most_s = timeout_s or math.inf
        return examine(one, shot.frames, shot.calibration, timeout_s=limit_s)
    job: Future[Answer] = Future()

    def ask() -> None:
        try:
            job.set_result(examine(one, shot.frames, shot.calibration, timeout_s=limit_s))
        except BaseException as error:
            job.set_exception(error)

    printed = sys.stdout  # which an answer changes while it is awaited
    threading.Thread(target=ask, name=f"{name_of(one)}, asked", daemon=True).start()
    try:
        return job.result(limit_s)
    except TimeoutError:
        nothing = Detection(reason=f"there was none within {limit_s:g} s")
        return Answer(name_of(one), nothing, limit_s, Outcome.TIMEOUT)
    finally:
        sys.stdout = printed


def _as_python(detector: str | Detector) -> tuple[str, str]:
    """An expression for a detector, and a line that it needs."""
    if isinstance(detector, str):
        return repr(detector), ""
    for module, there in list(sys.modules.items()):
        for name, one in list(getattr(there, "__dict__", {}).items()):
            if one is detector:
                return name, f"from {module} import {name}\n"
    kind = type(detector)
    return "detector", f"# detector: the {kind.__qualname__} of {kind.__module__} that failed\n"


@cache
def _named(name: str) -> Detector:
    return _open.enter_context(open_detector(name))


_open = ExitStack()
atexit.register(_open.close)


def marked(shot: Shot, answer: Answer, rig: str) -> NDArray[np.uint8]:
    """A shot's pictures with truth and answers, beside each other, (h, w, 3)."""
    who = places_of([answer.detector])[answer.detector]
    dark, green, tone = (_bgr(of) for of in ("#000000", TRUTH_COLOUR, answer_colour(who)))
    renderer = rig_renderer(load_rig(rig), 1)
    frames = shot.frames
    true = np.array([row.xyz_mm for row in shot.truth]).reshape(-1, 3)
    found = np.array([one.world_mm for one in answer.detection.teats]).reshape(-1, 3)
    parts = []
    for camera, grey in zip(renderer.cameras, (frames.left, frames.right), strict=False):
        picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
        for u, v in _places(camera.project(true)):
            for colour, wide in ((dark, 4), (green, 2)):
                cv2.circle(picture, (u, v), 14, colour, wide, cv2.LINE_AA)
        for u, v in _places(camera.project(found)):
            lines = [np.rint(line).astype(np.int32) for line in strokes(answer_mark(who, u, v, 11))]
            for colour, wide in ((dark, 4), (tone, 2)):
                cv2.polylines(picture, lines, False, colour, wide, cv2.LINE_AA)
        parts.append(picture)
    if frames.thermal is not None:
        parts.append(cv2.cvtColor(np.asarray(frames.thermal), cv2.COLOR_GRAY2BGR))
    high = round(WIDTH_PX * parts[0].shape[0] / parts[0].shape[1])
    sized = [cv2.resize(one, (WIDTH_PX, high), interpolation=cv2.INTER_AREA) for one in parts]
    return np.asarray(np.concatenate(sized, axis=1), dtype=np.uint8)


def _bgr(colour: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(colour[1:])
    return blue, green, red


def _places(px: NDArray[np.float64]) -> Sequence[tuple[int, int]]:
    return [(u, v) for u, v in np.clip(np.nan_to_num(px), -1e4, 1e4).round().astype(int).tolist()]
