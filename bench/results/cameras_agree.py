"""Whether the cameras show the touched teat ends where the calibration puts them: the bench's own
check of its cameras, pooled over a run, whichever detectors are under test. The same figure is
taken of a detector's answers, which a camera that was knocked shifts alike.

Disparity measures an end's depth. What the ends of a run's truth have in common (arm, table frame,
registration, reference touch) shifts the disparity too: of their mean, its standard uncertainty in
the worst direction is part of the uncertainty stated here. What is fresh to each end is part of the
scatter between poses.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from bench.config import ConfigError
from bench.record.reader import RunRecord, TrialRecord, points_mm, read_run
from bench.record.recording import Recording, RecordingError, TruthRow
from bench.record.schema import DATABASE
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.errors import Floats
from bench.scoring.joint import JointCovariance
from bench.script.model import CamerasRequirement
from bench.truth.joint import End, joint_truth
from detector.calibration import Calibration
from detector.geometry import Array
from detector.outline.known_ends import NO_THERMAL_MM, REACH_PX, EndOffsets, offsets_at
from detector.outline.offsets import THERMAL_REACH_PX
from detector.outline.pictures import UnusableError
from instruments.camera.frame import FrameSet
from textfiles.text import capital, plural

UNCHECKED_FACT = "cameras not checked"  # of a recording: why, and what was looked at
NOT_CHECKED = "not checked: whether the cameras show the known ends where they are"
LEAST_POSES, MOST_POSES = 3, 24
CONFIDENCE = 0.95  # of an interval, two-sided
DISPARITY = "disparity"
NAMES = (DISPARITY, "rows", "thermal columns", "thermal rows")
LEAST_MEASURED = 0.2  # share of the ends; fewer are measured by chance
SHARED = 0.5  # share of the cameras' shift that shared answers have at least
DEFAULT = CamerasRequirement(kind="cameras_agree", name="cameras agree with the known ends")
NEXT_UNSEEN = (
    "Look at the frames: is every camera where it was, sharp and lit, and are the ends those of the"
    " truth? Then 'teatbench calibrate check' with a board."
)


def where_seen(
    frames: FrameSet, calibration: Calibration, truth: Sequence[TruthRow]
) -> Mapping[str, EndOffsets]:
    """The visible teats of ``truth`` by name; none where the pictures can't be used."""
    with suppress(UnusableError, np.linalg.LinAlgError):
        return _seen(frames, calibration, truth)
    return {}


def _seen(
    frames: FrameSet, calibration: Calibration, truth: Sequence[TruthRow]
) -> Mapping[str, EndOffsets]:
    """As `where_seen`. Raises UnusableError, LinAlgError."""
    rows = [row for row in truth if row.visible]
    if not rows:
        return {}
    offsets = offsets_at(frames, calibration, np.array([row.xyz_mm for row in rows]))
    return {row.teat: one for row, one in zip(rows, offsets, strict=True)}


def spread(frames: Iterable[str]) -> frozenset[str]:
    """At most `MOST_POSES` of the frames, evenly spread: enough for the check of a recording."""
    every = list(frames)
    some = np.linspace(0, len(every) - 1, min(len(every), MOST_POSES)).round().astype(int)
    return frozenset(every[k] for k in some)


@dataclass(frozen=True, slots=True)
class CameraOffset:
    """The mean offset of one figure over ``poses``, px (of the sensor for the thermal camera), with
    the half width of its interval by their ``scatter`` and the expanded uncertainty of what their
    truths share (``common``). One pixel is ``mm`` of an end's depth, or a turn of ``deg``.
    """

    name: str
    value: float
    scatter: float
    common: float
    poses: int
    mm: float
    deg: float

    @property
    def uncertainty(self) -> float:
        """Expanded, of both parts."""
        return float(np.hypot(self.scatter, self.common))

    @property
    def text(self) -> str:
        """``disparity off by 0.50 ± 0.04 px``."""
        return f"{self.name} off by {self.value:z.2f} ± {self.uncertainty:.2f} px"

    def exceeds(self, limit_px: float) -> bool:
        """Beyond the limit by more than its uncertainty."""
        return abs(self.value) - self.uncertainty > limit_px


