"""Chance for families of scenes, and what most of them draw: udder, light, background, bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from instruments.world.backdrop import Backdrop, Poster
from instruments.world.boards import Weave
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.setups import Situation
from instruments.world.shading import Lamp, Lighting, Paint

Range = tuple[float, float]
T = TypeVar("T")

# near left, near right, far left, far right
PLACES = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))


@dataclass(frozen=True, slots=True)
class Parameter:
    """What a family draws evenly between ``low`` and ``high``; ``value`` is the member's."""

    low: float
    high: float
    value: float


class Draw:
    """Chance in the ways that families use."""

    def __init__(self, name: str, seed: int, attempt: int) -> None:
        self._rng = np.random.Generator(np.random.PCG64([seed, attempt, *name.encode()]))
        self.parameters: dict[str, Parameter] = {}

    def between(self, name: str, low: float, high: float) -> float:
        """Evenly. A name that was drawn before gets a number, as ``teat_x_mm_2``."""
        # the generator's own `uniform` takes three times as long for one number
        value, again, key = float(low + (high - low) * self._rng.random()), 1, name
        while key in self.parameters:
            again += 1
            key = f"{name}_{again}"
        self.parameters[key] = Parameter(low, high, value)
        return value

    def each(self, what: str, **ranges: Range) -> dict[str, float]:
        """One value after the other, evenly; ``x_mm`` of a "leg" is the parameter ``leg_x_mm``."""
        return {name: self.between(f"{what}_{name}", *each) for name, each in ranges.items()}

    def either(self) -> float:
        """-1 or 1."""
        return 1.0 if self._rng.random() < 0.5 else -1.0

    def chance(self, share: float) -> bool:
        """True in this share of draws."""
        return bool(self._rng.random() < share)

    def count(self, low: int, high: int) -> int:
        """A whole number, both ends included."""
        return int(self._rng.integers(low, high + 1))

    def one_of(self, *known: T) -> T:
        """One of these."""
        return known[self.count(0, len(known) - 1)]


def shape(draw: Draw, length_mm: Range, radius_mm: Range) -> TeatShape:
    """An upright teat's."""
    length, radius = draw.each("teat", length_mm=length_mm, radius_mm=radius_mm).values()
    return TeatShape(length, radius)


def footing(
    draw: Draw, near_mm: Range, far_mm: Range, deep_mm: Range, spread: float = 1.0
) -> Callable[[float, float], tuple[float, float]]:
    """Half widths and half depth of an udder from behind; feet are drawn when asked for."""
    middle_x, middle_y = draw.each("udder", x_mm=(-165.0, -95.0), y_mm=(215.0, 265.0)).values()
    near = draw.between("near_half_width_mm", *near_mm)
    far = draw.between("far_half_width_mm", *far_mm)
    deep = draw.between("half_depth_mm", *deep_mm)

    def foot_mm(across: float, away: float) -> tuple[float, float]:
        off = draw.each("teat", x_mm=(-7.0, 7.0), y_mm=(-8.0, 8.0))
        wide = far if away > 0.0 else near
        return (
            middle_x + spread * across * wide + off["x_mm"],
            middle_y + spread * away * deep + off["y_mm"],
        )

    return foot_mm


def udder(draw: Draw, *, lean_deg: Range = (0.0, 2.0), spread: float = 1.0) -> Phantom:
    """Four teats as seen from behind, the near ones closer together; ``lean_deg`` (least, most)."""
    foot_mm = footing(draw, (26.0, 42.0), (52.0, 78.0), (30.0, 50.0), spread)
    teats = []
    for place in PLACES:
        base, form = foot_mm(*place), shape(draw, (118.0, 150.0), (9.5, 12.5))
        lean = np.radians(draw.between("lean_deg", *lean_deg))
        way = draw.between("lean_way_rad", 0.0, 2.0 * np.pi)
        x_tilt, y_tilt = np.arctan(np.tan(lean) * np.array([np.cos(way), np.sin(way)])).tolist()
        teats.append(Teat(base, form, (x_tilt, y_tilt)))
    return Phantom(tuple(teats))


