"""The phantom udder: teats on a plate.

A teat is a cylinder with a hemispherical end (`TEAT_END`), end up, or has a form of its
own. Flanges and hoses follow from the teats' places; on an udder there are none. The plate's frame
is the world's at pose zero; a pose turns the plate about `PIVOT_MM`, then shifts it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np

from instruments.world.optics import Floats
from instruments.world.shading import Paint
from instruments.world.solids import Hull, Point, as_point, ball, chain, cylinder, square_to

# what is measured
TEAT_END = (
    "Apex of the teat's rounded end on the teat's own axis, in the world frame (the table, set with"
    " the arm)."
)
# the middle of the four teats of table 5.1: where the stage's turntable has its axis
PIVOT_MM = (-189.4, 235.8)
FLANGE_RADIUS_MM, FLANGE_HEIGHT_MM = 18.0, 8.0
HOSE_RADIUS_MM, HOSE_PIECES = 5.0, 8
TABLE_5_1_MM = (
    (-110.2, 284.2, 134.2),
    (-161.9, 192.6, 137.6),
    (-224.9, 199.4, 136.7),
    (-260.6, 267.1, 136.3),
)


SHOULDER = 0.5  # of the first ball's radius behind the end: where a flat end begins


@dataclass(frozen=True, slots=True)
class TeatForm:
    """A teat as joined balls on its axis, from the end on: ``balls`` has the distance of each one's
    middle from the apex, and its radius, mm. The first touches the apex, which is the middle of a
    flat disc of ``flat_mm`` radius unless that is 0.

    The axis is that at the end; away from it the teat bends by ``bend_per_mm`` (rad), sideways in
    the direction ``bend_way_rad``.
    """

    balls: tuple[tuple[float, float], ...]
    flat_mm: float = 0.0
    bend_per_mm: float = 0.0
    bend_way_rad: float = 0.0

    @property
    def _shoulder_mm(self) -> tuple[float, float]:
        """How far behind the end a flat one begins on the first ball, and its radius there."""
        radius = self.balls[0][1]
        return SHOULDER * radius, float(np.sqrt(1.0 - (1.0 - SHOULDER) ** 2)) * radius

    def middles(self, end: Floats, axis: Floats, behind_mm: Floats) -> Floats:
        """Where the middle runs (n, 3), so far behind the end (n,) along the axis."""
        (u,), (v,) = square_to(axis[None])
        way = np.cos(self.bend_way_rad) * u + np.sin(self.bend_way_rad) * v
        aside = 0.5 * self.bend_per_mm * behind_mm**2
        return np.asarray(end - behind_mm[:, None] * axis + aside[:, None] * way)

    def radii_mm(self, behind_mm: Floats) -> Floats:
        """Of the surface, so far behind the end, (n,)."""
        places, radii = np.array(self.balls, dtype=np.float64).T
        along = np.linspace(places[0], places[-1], 400)
        inner = np.interp(along, places, radii) ** 2 - (behind_mm[:, None] - along) ** 2
        found = np.sqrt(np.maximum(inner.max(axis=1), 0.0))
        (begins, wide), flat = self._shoulder_mm, self.flat_mm
        cone = np.interp(behind_mm, [0.0, begins], [flat, wide], right=0.0)
        return np.maximum(found, cone) if flat else np.asarray(found)

    def hulls(self, end: Floats, axis: Floats) -> tuple[Hull, ...]:
        """Its solids, from the foot to the end."""
        places, radii = np.array(self.balls, dtype=np.float64)[::-1].T
        points = [as_point(point) for point in self.middles(end, axis, places)]
        solids = chain(points, radii.tolist())
        if not self.flat_mm:
            return solids
        begins, wide = self._shoulder_mm
        foot = self.middles(end, axis, np.array([begins]))[0]
        return (*solids, cylinder(as_point(foot), as_point(end), wide, self.flat_mm))


@dataclass(frozen=True, slots=True)
class TeatShape:
    """``length_mm`` to the apex, ``radius_mm`` of cylinder and end; ``form`` replaces both."""

    length_mm: float = 135.0
    radius_mm: float = 11.0
    form: TeatForm | None = None

    def __post_init__(self) -> None:
        if not (
            np.isfinite(self.length_mm) and 0.0 < self.radius_mm < self.length_mm - FLANGE_HEIGHT_MM
        ):
            raise ValueError(
                "a teat needs a radius above zero and a length of at least radius +"
                f" {FLANGE_HEIGHT_MM:g} mm, has {self}"
            )


SPOKEN = {"LF": "left front", "RF": "right front", "LR": "left rear", "RR": "right rear"}


def spoken_name(number: int, name: str = "") -> str:
    """A teat within a sentence: ``right front (RF)``; by another name or its number ``teat 4``."""
    return f"{SPOKEN[name]} ({name})" if name in SPOKEN else f"teat {name or number}"


def called(number: int, name: str = "") -> str:
    """How a teat is called: ``teat 4, left front (LF)``; ``teat 4`` without a name."""
    if name in SPOKEN:
        return f"teat {number}, {spoken_name(number, name)}"
    return f"teat {number} ({name})" if name else f"teat {number}"


@dataclass(frozen=True, slots=True)
class Teat:
    """Where its axis leaves the plate (plate frame), shape, and lean towards +x and +y in rad."""

    base_mm: tuple[float, float]
    shape: TeatShape = field(default_factory=TeatShape)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    name: str = ""

    def __post_init__(self) -> None:
        if not max(abs(angle) for angle in self.tilt_rad) < np.radians(60.0):
            raise ValueError(
                "a teat may lean by less than 60 degrees each way, leans by"
                f" {np.degrees(self.tilt_rad).round(1).tolist()}"
            )


@dataclass(frozen=True, slots=True)
class PlatePose:
    """Where the plate stands: a turn about `PIVOT_MM` (radians, x towards y), then a shift."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite([self.x_mm, self.y_mm, self.z_mm, self.yaw_rad])):
            raise ValueError(f"a plate's pose must be finite numbers, is {self}")
        if self.z_mm < 0.0:
            raise ValueError(f"the plate can't stand below the table: z_mm is {self.z_mm}")

    def carried(self, by: PlatePose) -> PlatePose:
        """This pose on a plate that itself is moved ``by``: first this one, then the other."""
        c, s = np.cos(by.yaw_rad), np.sin(by.yaw_rad)
        x, y = c * self.x_mm - s * self.y_mm, s * self.x_mm + c * self.y_mm
        return PlatePose(
            float(x) + by.x_mm, float(y) + by.y_mm, self.z_mm + by.z_mm, self.yaw_rad + by.yaw_rad
        )