@dataclass(frozen=True, slots=True)
class CamerasCheck:
    """The figures with at least `LEAST_POSES` poses; how many ``ends`` there were, how many of them
    were ``measured`` in left and right, and in the ``thermal`` picture (None without one).
    """

    offsets: tuple[CameraOffset, ...] = ()
    poses: int = 0
    ends: int = 0
    measured: int = 0
    thermal: int | None = None

    @property
    def disparity(self) -> CameraOffset | None:
        return next((one for one in self.offsets if one.name == DISPARITY), None)

    @property
    def depth_error_mm(self) -> float:
        """The least depth error that the disparity shows, with confidence."""
        one = self.disparity
        return 0.0 if one is None else max(abs(one.value) - one.uncertainty, 0.0) * one.mm

    @property
    def decision(self) -> Decision:
        """By the limits that hold where a script names no others."""
        return decide_cameras(DEFAULT, self)

    def beyond(self, rule: CamerasRequirement) -> list[CameraOffset]:
        """The figures that exceed the rule's limits."""
        return [one for one in self.offsets if one.exceeds(limit_of(rule, one))]

    @property
    def unseen(self) -> str:
        """What can't be measured although there are pictures; empty where nothing is missing."""
        if self.poses < LEAST_POSES:
            return ""
        measured, columns_rows = self.measured, "more than {:g} px of columns or {:g} px of rows"
        where, of, reach = "left and right", self.ends, columns_rows.format(*REACH_PX)
        if measured >= LEAST_MEASURED * of and self.thermal is not None:
            measured, where, of = self.thermal, "the thermal picture", self.measured
            reach = f"more than {THERMAL_REACH_PX:g} sensor pixels"
        if measured >= LEAST_MEASURED * of:
            return ""
        return (
            f"only {measured} of {of} ends measured in {where}: off beyond what can be measured"
            f" ({reach}), or not shown"
        )


def limit_of(rule: CamerasRequirement, one: CameraOffset) -> float:
    """The limit of one figure, px."""
    return rule.limit_px if one.name in NAMES[:2] else rule.thermal_limit_px


def check_cameras(
    seen: Mapping[str, Sequence[Mapping[str, Any]]], truth: JointCovariance
) -> CamerasCheck:
    """The check of each pose's `EndOffsets`, as dicts; ``truth`` is that of the known ends, in the
    same order. A figure is the mean over poses of each pose's median; repeats of a pose count once.
    """
    if not seen:
        return CamerasCheck()
    columns = ("disparity_px", "rows_px", "mm_a_px", "thermal_mm_a_px", "deg_a_px")
    poses = [
        np.array([[*row["thermal_px"], *map(row.get, columns)] for row in rows], dtype=np.float64)
        for rows in seen.values()
    ]  # None becomes not-a-number
    every = np.concatenate(poses)
    groups = np.repeat(np.arange(len(poses)), [len(values) for values in poses])
    thermal, measured = (int(np.isfinite(every[:, k]).sum()) for k in (0, 2))
    mm, thermal_mm, deg = (np.median([np.median(v[:, k]) for v in poses]) for k in (4, 5, 6))
    offsets: list[CameraOffset | None] = []
    if measured >= LEAST_MEASURED * len(every):
        offsets += [
            _pooled(NAMES[0], every[:, 2], groups, truth, (mm, mm, deg)),
            _pooled(NAMES[1], every[:, 3], groups, None, (mm, mm, deg)),
        ]
        if thermal >= LEAST_MEASURED * measured:
            offsets += [
                _pooled(NAMES[2 + k], every[:, k], groups, truth, (thermal_mm, mm, deg))
                for k in (0, 1)
            ]
    looked = bool((every[:, 5] != NO_THERMAL_MM).any())
    found = tuple(one for one in offsets if one is not None)
    return CamerasCheck(found, len(poses), len(every), measured, thermal if looked else None)


