"""A situation: what stands where before the cameras, and whether it can be set up: no overlaps,
ends within reach of arm and cameras. The cameras are a box of the thesis rig's bearings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import combinations
from typing import Any

import numpy as np

from instruments.world.backdrop import Backdrop
from instruments.world.boards import Board
from instruments.world.objects import TEAT_PAINT, SceneObject
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom
from instruments.world.sensor import Exposure
from instruments.world.shading import Lighting, Paint
from instruments.world.solids import Bools, Hull
from instruments.world.state import TEAT_FALL, SceneState


@dataclass(frozen=True, slots=True, weakref_slot=True)
class Situation:
    """One member of a family: what stands where, light, paint, exposure. ``about``: what to set up.
    ``cooler_k``: each teat than the water makes it; ``ends_cooler_k``: each end than its base;
    ``room_c``: None for as it is.
    """

    name: str
    seed: int
    about: str
    phantom: Phantom
    objects: tuple[SceneObject, ...] = ()
    boards: tuple[Board, ...] = ()
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop = field(default_factory=Backdrop)
    teat_paint: Paint = TEAT_PAINT
    exposure: Exposure = field(default_factory=Exposure)
    cooler_k: tuple[float, ...] = ()
    ends_cooler_k: float = 0.0
    room_c: float | None = None

    def state(
        self, teat_temps_c: tuple[float, ...], hose_temp_c: float, ambient_c: float, **more: Any
    ) -> SceneState:
        """The scene at these temperatures of the plant; ``more`` are fields of `SceneState`."""
        shared = {f.name for f in fields(SceneState)}
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name in shared}
        if self.cooler_k:
            teat_temps_c = tuple(np.subtract(teat_temps_c, self.cooler_k).tolist())
        room_c = ambient_c if self.room_c is None else self.room_c
        if self.ends_cooler_k and teat_temps_c:
            excess_k = max(float(np.mean(teat_temps_c)) - room_c, 1.0)
            usual = more.get("teat_fall", TEAT_FALL)
            more["teat_fall"] = usual + self.ends_cooler_k / excess_k
        return SceneState(
            **own
            | {"teat_temps_c": teat_temps_c, "hose_temp_c": hose_temp_c, "ambient_c": room_c}
            | more
        )


# left, right, thermal
EYES_MM = ((-263.0, -840.0, 62.0), (-163.0, -841.0, 62.0), (-212.0, -841.0, 62.0))
# to the right, per mm away: the thermal camera's view and some room to spare
BEARINGS = (-0.050, 0.225)
RISE = 0.103
REACH_MM = ((-330.0, 100.0, 60.0), (50.0, 420.0, 185.0))  # where the arm touches with ease
STYLUS_MM = 12.0  # room around the stylus, which comes from above
STYLUS_LONG_MM = 120.0
GAP_MM = 2.0  # between things that don't touch


def situation_faults(situation: Situation) -> tuple[str, ...]:
    """What is wrong with a situation, in words; nothing for one that can be set up."""
    found, (low, high) = [], np.asarray(REACH_MM)
    for i, end in enumerate(situation.phantom.ends_mm, 1):
        x, y, z = end.tolist()
        if not np.all((end >= low) & (end <= high)):
            found.append(
                f"the end of teat {i} at {end.round().tolist()} mm is out of the arm's reach"
            )
        stylus = Hull((x, y, z + STYLUS_MM + 1.0), (x, y, z + STYLUS_LONG_MM), 1.0, 1.0)
        for thing in situation.objects:
            if _least_gap((stylus,), thing.hulls) < STYLUS_MM:
                found.append(f"{thing.name} is in the way of touching teat {i}")
        away = end - np.asarray(EYES_MM[2])
        if not (BEARINGS[0] <= away[0] / away[1] <= BEARINGS[1] and abs(away[2] / away[1]) <= RISE):
            found.append(f"the end of teat {i} is out of the cameras' view")
    return (*found, *collisions(situation))


def collisions(situation: Situation) -> Iterator[str]:
    """Things that stand within each other, in words."""
    teats = situation.phantom.teat_hulls()
    for (i, one), (j, other) in combinations(enumerate(teats), 2):
        if _least_gap(one, other) < 0.0:
            yield f"teats {i + 1} and {j + 1} stand in each other"
    feet = (*situation.phantom.flange_hulls(), *situation.phantom.udder_hulls())
    solid = (*(hull for hulls in teats for hull in hulls), *feet)
    for thing in situation.objects:
        if _least_gap(thing.hulls, solid) < GAP_MM:
            yield f"{thing.name} stands within the phantom"
    for one_thing, other_thing in combinations(situation.objects, 2):
        if _least_gap(one_thing.hulls, other_thing.hulls) < GAP_MM:
            yield f"{one_thing.name} and {other_thing.name} stand in each other"
    for board in situation.boards:
        u, v = np.meshgrid(np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, 25))
        points = board.placed(np.column_stack([u.ravel(), v.ravel()]) * board.pattern.size_mm)
        every = (*solid, *(hull for thing in situation.objects for hull in thing.hulls))
        if every and _apart(points, every).min() < GAP_MM:
            yield f"{board.name} stands within something else"


def hidden_ways(situation: Situation) -> Bools:
    """Whether objects or boards hide each end (n,) from three eyes (n, 3); teats don't count."""
    ends = situation.phantom.ends_mm
    solids = [hull for thing in situation.objects for hull in thing.hulls]
    hidden = np.zeros((len(ends), len(EYES_MM)), dtype=np.bool_)
    for e, eye in enumerate(EYES_MM):
        for i, end in enumerate(ends):
            way = Hull(eye, tuple(eye + 0.995 * (end - eye)), 0.01, 0.01)
            hidden[i, e] = _least_gap((way,), solids) < 0.0 or any(
                _crosses(np.asarray(eye), end, board.outline_mm) for board in situation.boards
            )
    return hidden


