"""How warm the thermal camera sees the teats: the witness of their level where the bath has no
sensor at them.

What a camera shows is off by its offset and by the paint, several kelvin for some, so that only
half of the way from the room to the bath is asked for: teats whose water stands are at the room.
But the offset stays: teats that are colder than they were in the same run show more closely that
their water stands.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median

import numpy as np

from detector.calibration import Calibration
from detector.geometry import Array
from instruments.camera.frame import FrameSet

TEATS_FACT = "teats not measured"  # of a run: why the temperature at the teats wasn't
INWARD_MM = (6.0, 10.0, 14.0, 18.0)  # along the axis from the end: on the teat, whatever its radius
WARM_SHARE = 0.5  # of the way from the room to the bath
FALL_K = 2.0  # in a run, of one and the same camera
LEAST_SPAN_K = 4.0  # between room and bath, for a camera to tell one from the other
ZERO_C_K = 273.15


@dataclass(frozen=True, slots=True)
class TeatsSeen:
    """Apparent temperatures of the teats whose ends are shown, or why there are none."""

    temps_c: tuple[float, ...] = ()
    why_not: str = ""

    @property
    def level_c(self) -> float | None:
        """Of most of the teats; None where none is shown."""
        return median(self.temps_c) if self.temps_c else None

    def cold(self, bath_c: float, room_c: float, before_c: float | None = None) -> str:
        """What is wrong, where most of the teats are no warmer than the room, or left the level
        ``before_c`` at which this run saw them first; else empty.
        """
        seen_c, least_c = self.level_c, room_c + WARM_SHARE * (bath_c - room_c)
        if seen_c is None:
            return ""
        shown = f"the thermal camera shows the teats at {seen_c:.1f} degC"
        if (seen_c < least_c) if bath_c > room_c else (seen_c > least_c):
            return f"{shown}, and the bath reads {bath_c:.2f} degC"
        if before_c is not None and abs(seen_c - before_c) > FALL_K:
            return f"{shown}, {before_c:.1f} degC at first; the bath reads {bath_c:.2f} degC"
        return ""


def teats_seen(
    frames: FrameSet,
    calibration: Calibration,
    ends_mm: Array,
    axes: Array,
    *,
    bath_c: float,
    room_c: float,
) -> TeatsSeen:
    """Of visible ends (k, 3), world frame, whose teats' unit ``axes`` (k, 3) point to them."""
    thermal_k, lens = frames.thermal_k, calibration.thermal.lens
    if thermal_k is None:
        return TeatsSeen(why_not="no sensor at the teats, and no thermal camera with temperatures")
    if lens is None or calibration.thermal_from_right is None:
        return TeatsSeen(why_not="no sensor at the teats, and a thermal camera without a place")
    if abs(bath_c - room_c) < LEAST_SPAN_K:
        return TeatsSeen(
            why_not=f"no sensor at the teats, and the room within {LEAST_SPAN_K:g} K of the bath"
        )
    on_axis = ends_mm[:, None] - np.multiply.outer(INWARD_MM, axes).transpose(1, 0, 2)
    right = calibration.world_from_right.inverse().apply(on_axis.reshape(-1, 3))
    pixels = lens.project(calibration.thermal_from_right.apply(right))
    rows, columns = thermal_k.shape
    scale = np.array(calibration.thermal.image_size) / (columns, rows)
    at = (pixels + 0.5) / scale - 0.5
    seen = [
        float(np.median(values)) - ZERO_C_K
        for teat in at.reshape(len(ends_mm), -1, 2)
        if len(values := _values(thermal_k, teat))
    ]
    return TeatsSeen(tuple(seen), "" if seen else "no teat end within the thermal picture")


def _values(thermal_k: Array, at: Array) -> Array:
    """The picture at pixels (n, 2); those beyond its edge are left out."""
    rows, columns = thermal_k.shape
    inside = np.isfinite(at).all(axis=1) & (at > -0.5).all(axis=1)
    inside &= (at < (columns - 0.5, rows - 0.5)).all(axis=1)
    x, y = np.rint(at[inside]).astype(int).T
    return np.asarray(thermal_k[y, x])