def _pooled(
    name: str,
    values: Array,
    groups: npt.ArrayLike,
    truth: JointCovariance | None,
    scales: tuple[float, float, float],
) -> CameraOffset | None:
    """The mean over ``groups`` (n,) of the medians of their finite ``values`` (n,); ``truth`` is
    that of the ends where it counts. ``scales``: mm of the truth and of depth, and degrees, a px.
    """
    finite = np.isfinite(values)
    seen, own = np.unique(np.asarray(groups)[finite], return_inverse=True)
    n = len(seen)
    if n < LEAST_POSES:
        return None
    counts, ranked = np.bincount(own), values[finite][np.lexsort((values[finite], own))]
    first = np.cumsum(counts) - counts
    medians = 0.5 * (ranked[first + (counts - 1) // 2] + ranked[first + counts // 2])
    student = scipy.special.stdtrit(n - 1, 0.5 + CONFIDENCE / 2)
    scatter = float(student * medians.std(ddof=1) / np.sqrt(n))
    common_mm = 0.0
    if truth is not None:
        shared_mm2 = truth.of(finite).of_mean(1.0 / (n * counts[own]))
        common_mm = float(np.sqrt(np.linalg.norm(shared_mm2, ord=2)))
    common = float(2.0 * common_mm / scales[0])
    return CameraOffset(name, float(medians.mean()), scatter, common, n, *map(float, scales[1:]))


def unchecked_text(
    seen: Mapping[str, Mapping[str, EndOffsets]], truth: Mapping[str, Sequence[TruthRow]]
) -> str:
    """Why the cameras of these frames were not checked; empty where they were."""
    # Whether the ends of these poses, by name, are enough for the check
    rows = {pose: [asdict(one) for one in ends.values()] for pose, ends in seen.items() if ends}
    check = check_cameras(rows, JointCovariance.exact(sum(map(len, rows.values()))))
    if check.disparity is not None and not check.unseen:
        return ""
    measured = sum(one.disparity_px is not None for ends in seen.values() for one in ends.values())
    ends = sum(row.visible for frame in seen for row in truth.get(frame, ()))
    looked = f"{measured} of {ends} visible ends measured in {plural(len(seen), 'pose')}"
    return f"{NOT_CHECKED} ({looked})"


def unchecked_of(trials: Sequence[TrialRecord], check: CamerasCheck) -> str:
    """As `unchecked_text`, of a run's ``trials`` and their ``check``."""
    if check.disparity is not None and not check.unseen:
        return ""
    visible = [trial.pose for trial in trials for row in trial.truth if row["visible"]]
    looked = f"{check.measured} of {plural(len(visible), 'visible end')} measured"
    return f"{NOT_CHECKED} ({looked} in {plural(len(set(visible)), 'pose')})"


def truth_rows(trial: TrialRecord) -> list[TruthRow]:
    """A trial's known ends as a recording has them."""
    situation = str(trial.head["situation"])
    return [
        TruthRow(
            situation, r["teat"], (r["x_mm"], r["y_mm"], r["z_mm"]), bool(r["visible"]), r["u_mm"]
        )
        for r in trial.truth
    ]


def check_ends(
    folder: Path | str, calibration: Calibration, anew: Sequence[FrameSet] = ()
) -> CamerasCheck:
    """The check of a run's or recording's frames; of frames taken ``anew`` of the ends of its last
    frame. Fewer than `LEAST_POSES` poses are pooled over their ends. Raises ConfigError.
    """
    folder = Path(folder)
    try:
        recording = Recording(folder)
        truth = recording.truth
        run = RunRecord(folder, {}, tuple(_trial_of(*one) for one in truth.items()))
        if (folder / DATABASE).exists():
            run = read_run(folder)
            truth = {trial.id: tuple(truth_rows(trial)) for trial in run.counted}
        known = [
            frame for frame in recording.frames if any(r.visible for r in truth.get(frame, ()))
        ]
        if not known:
            raise ConfigError.plain(
                f"{folder}: there are no frames with visible known ends. Name the folder of a run"
                " that touched teats, or of a recording with truth.csv"
            )
        some = [known[-1]] * len(anew) if anew else sorted(spread(known))
        shots = anew or map(recording.load, some)
        seen = [
            (f"{number} {frame}", _seen(shot, calibration, truth[frame]))
            for number, (frame, shot) in enumerate(zip(some, shots, strict=True))
        ]
    except (RecordingError, UnusableError, np.linalg.LinAlgError) as error:
        raise ConfigError.plain(f"{folder}: its pictures can't be checked: {error}") from error
    each = len(set(some)) < LEAST_POSES
    trials = {trial.id: trial for trial in run.counted}
    rows: dict[str, list[tuple[End, dict[str, Any]]]] = defaultdict(list)
    for frame, (pose, ends) in zip(some, seen, strict=True):
        at = {str(row["teat"]): row for row in trials[frame].truth}
        for teat, one in ends.items():
            key = teat if anew else f"{pose} {teat}" if each else pose
            rows[key].append(((trials[frame], at[teat]), asdict(one)))
    return _checked(run, rows)


def _trial_of(frame: str, truth: Sequence[TruthRow]) -> TrialRecord:
    """A frame of a recording as a trial of a run."""
    axes = ("x_mm", "y_mm", "z_mm")
    rows: list[dict[str, Any]] = [
        {"teat": row.teat, "u_mm": row.u_mm, **dict(zip(axes, row.xyz_mm, strict=True))}
        for row in truth
    ]
    return TrialRecord({"id": frame, "invalid": None}, truth=rows)


@lru_cache(maxsize=2)  # verdicts, blame, health and tables ask for it
def cameras_of(run: RunRecord) -> CamerasCheck:
    """The check of a run's touched ends."""
    by_pose: dict[str, list[tuple[End, dict[str, Any]]]] = defaultdict(list)
    for trial in run.counted:
        for row in trial.truth:
            if row.get("cameras"):
                by_pose[trial.pose].append(((trial, row), json.loads(row["cameras"])))
    return _checked(run, by_pose)


def _checked(
    run: RunRecord, by_pose: Mapping[str, Sequence[tuple[End, dict[str, Any]]]]
) -> CamerasCheck:
    """The check of ends of ``run``, each with its offsets."""
    ends = [end for rows in by_pose.values() for end, _ in rows]
    seen = {pose: [one for _, one in rows] for pose, rows in by_pose.items()}
    return check_cameras(seen, joint_truth(run, ends))


@lru_cache(maxsize=4)  # of two runs' two detectors
def answers_of(run: RunRecord, detector: str, calibration: Calibration) -> CameraOffset | None:
    """The disparity between a detector's answers and the truth; None below `LEAST_POSES`."""
    ends: list[End] = []
    errors: list[Floats] = []
    for trial in run.counted:
        if (score := trial.scores.get(detector)) is not None and score.match.pairs:
            ends += [(trial, trial.truth[k]) for _, k in score.match.pairs]
            errors.append(score.errors_mm)
    if not ends:
        return None
    true = points_mm(row for _, row in ends)
    answered, known = (
        np.subtract(left[:, 0], right[:, 0])
        for left, right in map(calibration.project, (true + np.concatenate(errors), true))
    )
    numbers = {pose: at for at, pose in enumerate(dict.fromkeys(trial.pose for trial, _ in ends))}
    groups = [numbers[trial.pose] for trial, _ in ends]
    mm = float(np.median(calibration.depth_per_disparity_px_mm(true)))
    deg = float(np.degrees(1.0 / calibration.right.fc[0]))
    return _pooled(NAMES[0], answered - known, groups, joint_truth(run, ends), (mm, mm, deg))


def share_shift(cameras: CameraOffset, answers: CameraOffset) -> bool:
    """Whether the answers may have the cameras' shift: half of it, or what both scatter by. Both
    are held against the same truth, whose error cancels in the difference.
    """
    apart = abs(answers.value - cameras.value)
    alike = answers.value * np.sign(cameras.value) >= SHARED * abs(cameras.value)
    return bool(alike or apart <= np.hypot(answers.scatter, cameras.scatter))


def shift_text(check: CamerasCheck, answers: CameraOffset | None, limit_px: float) -> str:
    """Whose a common shift of the answers is; empty where there is none beyond the limit."""
    if answers is None or not answers.exceeds(limit_px):
        return ""
    sentence = (
        f"its ends have their {answers.text} alike over {answers.poses} poses, as if the right"
        f" camera were turned by {abs(answers.value) * answers.deg:.2f}°"
    )
    seen = check.disparity
    if seen is None:
        return f"{sentence}; the cameras could not be checked, so it may be either's fault"
    if check.depth_error_mm > 0.0 and share_shift(seen, answers):
        return f"{sentence}, and so have the cameras ({seen.text}): calibration, not detector"
    return f"{sentence}, but the cameras have not ({seen.text}): detector, not calibration"


def decide_cameras(rule: CamerasRequirement, check: CamerasCheck) -> Decision:
    """Not met where a figure is beyond its limit by more than its uncertainty; met where all are
    within by as much; not measured where no picture was compared with a touched end.
    """
    nothing = Decision(
        name=rule.name,
        rule=f"touched ends are seen within {rule.limit_px:g} px of where the calibration puts"
        f" them (disparity, rows), and within {rule.thermal_limit_px:g} sensor pixels in the"
        f" thermal picture; mean over poses, with {CONFIDENCE:.0%} confidence (two-sided)",
        unit="px",
        limit=rule.limit_px,
        sentence=f"It needs touched ends of at least {LEAST_POSES} poses that the cameras show.",
    )
    if check.disparity is None:
        if not check.unseen:
            return nothing
        text = f"{capital(check.unseen)}. {NEXT_UNSEEN}"
        return replace(nothing, n=check.poses, verdict=Verdict.INCONCLUSIVE, sentence=text)
    beyond, offsets = check.beyond(rule), check.offsets
    undecided = [one for one in offsets if abs(one.value) + one.uncertainty > limit_of(rule, one)]
    worst = max(beyond or offsets, key=lambda one: abs(one.value) / limit_of(rule, one))
    texts = [*(one.text for one in beyond or undecided or offsets[:2]), check.unseen]
    if check.disparity in beyond:
        off, per_px = abs(check.disparity.value), check.disparity
        texts.append(
            f"that disparity is as if the right camera were turned by {off * per_px.deg:.2f}°, and"
            f" puts every stereo detector's ends some {off * per_px.mm:.1f} mm off in depth"
        )
    text = f"{'; '.join(filter(None, texts))} ({check.measured} of {check.ends} ends measured)"
    verdict = Verdict.INCONCLUSIVE if undecided or check.unseen else Verdict.MET
    advice = f" {NEXT_UNSEEN}" if check.unseen else ""
    if beyond:
        verdict = Verdict.NOT_MET
        optical = any(one.name in NAMES[:2] for one in beyond)
        step = (
            "'calibrate cameras', what follows from it, then" if optical else "'calibrate thermal',"
        )
        advice = " It is the calibration's fault, not a detector's: look for a camera that was"
        advice += f" knocked; calibrate again ({step} 'merge')."
    limit = limit_of(rule, worst)
    return replace(
        nothing,
        n=worst.poses,
        measured=abs(worst.value),
        limit=limit,
        margin=limit - abs(worst.value),
        uncertainty=worst.uncertainty,
        verdict=verdict,
        sentence=f"{capital(text)}.{advice}",
    )
