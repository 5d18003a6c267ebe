"""What a run looks like at this moment, as files in its folder for a viewer in another
process: `console/live.json` and small pictures of the last frames.

Written at most ten times a second, each file replaced as a whole, and gone when the run has ended.
It is no evidence: a file that can't be written stops nothing. No answer of a detector is in it.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.results.status import LIVE, RunStatus
from bench.safety.bath_monitor import BathMonitor
from bench.safety.interlocks import RULES
from bench.truth.touching import Ends
from instruments.camera.frame import FrameSet
from instruments.clock import stopwatch_s
from instruments.operators.mailbox import FOLDER
from textfiles.whole import replace_whole

EVERY_S = 0.1
WIDE_PX = 480  # of the pictures
QUALITY = 80
CAMERAS = ("left", "right", "thermal")


class Live:
    """The files of the run in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / FOLDER
        self._written_s = -EVERY_S
        self._frames = 0
        self._names: tuple[str, ...] = ()
        self._ends_mm: NDArray[np.float64] = np.zeros((0, 3))
        self._lock = threading.Lock()
        self._tip: dict[str, Any] | None = None
        self.ended = False

    @property
    def due(self) -> bool:
        """Whether enough time has passed since the last time that it was written."""
        return not self.ended and stopwatch_s() - self._written_s >= EVERY_S

    def expect(self, ends: Ends) -> None:
        """Where the teats of this trial end by its script."""
        self._ends_mm = ends.expected_mm
        self._names = tuple(map(ends.called, range(1, len(ends.expected_mm) + 1)))

    def frames(self, frames: FrameSet) -> None:
        with suppress(OSError, cv2.error):
            for name in CAMERAS:
                if (image := getattr(frames, name)) is not None:
                    tall = round(image.shape[0] * WIDE_PX / image.shape[1])
                    small = cv2.resize(image, (WIDE_PX, tall), interpolation=cv2.INTER_AREA)
                    _, data = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
                    self._replace(f"{name}.jpg", bytes(data))
            self._frames += 1

    def tip(self, tip_mm: NDArray[np.float64] | None) -> None:
        """Where the tip (3,) is in the world, where that is known."""
        self._tip = None if tip_mm is None else self._near(tip_mm)

    def write(self, status: RunStatus, more: Mapping[str, Any]) -> None:
        """``status``, with ``more`` for a page that shows it; from any thread."""
        with self._lock:
            if self.ended:
                return
            self._written_s = stopwatch_s()
            ends = zip(self._names, self._ends_mm.tolist(), strict=True)
            whole = {
                "status": status.as_dict(),
                **more,
                "tip": self._tip,
                "ends": [{"name": name, "mm": end} for name, end in ends],
                "frames": self._frames,
            }
            with suppress(OSError):
                self._replace(LIVE, json.dumps(whole, ensure_ascii=False).encode())

    def end(self) -> None:
        """The run has ended: its record says all."""
        with self._lock:
            self.ended = True
        for name in (LIVE, *(f"{camera}.jpg" for camera in CAMERAS)):
            with suppress(OSError):
                (self._folder / name).unlink(missing_ok=True)
        with suppress(OSError):
            self._folder.rmdir()  # where no prompt was answered

    def _near(self, tip_mm: NDArray[np.float64]) -> dict[str, Any]:
        away = np.linalg.norm(self._ends_mm - tip_mm, axis=1)
        found: dict[str, Any] = {"mm": [round(float(x), 2) for x in tip_mm]}
        if len(away):
            at = int(away.argmin())
            found |= {"nearest": self._names[at], "away_mm": round(float(away[at]), 1)}
        return found

    def _replace(self, name: str, data: bytes) -> None:
        self._folder.mkdir(exist_ok=True)
        # a viewer that has it open on Windows sees the next one: the run waits for no viewer
        replace_whole(self._folder / name, data, again_s=0.0)


def bath_state(watch: BathMonitor, expected_s: float, speed: float = 1.0) -> dict[str, Any]:
    """The bath as last read, with its gate; units in the keys. What is left is in the time of a
    person who watches a world that passes ``speed`` times as fast.
    """
    read = ("t_s", "temp_c", "external_c", "power_percent")
    return {
        **{key: getattr(watch.last, key, None) for key in read},
        "set_point_c": watch.gate.set_point_c,
        "band_k": watch.gate.leave_k,
        "state": watch.course,
        "why_not_stable": watch.why_not_stable,
        "stable_in_s": watch.stable_in_s(expected_s) / speed,
    }


def interlock_states(watch: BathMonitor) -> list[dict[str, Any]]:
    """Each interlock: "armed", "asleep" (the bath lacks the rows it needs) or "tripped"."""
    states = {rule.name: "armed" for rule in RULES}
    states |= dict.fromkeys(watch.interlocks.inactive, "asleep")
    states[getattr(watch.tripped, "rule", "")] = "tripped"
    return [{"name": rule.name, "state": states[rule.name]} for rule in RULES]
