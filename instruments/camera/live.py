"""A camera's own time stamps on the bench's clock.

Strategy: a frame arrives some while after its stamp, never before; so the least difference seen
between arrival and stamp is the best offset, and it may age no faster than two crystals drift
apart. Pure: times are arguments.

Reads a live source without pause, so that no stale frame waits in a buffer for whoever asks next.

OpenCV keeps frames that nobody took: after a minute of touching, the next one read would be a
minute old. A thread grabs all the time and decodes only what was asked for. May not know what kind
of source it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

DRIFT = 1e-4  # two crystals of 50 ppm each
KEPT_S = 600.0  # frames older than this say no more than their drift


class DeviceTime:
    """Of one camera. A stamp that goes back means that the camera was started anew: all is
    forgotten.
    """

    def __init__(self) -> None:
        # arrival and offset, both in s on the bench's clock
        self._seen: list[tuple[float, float]] = []
        self._last_s = float("-inf")

    def bench_s(self, device_s: float, arrived_s: float) -> float:
        """When a frame stamped ``device_s`` and seen at ``arrived_s`` was exposed; its arrival
        where the camera stamps nothing (0).
        """
        if device_s <= 0.0:
            return arrived_s
        if device_s < self._last_s:
            self._seen.clear()
        self._last_s = device_s
        self._seen = [seen for seen in self._seen if arrived_s - seen[0] <= KEPT_S]
        self._seen.append((arrived_s, arrived_s - device_s))
        offset_s = min(offset + DRIFT * (arrived_s - at) for at, offset in self._seen)
        return min(device_s + offset_s, arrived_s)


LOOK_S = 0.002


class Clock(Protocol):
    """What tells the time, and waits."""

    def now(self) -> float:
        """Seconds."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class LiveReader:
    """Owns ``capture`` from now on; OpenCV's captures are for one thread. To be closed."""

    def __init__(self, capture: cv2.VideoCapture, clock: Clock, name: str) -> None:
        self._capture = capture
        self._clock = clock
        self._lock = threading.Lock()
        self._wanted_s: float | None = None
        self._got: tuple[NDArray[np.uint8] | None, float] | None = None
        self._closing = False
        self.broken = False
        self._thread = threading.Thread(target=self._read, name=f"{name} camera", daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """The next frame that arrives whole from now on is wanted."""
        with self._lock:
            self._got, self._wanted_s = None, self._clock.now()

    def answer(self, patience_s: float) -> tuple[NDArray[np.uint8] | None, float] | None:
        """The frame asked for (None where it can't be decoded) and when it arrived; None where none
        came within ``patience_s``.
        """
        end_s = self._clock.now() + patience_s
        while self._clock.now() < end_s:
            with self._lock:
                if self._got is not None:
                    return self._got
            if self.broken:
                return None
            self._clock.sleep(LOOK_S)
        return None

    def close(self) -> None:
        """End the thread once it has its frame, or its source's time-out; may be called again."""
        self._closing = True
        self._thread.join()

    def _read(self) -> None:
        try:
            while not self._closing:
                began_s = self._clock.now()
                if not self._capture.grab():
                    self.broken = True
                    return
                self._keep(began_s, self._clock.now(), self._capture.retrieve)
        finally:
            self._capture.release()

    def _keep(
        self, began_s: float, arrived_s: float, retrieve: Callable[[], tuple[bool, object]]
    ) -> None:
        with self._lock:
            wanted = self._wanted_s is not None and began_s >= self._wanted_s
        if not wanted:
            return
        good, image = retrieve()
        with self._lock:
            # nobody has asked anew meanwhile
            if self._wanted_s is not None and began_s >= self._wanted_s:
                self._wanted_s = None
                self._got = (
                    (np.asarray(image, dtype=np.uint8) if good and image is not None else None),
                    arrived_s,
                )
