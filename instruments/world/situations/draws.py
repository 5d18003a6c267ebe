"""What families share: udders, paints, light and backgrounds, drawn at random."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from instruments.world.backdrop import Backdrop, Poster
from instruments.world.boards import Weave
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.shading import Lamp, Lighting, Paint

# near left, near right, far left, far right
PLACES = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))


class Draw:
    """Chance, with the few ways in which families use it."""

    def __init__(self, name: str, seed: int, attempt: int) -> None:
        self._rng = np.random.Generator(np.random.PCG64([seed, attempt, *name.encode()]))

    def between(self, low: float, high: float) -> float:
        """Evenly."""
        return float(self._rng.uniform(low, high))

    def either(self) -> float:
        """-1 or 1."""
        return 1.0 if self._rng.random() < 0.5 else -1.0

    def chance(self, share: float) -> bool:
        """True in this share of draws."""
        return bool(self._rng.random() < share)

    def count(self, low: int, high: int) -> int:
        """A whole number, both ends included."""
        return int(self._rng.integers(low, high + 1))

    def weave(self, *known: Weave) -> Weave:
        """One of these."""
        return known[self.count(0, len(known) - 1)]


def udder(
    draw: Draw, *, lean_deg: tuple[float, float] = (0.0, 2.0), spread: float = 1.0
) -> Phantom:
    """Four teats, the two near ones closer together, as seen from behind; ``lean_deg`` (least,
    most).
    """
    middle = draw.between(-165.0, -95.0), draw.between(215.0, 265.0)
    wide, deep = (draw.between(26.0, 42.0), draw.between(52.0, 78.0)), draw.between(30.0, 50.0)
    teats = []
    for x, y in PLACES:
        base = (
            middle[0] + spread * x * wide[int(y > 0.0)] + draw.between(-7.0, 7.0),
            middle[1] + spread * y * deep + draw.between(-8.0, 8.0),
        )
        shape = TeatShape(draw.between(118.0, 150.0), draw.between(9.5, 12.5))
        lean, way = np.radians(draw.between(*lean_deg)), draw.between(0.0, 2.0 * np.pi)
        tilt = (
            float(np.arctan(np.tan(lean) * np.cos(way))),
            float(np.arctan(np.tan(lean) * np.sin(way))),
        )
        teats.append(Teat(base, shape, tilt))
    return Phantom(tuple(teats))


def dark_paint(draw: Draw) -> Paint:
    """Matt dark, as the thesis's phantom."""
    return Paint(draw.between(0.04, 0.10), draw.between(0.01, 0.07), draw.between(0.94, 0.97))


def light_paint(draw: Draw) -> Paint:
    """Light, with some gloss, as skin has."""
    return Paint(draw.between(0.32, 0.60), draw.between(0.02, 0.20), draw.between(0.94, 0.98))


def lighting(draw: Draw, brightness: tuple[float, float] = (0.95, 1.35)) -> Lighting:
    """Two lamps or three, about where the usual two hang."""
    lamps = [
        Lamp(
            (
                450.0 + draw.between(-250.0, 250.0),
                -350.0 + draw.between(-250.0, 200.0),
                1350.0 + draw.between(-150.0, 250.0),
            ),
            draw.between(1.8, 3.0),
        ),
        Lamp(
            (
                -1300.0 + draw.between(-200.0, 300.0),
                -700.0 + draw.between(-150.0, 250.0),
                1100.0 + draw.between(-150.0, 250.0),
            ),
            draw.between(1.0, 1.9),
        ),
    ]
    if draw.chance(0.3):
        lamps.append(
            Lamp(
                (
                    draw.between(-600.0, 300.0),
                    draw.between(100.0, 700.0),
                    draw.between(1300.0, 1700.0),
                ),
                draw.between(0.5, 1.2),
            )
        )
    return Lighting(draw.between(*brightness), tuple(lamps), draw.between(0.40, 0.60))


def backdrop(
    draw: Draw,
    board_albedo: tuple[float, float],
    *,
    texture: tuple[float, float] = (0.02, 0.07),
    weave: Weave = "cloud",
) -> Backdrop:
    """A board of that albedo and texture behind a light table."""
    return Backdrop(
        board_albedo=draw.between(*board_albedo),
        board_texture=draw.between(*texture),
        board_weave=weave,
        table_albedo=draw.between(0.25, 0.5),
        table_texture=draw.between(0.05, 0.18),
        table_weave=draw.weave("cloud", "planks", "grain"),
        front_albedo=draw.between(0.12, 0.30),
        room_albedo=draw.between(0.04, 0.2),
        texture_seed=draw.count(0, 2**31),
        board_k=draw.between(-0.4, 0.6),
        table_k=draw.between(-0.6, 0.3),
    )


def posters(draw: Draw, count: int) -> tuple[Poster, ...]:
    """Rectangles of any grey, all over the board."""
    return tuple(
        Poster(
            draw.between(-900.0, 850.0),
            draw.between(60.0, 640.0),
            draw.between(20.0, 180.0),
            draw.between(10.0, 110.0),
            draw.between(0.03, 0.9),
        )
        for _ in range(count)
    )


def cooler_bodies(draw: Draw, count: int) -> tuple[SceneObject, ...]:
    """Legs, flanks and bellies behind the teats, a few kelvin cooler."""
    things = []
    for _ in range(count):
        look = {
            "offset_k": -draw.between(2.5, 7.0),
            "albedo": draw.between(0.1, 0.5),
            "gloss": draw.between(0.0, 0.06),
        }
        x, y = draw.between(-420.0, 160.0), draw.between(390.0, 640.0)
        if draw.chance(0.3):
            things.append(
                make_object(
                    "ball",
                    x_mm=x,
                    y_mm=y,
                    z_mm=draw.between(140.0, 260.0),
                    radius_mm=draw.between(45.0, 95.0),
                    **look,
                )
            )
        else:
            radius = draw.between(35.0, 80.0)
            top = radius * draw.between(0.6, 0.95)
            things.append(
                make_object(
                    "cooler_body",
                    x_mm=x,
                    y_mm=y,
                    height_mm=draw.between(150.0, 330.0),
                    radius_mm=radius,
                    top_radius_mm=top,
                    **look,
                )
            )
    return tuple(things)


def apart(phantom: Phantom, eyes_mm: Sequence[tuple[float, float, float]]) -> float:
    """Least gap between two teats in any view, in mm at the nearer one; negative where covered."""
    least = np.inf
    hulls = phantom.teat_hulls()
    for eye in eyes_mm:
        bearings = []
        for hull in hulls:
            ends = np.array([hull.a_mm, hull.b_mm]) - np.asarray(eye)
            bearings.append(
                (ends[:, 0] / ends[:, 1], hull.radius_a_mm / ends[:, 1].mean(), ends[:, 1].mean())
            )
        for i, (one, r_one, y_one) in enumerate(bearings):
            for other, r_other, y_other in bearings[i + 1 :]:
                gaps = np.abs(one - other) - r_one - r_other
                crossed = (one[0] - other[0]) * (one[1] - other[1]) <= 0.0
                least = min(least, -1.0 if crossed else float(gaps.min()) * min(y_one, y_other))
    return float(least)