@dataclass(frozen=True, slots=True)
class Udder:
    """What teats stand on in place of flanges: quarters at these places; plate frame, mm."""

    quarters_mm: tuple[tuple[float, float], ...]
    height_mm: float


@dataclass(frozen=True, slots=True)
class Spots:
    """Drops or dirt: balls that stand out of the teats' skin by ``out_mm``, ``cooler_k`` cooler.
    ``places``: teat from 0, mm behind its end, direction in rad, radius in mm.
    """

    name: str
    paint: Paint
    places: tuple[tuple[int, float, float, float], ...]
    out_mm: float = 1.0
    cooler_k: float = 0.0


@dataclass(frozen=True, slots=True)
class Phantom:
    """Teats on a plate, numbered from 0. ``name``: the layout's; ``emissivity``: the paint's."""

    teats: tuple[Teat, ...]
    pose: PlatePose = field(default_factory=PlatePose)
    name: str = ""
    emissivity: float = 0.95
    udder: Udder | None = None
    spots: tuple[Spots, ...] = ()

    @property
    def called(self) -> tuple[str, ...]:
        """Each teat as prompts call it, with its number from 1."""
        return tuple(called(number, teat.name) for number, teat in enumerate(self.teats, 1))

    @property
    def bases_mm(self) -> Floats:
        """Where the axes meet the plate, world frame, (n, 3) mm."""
        flat = [(*teat.base_mm, 0.0) for teat in self.teats]
        return self._placed(np.array(flat, dtype=np.float64).reshape(-1, 3))

    @property
    def axes(self) -> Floats:
        """Unit vectors from base to end, world frame, (n, 3). Tangents of the two leans add up."""
        leans = [(*np.tan(teat.tilt_rad), 1.0) for teat in self.teats]
        lean = np.array(leans, dtype=np.float64).reshape(-1, 3)
        return np.asarray(lean / np.linalg.norm(lean, axis=1)[:, None] @ self._turn().T)

    @property
    def ends_mm(self) -> Floats:
        """The teat ends, world frame, (n, 3) mm, as `TEAT_END` defines them."""
        lengths = np.array([teat.shape.length_mm for teat in self.teats], dtype=np.float64)
        return np.asarray(self.bases_mm + lengths.reshape(-1, 1) * self.axes)

    def moved(self, pose: PlatePose) -> Phantom:
        """The same phantom at another pose."""
        return replace(self, pose=pose)

    def teat_hulls(self) -> tuple[tuple[Hull, ...], ...]:
        """The solids of each teat from foot to end, the apex on the ball; or those of its form."""
        hulls: list[tuple[Hull, ...]] = []
        for teat, base, axis, end in zip(
            self.teats, self.bases_mm, self.axes, self.ends_mm, strict=True
        ):
            if teat.shape.form:
                hulls.append(teat.shape.form.hulls(end, axis))
                continue
            radius = teat.shape.radius_mm
            foot = base + 0.5 * FLANGE_HEIGHT_MM * axis
            top = base + (teat.shape.length_mm - radius) * axis
            hulls.append((Hull(as_point(foot), as_point(top), radius, radius, flat_a=True),))
        return tuple(hulls)

    def udder_hulls(self) -> tuple[Hull, ...]:
        """The udder's quarters, each flat on the plate, and what joins them; none without one."""
        if self.udder is None:
            return ()
        half = 0.5 * self.udder.height_mm
        placed = self._placed(np.array([(*at, 0.0) for at in self.udder.quarters_mm]))
        feet = [as_point(at) for at in placed]
        middles = [as_point(at + np.array([0.0, 0.0, half])) for at in placed]
        quarters = [cylinder(*ends, half) for ends in zip(feet, middles, strict=True)]
        return (*quarters, *(Hull(a, b, half, half) for a, b in combinations(middles, 2)))

    def spot_hulls(self, spots: Spots) -> tuple[Hull, ...]:
        """The balls of drops or dirt, where the teats have them."""
        hulls = []
        for teat, behind, way, radius in spots.places:
            end, axis, shape = self.ends_mm[teat], self.axes[teat], self.teats[teat].shape
            ((u,), (v,)), back = square_to(axis[None]), np.array([behind])
            skin, on_axis = shape.radius_mm, end - behind * axis
            if shape.form:
                skin, on_axis = shape.form.radii_mm(back)[0], shape.form.middles(end, axis, back)[0]
            outward = np.cos(way) * u + np.sin(way) * v
            middle = on_axis + (skin + spots.out_mm - radius) * outward
            hulls.append(ball(as_point(middle), radius))
        return tuple(hulls)

    def flange_hulls(self) -> tuple[Hull, ...]:
        """The discs that the teats stand in, down to the table; none on an udder."""
        if self.udder is not None:
            return ()
        tops = self.bases_mm + np.array([0.0, 0.0, FLANGE_HEIGHT_MM])
        radii = [max(FLANGE_RADIUS_MM, teat.shape.radius_mm + 4.0) for teat in self.teats]
        return tuple(
            cylinder((top[0], top[1], 0.0), as_point(top), radius)
            for top, radius in zip(tops, radii, strict=True)
        )

    def hose_hulls(self) -> tuple[tuple[Hull, ...], ...]:
        """Hoses between flanges in the order of the teats, supply first, return last."""
        if not self.teats or self.udder is not None:
            return ()
        bases = np.array([(*teat.base_mm, HOSE_RADIUS_MM) for teat in self.teats])
        middle = bases.mean(axis=0)
        away = np.array([[70.0, 25.0, 0.0]]) * np.where(
            bases[[0, -1]][:, :1] >= middle[0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]
        )
        legs = [(bases[0] + away[0], bases[0]), *pairwise(bases), (bases[-1], bases[-1] + away[1])]
        return tuple(self._hose(start, end, middle) for start, end in legs)

    def _hose(self, start: Floats, end: Floats, middle: Floats) -> tuple[Hull, ...]:
        """A bow from flange to flange, outwards and a little off the table."""
        t = np.linspace(0.0, 1.0, HOSE_PIECES + 1)[:, None]
        out = 0.5 * (start + end) - middle
        bow = out / max(float(np.linalg.norm(out)), 1.0) * 24.0 + np.array([0.0, 0.0, 14.0])
        path = self._placed(start + t * (end - start) + 4.0 * t * (1.0 - t) * bow)
        return tuple(
            Hull((ax, ay, az), (bx, by, bz), HOSE_RADIUS_MM, HOSE_RADIUS_MM)
            for (ax, ay, az), (bx, by, bz) in pairwise(path.tolist())
        )

    def _turn(self) -> Floats:
        c, s = np.cos(self.pose.yaw_rad), np.sin(self.pose.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def _placed(self, plate_mm: Floats) -> Floats:
        pivot = np.array([*PIVOT_MM, 0.0])
        shift = np.array([self.pose.x_mm, self.pose.y_mm, self.pose.z_mm])
        return np.asarray((plate_mm - pivot) @ self._turn().T + pivot + shift)


def upright(ends_mm: Sequence[Point], radius_mm: float = 11.0, name: str = "") -> Phantom:
    """Upright teats whose ends are these, in the plate's frame."""
    return Phantom(tuple(Teat((x, y), TeatShape(z, radius_mm)) for x, y, z in ends_mm), name=name)