# matt dark, as the thesis's phantom; light with some gloss, as skin
PAINTS = (
    {"albedo": (0.04, 0.10), "gloss": (0.01, 0.07), "emissivity": (0.94, 0.97)},
    {"albedo": (0.32, 0.60), "gloss": (0.02, 0.20), "emissivity": (0.94, 0.98)},
)
# where each lamp usually hangs, how far off it may be in x, y and z, and the range of its power
LAMPS = (
    ((450.0, -350.0, 1350.0), ((-250, 250), (-250, 200), (-150, 250)), (1.8, 3.0)),
    ((-1300.0, -700.0, 1100.0), ((-200, 300), (-150, 250), (-150, 250)), (1.0, 1.9)),
    ((0.0, 0.0, 0.0), ((-600, 300), (100, 700), (1300, 1700)), (0.5, 1.2)),
)


def lighting(draw: Draw, brightness: Range = (0.95, 1.35)) -> Lighting:
    """Two lamps or three, about where the usual two hang."""
    lamps = []
    for number, (usual_mm, off_mm, power) in enumerate(LAMPS):
        if number < 2 or draw.chance(0.3):
            x, y, z = (
                at + draw.between(f"lamp_{axis}_mm", *off)
                for axis, at, off in zip("xyz", usual_mm, off_mm, strict=True)
            )
            lamps.append(Lamp((x, y, z), draw.between("lamp_power", *power)))
    bright = draw.between("brightness", *brightness)
    return Lighting(bright, tuple(lamps), draw.between("room_light", 0.40, 0.60))


def backdrop(
    draw: Draw, board_albedo: Range, *, texture: Range = (0.02, 0.07), weave: Weave = "cloud"
) -> Backdrop:
    """A board of that albedo and texture behind a light table."""
    return Backdrop(
        board_albedo=draw.between("board_albedo", *board_albedo),
        board_texture=draw.between("board_texture", *texture),
        board_weave=weave,
        table_albedo=draw.between("table_albedo", 0.25, 0.5),
        table_texture=draw.between("table_texture", 0.05, 0.18),
        table_weave=draw.one_of("cloud", "planks", "grain"),
        front_albedo=draw.between("front_albedo", 0.12, 0.30),
        room_albedo=draw.between("room_albedo", 0.04, 0.2),
        texture_seed=draw.count(0, 2**31),
        board_k=draw.between("board_k", -0.4, 0.6),
        table_k=draw.between("table_k", -0.6, 0.3),
    )


POSTER = {
    "x_mm": (-900.0, 850.0),
    "z_mm": (60.0, 640.0),
    "width_mm": (20.0, 180.0),
    "height_mm": (10.0, 110.0),
    "albedo": (0.03, 0.9),
}


def posters(draw: Draw, count: int) -> tuple[Poster, ...]:
    """Rectangles of any grey, all over the board."""
    return tuple(Poster(**draw.each("poster", **POSTER)) for _ in range(count))


def cooler_bodies(draw: Draw, count: int) -> tuple[SceneObject, ...]:
    """Legs, flanks and bellies behind the teats, a few kelvin cooler."""
    things = []
    for _ in range(count):
        body = draw.each(
            "body", offset_k=(2.5, 7.0), albedo=(0.1, 0.5), gloss=(0.0, 0.06),
            x_mm=(-420.0, 160.0), y_mm=(390.0, 640.0),
        )  # fmt: skip
        body["offset_k"] = -body["offset_k"]
        if draw.chance(0.3):
            more = draw.each("body", z_mm=(140.0, 260.0), radius_mm=(45.0, 95.0))
            things.append(make_object("ball", **body, **more))
            continue
        more = draw.each(
            "body", radius_mm=(35.0, 80.0), top_share=(0.6, 0.95), height_mm=(150.0, 330.0)
        )
        more["top_radius_mm"] = more["radius_mm"] * more.pop("top_share")
        things.append(make_object("cooler_body", **body, **more))
    return tuple(things)


def plain(draw: Draw, phantom: Phantom, *objects: SceneObject) -> Situation:
    """A neutral background: dark teats on light, or one time in three light on dark."""
    light = draw.chance(1 / 3)
    return Situation(
        "", 0, "", phantom, objects,
        lighting=lighting(draw),
        teat_paint=Paint(**draw.each("teat", **PAINTS[light])),
        backdrop=backdrop(draw, (0.05, 0.12) if light else (0.40, 0.68)),
    )  # fmt: skip