def _crosses(start: Floats, end: Floats, outline: Floats) -> bool:
    """Whether a way passes through a rectangle (4, 3)."""
    corner, across, along = outline[0], outline[1] - outline[0], outline[3] - outline[0]
    part, u, v = np.linalg.solve(np.column_stack([end - start, -across, -along]), corner - start)
    return bool(0.0 < part < 1.0 and 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0)


ALONG = np.linspace(0.0, 1.0, 33)


def _least_gap(ones: Sequence[Hull], others: Sequence[Hull]) -> float:
    """The least gap between these and those, taken as round; negative: overlap."""
    if not ones or not others:
        return np.inf
    a, b, start, end = _columns(ones)
    points = (a[:, None] + ALONG[:, None] * (b - a)[:, None]).reshape(-1, 3)
    radii = (start[:, None] + ALONG * (end - start)[:, None]).ravel()
    return float((_apart(points, others) - radii[:, None]).min())


def _apart(points: Floats, hulls: Sequence[Hull]) -> Floats:
    """Gaps (n, m) between points (n, 3) and solids taken as round."""
    a, b, start, end = _columns(hulls)
    span, off = b - a, points[:, None] - a
    square = np.maximum(np.sum(span * span, axis=1), 1e-9)
    along = np.clip(np.sum(off * span, axis=2) / square, 0.0, 1.0)
    off -= along[..., None] * span
    return np.asarray(np.sqrt(np.sum(off * off, axis=2)) - start - along * (end - start))


def _columns(hulls: Sequence[Hull]) -> tuple[Floats, Floats, Floats, Floats]:
    """Both ends (n, 3) and radii (n,) of solids."""
    a, b = np.array([(one.a_mm, one.b_mm) for one in hulls]).transpose(1, 0, 2)
    start, end = np.array([(one.radius_a_mm, one.radius_b_mm) for one in hulls]).T
    return a, b, start, end


def apart(phantom: Phantom, eyes_mm: Sequence[tuple[float, float, float]]) -> float:
    """Least gap between two teats in any view, in mm at the nearer one; negative where covered."""
    least, hulls = np.inf, phantom.teat_hulls()
    for eye_x, eye_y, _ in eyes_mm:
        bearings = []
        for solids in hulls:
            (foot_x, foot_y, _), (end_x, end_y, _) = solids[0].a_mm, solids[-1].b_mm
            foot_y, end_y = foot_y - eye_y, end_y - eye_y
            widest, away = max(hull.radius_a_mm for hull in solids), (foot_y + end_y) / 2.0
            foot, end = (foot_x - eye_x) / foot_y, (end_x - eye_x) / end_y
            bearings.append((foot, end, widest / away, away))
        for (foot, end, wide, away), (its_foot, its_end, its_wide, its_away) in combinations(
            bearings, 2
        ):
            gap = min(abs(foot - its_foot), abs(end - its_end)) - wide - its_wide
            crossed = (foot - its_foot) * (end - its_end) <= 0.0
            least = min(least, -1.0 if crossed else gap * min(away, its_away))
    return least
