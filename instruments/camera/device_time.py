"""A camera's own time stamps on the bench's clock.

Strategy: a frame arrives some while after its stamp, never before; so the least difference seen between arrival and stamp is the best
offset, and it may age no faster than two crystals drift apart. Pure: times are arguments.
"""

from __future__ import annotations

DRIFT = 1e-4  # two crystals of 50 ppm each
KEPT_S = 600.0  # frames older than this say no more than their drift


class DeviceTime:
    """Of one camera. A stamp that goes back means that the camera was started anew: all is forgotten."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []  # arrival and offset, both in s on the bench's clock
        self._last_s = float("-inf")

    def bench_s(self, device_s: float, arrived_s: float) -> float:
        """When a frame stamped ``device_s`` and seen at ``arrived_s`` was exposed; its arrival where the camera stamps nothing (0)."""
        if device_s <= 0.0:
            return arrived_s
        if device_s < self._last_s:
            self._seen.clear()
        self._last_s = device_s
        self._seen = [seen for seen in self._seen if arrived_s - seen[0] <= KEPT_S]
        self._seen.append((arrived_s, arrived_s - device_s))
        offset_s = min(offset + DRIFT * (arrived_s - at) for at, offset in self._seen)
        return min(device_s + offset_s, arrived_s)
