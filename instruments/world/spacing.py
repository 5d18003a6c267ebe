"""How near two solids come to each other: between round ones, the distance of their axes less their radii.

Exact for capsules and balls; flat ends and cones err to the near side, so that what is called free is free.
May not know what the solids are.
"""

from __future__ import annotations

import numpy as np

from instruments.world.optics import Floats
from instruments.world.solids import Hull


def clearance_mm(one: Hull, other: Hull) -> float:
    """Least distance between the surfaces, mm; negative where they share room. Of two tapered solids one counts with its wider end."""
    (a, b), (c, d) = _axis(one), _axis(other)
    wide, other_wide = max(one.radius_a_mm, one.radius_b_mm), max(other.radius_a_mm, other.radius_b_mm)
    coarse = segments_apart_mm(a, b, c, d) - wide - other_wide
    if coarse >= 0.0 or (one.radius_a_mm == one.radius_b_mm and other.radius_a_mm == other.radius_b_mm):
        return coarse
    if one.radius_a_mm != one.radius_b_mm:
        return _tapered_mm(one, c, d) - other_wide
    return _tapered_mm(other, a, b) - wide


def _tapered_mm(cone: Hull, start: Floats, end: Floats) -> float:
    """Least distance from a tapered solid's surface to a segment: a convex function of the place along its axis, searched by thirds."""
    a, b = _axis(cone)

    def gap_mm(part: float) -> float:
        return _point_apart_mm(a + part * (b - a), start, end) - cone.radius_a_mm - part * (cone.radius_b_mm - cone.radius_a_mm)

    low, high = 0.0, 1.0
    while high - low > 1e-6:
        third = (high - low) / 3.0
        low, high = (low, high - third) if gap_mm(low + third) < gap_mm(high - third) else (low + third, high)
    return gap_mm((low + high) / 2.0)


def _axis(hull: Hull) -> tuple[Floats, Floats]:
    return np.array(hull.a_mm), np.array(hull.b_mm)


def segments_apart_mm(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """Least distance between the segments a b and c d, each end (3,).

    The lines' own nearest points where they lie within both segments, else the nearest of the four ends to the other segment.
    """
    u, v, w = b - a, d - c, a - c
    uu, uv, vv, uw, vw = (float(np.dot(*pair)) for pair in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = uu * vv - uv * uv
    if det > 1e-12 * uu * vv > 0.0:
        s, t = (uv * vw - vv * uw) / det, (uu * vw - uv * uw) / det
        if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
            return float(np.linalg.norm(w + s * u - t * v))
    ends = ((a, c, d), (b, c, d), (c, a, b), (d, a, b))
    return min(_point_apart_mm(point, start, end) for point, start, end in ends)


def _point_apart_mm(point: Floats, start: Floats, end: Floats) -> float:
    along = end - start
    length2 = float(np.dot(along, along))
    part = 0.0 if length2 == 0.0 else float(np.clip(np.dot(point - start, along) / length2, 0.0, 1.0))
    return float(np.linalg.norm(point - start - part * along))
