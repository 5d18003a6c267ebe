"""The cameras of a rehearsal: pictures that nobody looks at, at no cost, but for a few trials whose
frames are rendered and looked at.

Rendering is what a rehearsal of a thousand trials can't afford. The rendered sets go through the
rig's own frame checks, tell what a set takes on the disk, and the first is shown to each detector.
A fault of theirs is met, and the rehearsal goes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.dry_run.findings import Course
from bench.files import png_bytes
from bench.results.answers import Examiner
from bench.rig.devices import Cameras
from bench.rig.frame_capture import FrameTaker
from bench.rig.loading import LoadedRig
from bench.rig.model import Checks, FocusTable
from bench.run.rows import stage_pictures
from bench.script.planned_trials import PlannedTrial
from detector.calibration import Calibration
from detector.protocol import Detector, Outcome
from instruments.camera.frame import FrameSet, Grey
from instruments.clock import Clock
from instruments.errors import DeviceError

MOST_SETS = 12  # a second or so each on a busy machine
DARK, LIGHT = 60, 180  # of a picture that passes for one


def lenient(rig: LoadedRig) -> LoadedRig:
    """``rig`` for pictures that are all alike: nothing is compared, and no edge is measured."""
    checks = Checks(
        frozen=False,
        swapped=False,
        focus_px=FocusTable(),
        flat_dn=0,
        saturated_share=1.0,
        black_dn=0,
    )
    cameras = rig.rig.cameras.model_copy(update={"checks": checks})
    return replace(rig, rig=rig.rig.model_copy(update={"cameras": cameras}))


def to_render(planned: Sequence[PlannedTrial], most: int = MOST_SETS) -> frozenset[str]:
    """Ids of the trials whose frames are rendered: the first of each of the script's tables, and
    evenly spaced poses; at most ``most``.
    """
    tables = list({one.trial.name: one.id for one in reversed(planned)}.values())[::-1][:most]
    poses = list({one.name: one.id for one in reversed(planned)}.values())[::-1]
    left = [one for one in poses if one not in tables]
    room = min(most - len(tables), len(left))
    return frozenset([*tables, *(left[int((at + 0.5) * len(left) / room)] for at in range(room))])


def stand_in(calibration: Calibration) -> FrameSet:
    """Pictures of the calibration's sizes that rise from dark to light."""
    c = calibration
    return FrameSet(
        _ramp(c.left.image_size), _ramp(c.right.image_size), _ramp(c.thermal.image_size)
    )


def _ramp(size: tuple[int, int]) -> Grey:
    width, height = size
    return np.tile(np.linspace(DARK, LIGHT, width).astype(np.uint8), (height, 1))


class StandInCameras:
    """``cameras`` render at the trials that are ``due``, and what they give has to pass the checks
    of ``rig``, as they stand.

    ``takes_s`` is how long a frame set takes. ``rendered`` are the sets that passed.
    """

    def __init__(
        self,
        cameras: Cameras,
        rig: LoadedRig,
        course: Course,
        due: frozenset[str],
        detectors: Sequence[Detector],
        clock: Clock,
    ) -> None:
        self._cameras = cameras
        self._taker = FrameTaker(
            cameras, rig.rig.cameras, rig.calibration, clock.sleep, lambda _kind, _text: None
        )
        self._stand_in = stand_in(rig.calibration)
        self._course = course
        self._due = set(due)
        self._detectors = detectors
        self._examiner = Examiner(rig.calibration, rig.rig.limits.detection_timeout_s)
        self._clock = clock
        self._set_bytes = self._stage_bytes = 0
        self.rendered = 0
        self.takes_s = 0.0

    @property
    def identity(self) -> Mapping[str, str]:
        """As the cameras say."""
        return self._cameras.identity

    def capture(self) -> FrameSet:
        """At a trial that is due, its frames are rendered first, and looked at."""
        self._clock.sleep(self.takes_s)
        trial = self._course.trial_now
        if trial is not None and trial.id in self._due:
            self._due.remove(trial.id)
            self._look()
        return self._stand_in

    def close(self) -> None:
        self._cameras.close()

    def bytes_of(self, trials: int) -> float:
        """What the pictures of so many trials take on the disk, by those that were rendered, and
        what detectors leave with each.
        """
        return (
            trials * (self._set_bytes / self.rendered + self._stage_bytes) if self.rendered else 0.0
        )

    def _look(self) -> None:
        try:
            frames = self._taker.take()
        except DeviceError as fault:
            self._course.met("frames", str(fault))
            return
        pictures = (frames.left, frames.right, frames.thermal, frames.thermal_ck)
        self._set_bytes += sum(
            len(png_bytes(picture)) for picture in pictures if picture is not None
        )
        self.rendered += 1
        if self.rendered == 1:
            for detector in self._detectors:
                self._show(detector, frames)

    def _show(self, detector: Detector, frames: FrameSet) -> None:
        answer = self._examiner.ask(detector, frames)
        if answer.outcome is not Outcome.ANSWERED:
            self._course.met("detector", f"{detector.name}: {answer.detection.reason}")
        self._stage_bytes += sum(
            len(png_bytes(picture)) for picture in stage_pictures(answer).values()
        )
