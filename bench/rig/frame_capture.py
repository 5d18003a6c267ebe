"""Takes a frame set that may be measured with: checks each, takes it again where something is
wrong, and at last refuses. Every fault is an event of the record and counted, also one that the
next try cured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from bench.rig.camera_model import Cameras as CamerasTable
from bench.rig.devices import Cameras
from bench.rig.frame_checks import FrameChecks, FrameProblem
from detector.calibration import Calibration
from instruments.camera.frame import FrameError, FrameFault, FrameSet
from instruments.errors import DeviceError

EVENT = "camera"
HINTS: Mapping[FrameFault, str] = {
    FrameFault.DROPPED: "Look at the camera's cable and power.",
    FrameFault.LOST_PACKETS: "Lower the frame rate, or raise packet size and socket buffers.",
    FrameFault.LATE: "Use a common trigger, or allow more skew in the rig file if nothing moves.",
    FrameFault.WRONG_SIZE: (
        "Set the camera's resolution, or turn the picture, in the rig file; or calibrate anew."
    ),
    FrameFault.FROZEN: "Restart the camera.",
    FrameFault.BLACK: "Take the lens cap off, or switch the light on.",
    FrameFault.SATURATED: "Expose shorter, or dim the light.",
    FrameFault.HALF: "Look at the camera's cable; its link may be too slow.",
    FrameFault.FLAT_FIELD: (
        "Wait for the camera to finish its correction, or let it wait longer between tries"
        " (retry_s)."
    ),
    FrameFault.OUT_OF_FOCUS: "Set the lens with 'teatbench camera focus'.",
    FrameFault.SWAPPED: "Exchange the left and the right camera's addresses in the rig file.",
}


class FrameTaker:
    """``wait`` lets time pass between tries, ``tell`` writes an event down (its kind and text).

    A recording is not asked twice: its next frame is another trial's. ``checks`` are the table's
    where none are given.
    """

    def __init__(
        self,
        cameras: Cameras,
        table: CamerasTable,
        calibration: Calibration | None,
        wait: Callable[[float], None],
        tell: Callable[[str, str], None],
        *,
        checks: FrameChecks | None = None,
    ) -> None:
        recorded = table.url.startswith("recording:")
        self._cameras = cameras
        self._recorded = recorded
        self._checks = checks or FrameChecks(
            table.checks, table.max_skew_s, calibration, flat=not recorded
        )
        self._retries = 0 if recorded else table.retries
        self._retry_s = table.retry_s
        self._wait = wait
        self._tell = tell
        self.counts: Counter[str] = Counter()

    def take(self) -> FrameSet:
        """A frame set without a fault. Raises DeviceError after the last try, and what the cameras
        raise when they are gone.
        """
        for left in range(self._retries, -1, -1):
            frames, noticed = self._try()
            if frames is not None and not noticed:
                return frames
            self.counts.update(f"{one.camera}: {one.fault}" for one in noticed)
            what = "; ".join(str(one) for one in noticed)
            self._tell(EVENT, f"{what}. {_next(left)}.")
            if left:
                self._wait(self._retry_s)
        raise _refused(noticed, self._retries + 1)

    def look(self) -> None:
        """See whether the cameras give a usable frame set now, which is not kept; a recording is
        not asked. Raises as ``take``.
        """
        if self._recorded:
            return
        frames, noticed = self._try()
        if frames is None or noticed:
            raise _refused(noticed, 1)

    def _try(self) -> tuple[FrameSet | None, Sequence[FrameProblem]]:
        try:
            frames = self._cameras.capture()
        except FrameError as error:
            return None, [FrameProblem(error.fault, error.camera, str(error))]
        return frames, self._checks.notice(frames)


def _next(left: int) -> str:
    if left == 0:
        return "Refused"
    return f"Taken again; {left} {'try is' if left == 1 else 'tries are'} left"


def _refused(noticed: Sequence[FrameProblem], tries: int) -> DeviceError:
    hints = dict.fromkeys(HINTS[one.fault] for one in noticed)
    what = (
        f"no usable frame set in {tries} {'try' if tries == 1 else 'tries'}:"
        f" {'; '.join(str(one) for one in noticed)}"
    )
    return DeviceError("cameras", what, asked="a frame set", hint=" ".join(hints))
