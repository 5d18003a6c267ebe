"""Fresh frames from a live source, and a camera's own time stamps on the bench's clock.

A thread grabs all the time and decodes on request, since OpenCV keeps frames that nobody took: the
next one would be stale.
"""

from __future__ import annotations

import math
import threading

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock

DRIFT = 1e-4  # two crystals of 50 ppm each
LOOK_S = 0.002
KEPT_S = 600.0  # frames older than this say no more than their drift


class DeviceTime:
    """One camera's stamps on the bench's clock. A frame arrives after its stamp, so the least
    difference is the best offset; it may age by the drift of two crystals. A stamp that goes back
    starts anew.
    """

    def __init__(self) -> None:
        # arrival and offset, both in s on the bench's clock
        self._seen: list[tuple[float, float]] = []
        self._last_s = float("-inf")

    def bench_s(self, device_s: float, arrived_s: float) -> float:
        """Time of exposure of a frame stamped ``device_s`` (0: no stamp) that came at
        ``arrived_s``.
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


class LiveReader:
    """Owns ``capture`` from now on; OpenCV's captures are for one thread. To be closed."""

    def __init__(self, capture: cv2.VideoCapture, clock: Clock, name: str) -> None:
        self._capture = capture
        self._clock = clock
        self._lock = threading.Lock()
        self._wanted_s = math.inf
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
        """The frame (None: undecodable) and its arrival; None where none came within
        ``patience_s``.
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
                arrived_s = self._clock.now()
                if self._wanted(began_s):
                    good, image = self._capture.retrieve()
                    whole = good and image is not None
                    with self._lock:
                        if self._wanted(began_s):  # nobody has asked anew meanwhile
                            self._wanted_s = math.inf
                            self._got = np.asarray(image, np.uint8) if whole else None, arrived_s
        finally:
            self._capture.release()

    def _wanted(self, began_s: float) -> bool:
        return began_s >= self._wanted_s
