"""What every detector takes and gives: structural protocols and plain values. A detector never sees
the scene, the truth or the script.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array

Image = NDArray[Any]
# a family of situations, or a script -> members of the family, or seeds of the script: first, last
TrainedOn = Mapping[str, tuple[tuple[int, int], ...]]


class Frames(Protocol):
    """left, right: (rows, columns) grey, uint8 or uint16, of the calibration's sizes. thermal: as
    delivered, or None. thermal_k: kelvin at sensor resolution, never mirrored, or None.
    """

    @property
    def left(self) -> Image: ...
    @property
    def right(self) -> Image: ...
    @property
    def thermal(self) -> Image | None: ...
    @property
    def thermal_k(self) -> Image | None: ...


def depth_of(frames: Frames) -> tuple[Image | None, Image | None]:
    """``depth_mm``: (rows, columns) mm along the optical axis of a depth camera, NaN where nothing
    was measured. ``amplitude``: (rows, columns) strength of its signal in the camera's unit. None
    of frames without them.
    """
    return getattr(frames, "depth_mm", None), getattr(frames, "amplitude", None)


@dataclass(frozen=True, slots=True, eq=False)
class Teat:
    """One teat end: world (3,) mm, covariance (3, 3) mm^2 or None, and its pixels (2,)."""

    world_mm: Array
    covariance_mm2: Array | None = None
    left_px: Array | None = None
    right_px: Array | None = None
    thermal_px: Array | None = None  # in the un-mirrored picture


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """One step of a detector as the report may show it: a name and what the step gave, by name."""

    name: str
    data: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A detector's answer on one frame set.

    hidden: teats believed there but unseen. reason: why nothing was found or what was left out,
    else None. predicted: where unseen ends are expected by the cow's history; never counted as
    found.
    """

    teats: tuple[Teat, ...] = ()
    hidden: int = 0
    reason: str | None = None
    trace: tuple[Stage, ...] = ()
    predicted: tuple[Teat, ...] = ()

    def stage(self, name: str) -> Stage | None:
        """The stage of that name, or None where the detector didn't get that far."""
        return next((stage for stage in self.trace if stage.name == name), None)


class Detector(Protocol):
    """`parameters`: every setting that changes an answer, for the configuration hash. One that
    states covariances may have a `covariance_leaves_out`, one whose time depends on what computes
    it a `computed_by` and a `device`: phrases that the report quotes. One that was trained may have
    a `trained_on` (`trained_on_of`), on which it isn't scored. One that not every rig suits may
    have a `refuses` (calibration -> why not, or None), asked before the first frame.
    """

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def parameters(self) -> Mapping[str, Any]: ...

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends, world frame; an unusable frame set gives a reason, never an exception."""
        ...


def trained_on_of(given: Any) -> TrainedOn:
    """What a detector says that it was trained on: ``{"ideal": [[0, 199], 300]}``, ranges with both
    ends or single numbers. Raises ValueError.
    """

    def span(one: Any) -> tuple[int, int]:
        ends = one if isinstance(one, list | tuple) and len(one) == 2 else (one, one)
        if any(type(end) is not int for end in ends) or not 0 <= ends[0] <= ends[1]:
            raise ValueError(wanted)
        return ends[0], ends[1]

    wanted = '"trained_on" must be like {"ideal": [[0, 199], 300]}: first and last, or one number'
    whole = isinstance(given, Mapping) and all(isinstance(name, str) for name in given)
    if not whole or not all(isinstance(spans, list | tuple) for spans in given.values()):
        raise ValueError(wanted)
    return {name: tuple(map(span, spans)) for name, spans in given.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """An earlier visit of a cow, its ends confirmed (attached or touched): ``teats`` (n,) numbers
    from 1, ``ends_mm`` (n, 3) world, ``covariances_mm2`` (n, 3, 3).
    """

    hours_ago: float
    hours_since_milking: float
    teats: tuple[int, ...]
    ends_mm: Array
    covariances_mm2: Array


@dataclass(frozen=True, slots=True)
class CamerasOff:
    """What a bench has found of its cameras so far in a run, beyond its limit: the known ends have
    their disparity off by so many px, with this expanded uncertainty, over so many poses.
    """

    disparity_px: float
    u_px: float
    poses: int


@dataclass(frozen=True, slots=True)
class Context:
    """Which cow stands there: hours since she was milked, days in milk (None: not known), and her
    earlier visits, the oldest first. And what is known of the cameras, where they are off.
    """

    hours_since_milking: float | None = None
    days_in_milk: float | None = None
    visits: tuple[Visit, ...] = ()
    cameras: CamerasOff | None = None


@runtime_checkable
class WithContext(Protocol):
    """A detector that can use a cow's history for ``predicted`` ends and what is known of the
    cameras for what it states, as well as plain `detect`.
    """

    def detect_with(
        self, frames: Frames, calibration: Calibration, context: Context
    ) -> Detection: ...


class Outcome(Enum):
    """What became of one call of a detector: each is scored as what it is."""

    ANSWERED = "answered"
    TIMEOUT = "timeout"
    FAILED = "failure"
    OFF = "switched off"


class DetectionFailure(Exception):  # noqa: N818 - a failure of the detector, not of the bench
    """No usable answer; the message is one sentence."""

    def __init__(self, reason: str, outcome: Outcome = Outcome.FAILED) -> None:
        super().__init__(reason)
        self.outcome = outcome


@runtime_checkable
class DetectorProcess(Protocol):
    """A detector in another process: `Detector`, and what happens around a call.

    patience_s: the longest `prepare` and `detect` together; most_s: the same, as a caller wants it.
    start_up_s: of the last `prepare`, None where it ran already. introduce: start the process, so
    that it says what it was trained on and its device; where it can't be started, `prepare` fails.
    prepare: start it where none runs, and write its pictures; check: its limits between calls,
    outside of its time; both raise DetectionFailure. said: its standard error since the last call,
    the end of it where long. close: end its processes and remove its files; once more is no error.
    """

    most_s: float

    @property
    def patience_s(self) -> float: ...
    @property
    def start_up_s(self) -> float | None: ...

    def introduce(self) -> None: ...
    def prepare(self, frames: Frames, calibration: Calibration) -> None: ...
    def check(self) -> None: ...
    def said(self) -> str: ...
    def close(self) -> None: ...
