"""Eleven families of scenes: from a name and a seed to everything that a scene needs.

The thesis's six (section 5.2), and ideal, low contrast, dim light, a teat missing or hidden, and
anything anywhere. Each draws until a scene can be set up (no overlaps, ends within reach of arm and
cameras) and fits its name. The cameras are a box of the thesis rig's bearings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from itertools import combinations
from typing import Any

import numpy as np

from instruments.world.backdrop import Backdrop, Poster
from instruments.world.boards import Board, Pattern, Weave
from instruments.world.objects import TEAT_PAINT, SceneObject, check_known, make_object
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.sensor import Exposure
from instruments.world.shading import Lamp, Lighting, Paint
from instruments.world.solids import Bools, Hull
from instruments.world.state import SceneState


@dataclass(frozen=True, slots=True)
class Situation:
    """One member of a family: what stands where, light, paint, exposure; no temperatures of teats.
    ``about`` tells a person in one sentence what to set up.
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

    def state(
        self, teat_temps_c: tuple[float, ...], hose_temp_c: float, ambient_c: float, **more: Any
    ) -> SceneState:
        """The scene at these temperatures of the plant; ``more`` are fields of `SceneState`."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in ("name", "seed", "about"):
            del own[name]
        temperatures = {"teat_temps_c": teat_temps_c, "hose_temp_c": hose_temp_c}
        return SceneState(ambient_c=ambient_c, **(own | temperatures | more))


# left, right, thermal
EYES_MM = ((-263.0, -840.0, 62.0), (-163.0, -841.0, 62.0), (-212.0, -841.0, 62.0))
# to the right, per mm away: the thermal camera's view and some room to spare
BEARINGS = (-0.050, 0.225)
RISE = 0.103
REACH_MM = ((-330.0, 100.0, 60.0), (50.0, 420.0, 185.0))  # where the arm touches with ease
STYLUS_MM = 12.0  # room around the stylus, which comes from above
STYLUS_LONG_MM = 120.0
GAP_MM = 2.0  # between things that don't touch


def faults(situation: Situation) -> tuple[str, ...]:
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
            if any(_gap(stylus, hull) < STYLUS_MM for hull in thing.hulls):
                found.append(f"{thing.name} is in the way of touching teat {i}")
        away = end - np.asarray(EYES_MM[2])
        if not (BEARINGS[0] <= away[0] / away[1] <= BEARINGS[1] and abs(away[2] / away[1]) <= RISE):
            found.append(f"the end of teat {i} is out of the cameras' view")
    return (*found, *collisions(situation))


def collisions(situation: Situation) -> Iterator[str]:
    """Things that stand within each other, in words."""
    teats = situation.phantom.teat_hulls()
    for (i, one), (j, other) in combinations(enumerate(teats), 2):
        if _gap(one, other) < 0.0:
            yield f"teats {i + 1} and {j + 1} stand in each other"
    solid = (*teats, *situation.phantom.flange_hulls())
    for thing in situation.objects:
        if min(_gap(hull, mine) for hull in thing.hulls for mine in solid) < GAP_MM:
            yield f"{thing.name} stands within the phantom"
    for one_thing, other_thing in combinations(situation.objects, 2):
        if min(_gap(a, b) for a in one_thing.hulls for b in other_thing.hulls) < GAP_MM:
            yield f"{one_thing.name} and {other_thing.name} stand in each other"
    for board in situation.boards:
        u, v = np.meshgrid(np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, 25))
        points = board.placed(np.column_stack([u.ravel(), v.ravel()]) * board.pattern.size_mm)
        for hull in (*solid, *(hull for thing in situation.objects for hull in thing.hulls)):
            if _apart(points, hull).min() < GAP_MM:
                yield f"{board.name} stands within something else"
                break


def hidden_ways(situation: Situation) -> Bools:
    """Whether objects or boards hide each end (n,) from three eyes (n, 3); teats don't count."""
    ends = situation.phantom.ends_mm
    hidden = np.zeros((len(ends), len(EYES_MM)), dtype=np.bool_)
    for e, eye in enumerate(EYES_MM):
        for i, end in enumerate(ends):
            way = Hull(eye, tuple(eye + 0.995 * (end - eye)), 0.01, 0.01)
            solid = any(
                _gap(way, hull) < 0.0 for thing in situation.objects for hull in thing.hulls
            )
            hidden[i, e] = solid or any(
                _crosses(np.asarray(eye), end, board.outline_mm) for board in situation.boards
            )
    return hidden


def _crosses(start: Floats, end: Floats, outline: Floats) -> bool:
    """Whether a way passes through a rectangle (4, 3)."""
    corner, across, along = outline[0], outline[1] - outline[0], outline[3] - outline[0]
    part, u, v = np.linalg.solve(np.column_stack([end - start, -across, -along]), corner - start)
    return bool(0.0 < part < 1.0 and 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0)


def _gap(one: Hull, other: Hull) -> float:
    """Gap between two solids taken as round, so a little small for flat ends; negative: overlap."""
    a, b = np.asarray(one.a_mm), np.asarray(one.b_mm)
    t = np.linspace(0.0, 1.0, 33)
    radii = one.radius_a_mm + t * (one.radius_b_mm - one.radius_a_mm)
    return float((_apart(a + t[:, None] * (b - a), other) - radii).min())


def _apart(points: Floats, hull: Hull) -> Floats:
    """Gaps (n,) between points (n, 3) and a solid taken as round."""
    a, span = np.asarray(hull.a_mm), np.subtract(hull.b_mm, hull.a_mm)
    along = np.clip((points - a) @ span / max(float(span @ span), 1e-9), 0.0, 1.0)
    away = np.linalg.norm(points - a - along[:, None] * span, axis=1)
    return np.asarray(away - hull.radius_a_mm - along * (hull.radius_b_mm - hull.radius_a_mm))


ATTEMPTS = 1000
CLEAR_MM = 4.0  # between teats that don't overlap, as seen
CLOSE = ("overlapping", "anywhere")  # families with a rule of their own for it
# near left, near right, far left, far right
PLACES = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))


@dataclass(frozen=True, slots=True)
class Parameter:
    """What a family draws evenly between ``low`` and ``high``; ``value`` is the member's."""

    low: float
    high: float
    value: float


class Draw:
    """Chance, with the few ways in which families use it. ``point`` gives parameters by name, in
    shares of their ranges, instead of chance.
    """

    def __init__(
        self, name: str, seed: int, attempt: int, point: Mapping[str, float] | None = None
    ) -> None:
        self._rng = np.random.Generator(np.random.PCG64([seed, attempt, *name.encode()]))
        self._point = point or {}
        self.parameters: dict[str, Parameter] = {}

    def between(self, name: str, low: float, high: float) -> float:
        """Evenly. A name that was drawn before gets a number, as ``teat_x_mm_2``."""
        value, again, key = float(self._rng.uniform(low, high)), 1, name
        while key in self.parameters:
            again += 1
            key = f"{name}_{again}"
        if key in self._point:
            value = low + self._point[key] * (high - low)
        self.parameters[key] = Parameter(low, high, value)
        return value

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
    """Four teats as seen from behind, the near ones closer together; ``lean_deg`` (least, most)."""
    middle = draw.between("udder_x_mm", -165.0, -95.0), draw.between("udder_y_mm", 215.0, 265.0)
    wide, deep = (
        (
            draw.between("near_half_width_mm", 26.0, 42.0),
            draw.between("far_half_width_mm", 52.0, 78.0),
        ),
        draw.between("half_depth_mm", 30.0, 50.0),
    )
    teats = []
    for x, y in PLACES:
        base = (
            middle[0] + spread * x * wide[int(y > 0.0)] + draw.between("teat_x_mm", -7.0, 7.0),
            middle[1] + spread * y * deep + draw.between("teat_y_mm", -8.0, 8.0),
        )
        shape = TeatShape(
            draw.between("teat_length_mm", 118.0, 150.0), draw.between("teat_radius_mm", 9.5, 12.5)
        )
        lean, way = (
            np.radians(draw.between("lean_deg", *lean_deg)),
            draw.between("lean_way_rad", 0.0, 2.0 * np.pi),
        )
        x_tilt, y_tilt = np.arctan(np.tan(lean) * np.array([np.cos(way), np.sin(way)])).tolist()
        teats.append(Teat(base, shape, (x_tilt, y_tilt)))
    return Phantom(tuple(teats))


# albedo, gloss and emissivity: matt dark, as the thesis's phantom; light with some gloss, as skin
PAINTED = ("teat_albedo", "teat_gloss", "teat_emissivity")
PAINTS = (
    ((0.04, 0.10), (0.01, 0.07), (0.94, 0.97)),
    ((0.32, 0.60), (0.02, 0.20), (0.94, 0.98)),
)
# where each lamp usually hangs, how far off it may be in x, y and z, and the range of its power
LAMPS = (
    ((450.0, -350.0, 1350.0), ((-250, 250), (-250, 200), (-150, 250)), (1.8, 3.0)),
    ((-1300.0, -700.0, 1100.0), ((-200, 300), (-150, 250), (-150, 250)), (1.0, 1.9)),
    ((0.0, 0.0, 0.0), ((-600, 300), (100, 700), (1300, 1700)), (0.5, 1.2)),
)


def lighting(draw: Draw, brightness: tuple[float, float] = (0.95, 1.35)) -> Lighting:
    """Two lamps or three, about where the usual two hang."""
    lamps = []
    for number, (usual_mm, off_mm, power) in enumerate(LAMPS):
        if number < 2 or draw.chance(0.3):
            x, y, z = (
                at + draw.between(f"lamp_{axis}_mm", *off)
                for axis, at, off in zip("xyz", usual_mm, off_mm, strict=True)
            )
            lamps.append(Lamp((x, y, z), draw.between("lamp_power", *power)))
    return Lighting(
        draw.between("brightness", *brightness),
        tuple(lamps),
        draw.between("room_light", 0.40, 0.60),
    )


def backdrop(
    draw: Draw,
    board_albedo: tuple[float, float],
    *,
    texture: tuple[float, float] = (0.02, 0.07),
    weave: Weave = "cloud",
) -> Backdrop:
    """A board of that albedo and texture behind a light table."""
    return Backdrop(
        board_albedo=draw.between("board_albedo", *board_albedo),
        board_texture=draw.between("board_texture", *texture),
        board_weave=weave,
        table_albedo=draw.between("table_albedo", 0.25, 0.5),
        table_texture=draw.between("table_texture", 0.05, 0.18),
        table_weave=draw.weave("cloud", "planks", "grain"),
        front_albedo=draw.between("front_albedo", 0.12, 0.30),
        room_albedo=draw.between("room_albedo", 0.04, 0.2),
        texture_seed=draw.count(0, 2**31),
        board_k=draw.between("board_k", -0.4, 0.6),
        table_k=draw.between("table_k", -0.6, 0.3),
    )


def posters(draw: Draw, count: int) -> tuple[Poster, ...]:
    """Rectangles of any grey, all over the board."""
    ranges = {
        "poster_x_mm": (-900.0, 850.0),
        "poster_z_mm": (60.0, 640.0),
        "poster_width_mm": (20.0, 180.0),
        "poster_height_mm": (10.0, 110.0),
        "poster_albedo": (0.03, 0.9),
    }
    return tuple(
        Poster(*(draw.between(name, *each) for name, each in ranges.items())) for _ in range(count)
    )


def cooler_bodies(draw: Draw, count: int) -> tuple[SceneObject, ...]:
    """Legs, flanks and bellies behind the teats, a few kelvin cooler."""
    things = []
    for _ in range(count):
        look = {
            "offset_k": -draw.between("body_offset_k", 2.5, 7.0),
            "albedo": draw.between("body_albedo", 0.1, 0.5),
            "gloss": draw.between("body_gloss", 0.0, 0.06),
        }
        x, y = draw.between("body_x_mm", -420.0, 160.0), draw.between("body_y_mm", 390.0, 640.0)
        if draw.chance(0.3):
            look |= {
                "z_mm": draw.between("body_z_mm", 140.0, 260.0),
                "radius_mm": draw.between("body_radius_mm", 45.0, 95.0),
            }
        else:
            radius = draw.between("body_radius_mm", 35.0, 80.0)
            top = {
                "radius_mm": radius,
                "top_radius_mm": radius * draw.between("body_top_share", 0.6, 0.95),
            }
            look |= top | {"height_mm": draw.between("body_height_mm", 150.0, 330.0)}
        kind = "cooler_body" if "height_mm" in look else "ball"
        things.append(make_object(kind, x_mm=x, y_mm=y, **look))
    return tuple(things)


def apart(phantom: Phantom, eyes_mm: Sequence[tuple[float, float, float]]) -> float:
    """Least gap between two teats in any view, in mm at the nearer one; negative where covered."""
    least = np.inf
    hulls = phantom.teat_hulls()
    for eye in eyes_mm:
        bearings = []
        for hull in hulls:
            ends = np.array([hull.a_mm, hull.b_mm]) - np.asarray(eye)
            x, y = ends[:, 0], ends[:, 1]
            bearings.append((x / y, hull.radius_a_mm / y.mean(), y.mean()))
        for i, (one, r_one, y_one) in enumerate(bearings):
            for other, r_other, y_other in bearings[i + 1 :]:
                gaps = np.abs(one - other) - r_one - r_other
                crossed = (one[0] - other[0]) * (one[1] - other[1]) <= 0.0
                least = min(least, -1.0 if crossed else float(gaps.min()) * min(y_one, y_other))
    return float(least)


def situation(name: str, seed: int) -> Situation:
    """Member ``seed`` of the family. Raises ValueError for an unknown name or negative seed."""
    return member(name, seed)[0]


@lru_cache(maxsize=1024)
def member(name: str, seed: int) -> tuple[Situation, Mapping[str, Parameter]]:
    """As `situation`, with its parameters by name."""
    check_known("situation", name, SITUATIONS)
    if seed < 0:
        raise ValueError(f"a situation's seed must be 0 or more, is {seed}")
    for attempt in range(ATTEMPTS):
        found, parameters = drawn(name, seed, attempt)
        if found:
            return found, parameters
    raise RuntimeError(
        f"nothing that can be set up was found for {name} {seed} in {ATTEMPTS} draws: the family's"
        " limits contradict each other"
    )


def drawn(
    name: str, seed: int, attempt: int, point: Mapping[str, float] | None = None
) -> tuple[Situation | None, Mapping[str, Parameter]]:
    """One attempt at a member, None where it can't be set up or doesn't fit its family's name, and
    its parameters by name. Those in ``point`` are there, in shares from 0 to 1 of their ranges.
    """
    draw, (about, family) = Draw(name, seed, attempt, point), SITUATIONS[name]
    found = family(draw)
    if found is None or (name not in CLOSE and apart(found.phantom, EYES_MM) < CLEAR_MM):
        return None, draw.parameters
    found = replace(found, name=name, seed=seed, about=about)
    return None if faults(found) else found, draw.parameters


class Around:
    """A member and all that it could be with the same counts and choices: its parameters by name,
    and the situation at any point of them. Raises ValueError as `situation` does.
    """

    def __init__(self, name: str, seed: int) -> None:
        situation(name, seed)
        self.name, self.seed = name, seed
        self._attempt = next(i for i in range(ATTEMPTS) if drawn(name, seed, i)[0])
        self.parameters = drawn(name, seed, self._attempt)[1]

    def at(self, point: Mapping[str, float]) -> tuple[Situation | None, Mapping[str, Parameter]]:
        """As `drawn`. Raises ValueError for a parameter or share that can't be."""
        if unknown := set(point) - set(self.parameters):
            raise ValueError(f"{self.name} {self.seed} has no parameter {min(unknown)!r}")
        if wrong := [name for name, share in point.items() if not 0.0 <= share <= 1.0]:
            raise ValueError(f"{min(wrong)}: a share of a range is from 0 to 1")
        return drawn(self.name, self.seed, self._attempt, point)


def _plain(draw: Draw, phantom: Phantom, *objects: SceneObject) -> Situation:
    """A neutral background: dark teats on light, or one time in three light on dark."""
    light = draw.chance(1 / 3)
    return Situation(
        "", 0, "", phantom, objects,
        lighting=lighting(draw),
        teat_paint=Paint(
            *(
                draw.between(name, *each)
                for name, each in zip(PAINTED, PAINTS[light], strict=True)
            )
        ),
        backdrop=backdrop(draw, (0.05, 0.12) if light else (0.40, 0.68)),
    )  # fmt: skip


def _ideal(draw: Draw, lean_deg: tuple[float, float] = (0.0, 2.0)) -> Situation | None:
    return _plain(draw, udder(draw, lean_deg=lean_deg))


def _overlapping(draw: Draw) -> Situation | None:
    """Two teats touch side by side; of the two others the near one covers part of the far one."""
    middle, across = draw.between("middle_x_mm", -185.0, -105.0), draw.either()
    y = draw.between("touching_y_mm", 200.0, 270.0)
    shapes = [
        TeatShape(
            draw.between("teat_length_mm", 118.0, 148.0), draw.between("teat_radius_mm", 9.5, 12.5)
        )
        for _ in range(4)
    ]
    gap = draw.between("gap_mm", 0.0, 1.5)
    turn = draw.between("turn_rad", -0.35, 0.35)
    step = shapes[0].radius_mm + shapes[1].radius_mm + gap
    first = middle + across * draw.between("touching_x_mm", 30.0, 60.0)
    touching = [
        (first, y),
        (first + across * step * float(np.cos(turn)), y + step * float(np.sin(turn))),
    ]
    near = (
        middle - across * draw.between("near_x_mm", 15.0, 45.0),
        y - draw.between("near_y_mm", 15.0, 50.0),
    )
    eye = EYES_MM[2]
    far_y = near[1] + draw.between("far_y_mm", 35.0, 95.0)
    hidden = (
        draw.between("covered_share", 0.25, 0.75)
        * (shapes[2].radius_mm + shapes[3].radius_mm)
        * draw.either()
    )
    far = (eye[0] + (near[0] - eye[0]) * (far_y - eye[1]) / (near[1] - eye[1]) + hidden, far_y)
    teats = tuple(
        Teat((float(x), float(at)), shape)
        for (x, at), shape in zip((*touching, near, far), shapes, strict=True)
    )
    phantom = Phantom(teats)
    return _plain(draw, phantom) if apart(Phantom(teats[:3]), EYES_MM) > -2.0 else None


def _spurious_teat(draw: Draw) -> Situation | None:
    phantom = udder(draw)
    decoys = []
    for _ in range(draw.count(1, 2)):
        size = {
            "length_mm": draw.between("decoy_length_mm", 115.0, 150.0),
            "radius_mm": draw.between("decoy_radius_mm", 9.5, 12.5),
        }
        place = {
            "x_mm": draw.between("decoy_x_mm", -290.0, 60.0),
            "y_mm": draw.between("decoy_y_mm", 150.0, 380.0),
        }
        decoys.append(make_object("cold_teat", **place, **size))
    found = _plain(draw, phantom, *decoys)
    painted = tuple(replace(decoy, paint=found.teat_paint) for decoy in decoys)
    standing = [
        Teat((d.hulls[0].a_mm[0], d.hulls[0].a_mm[1]), TeatShape(d.hulls[0].b_mm[2] + 11.0))
        for d in decoys
    ]
    together = Phantom((*phantom.teats, *standing))
    return replace(found, objects=painted) if apart(together, EYES_MM) >= CLEAR_MM else None


def _hot_body_at_base(draw: Draw) -> Situation:
    """A cup amid the teats, as the udder: it hides some bases and no end."""
    phantom = udder(draw, spread=draw.between("spread", 1.0, 1.2))
    x, y = phantom.bases_mm[:, :2].mean(axis=0)
    lowest = float(phantom.ends_mm[:, 2].min())
    cup = make_object(
        "hot_cup",
        x_mm=float(x) + draw.between("cup_x_mm", -15.0, 15.0),
        y_mm=float(y) + draw.between("cup_y_mm", -12.0, 25.0),
        height_mm=lowest - draw.between("cup_below_mm", 25.0, 60.0),
        radius_mm=draw.between("cup_radius_mm", 20.0, 32.0),
        offset_k=draw.between("cup_offset_k", -0.5, 4.0),
        albedo=draw.between("cup_albedo", 0.2, 0.8),
        gloss=draw.between("cup_gloss", 0.0, 0.15),
    )
    return _plain(draw, phantom, cup)


def _hot_body_at_ends(draw: Draw) -> Situation:
    """A forearm behind the ends, from either side."""
    phantom = udder(draw)
    ends = phantom.ends_mm
    arm = make_object(
        "warm_arm",
        x_mm=draw.between("arm_x_mm", -230.0, -60.0),
        y_mm=float(ends[:, 1].max()) + draw.between("arm_y_mm", 110.0, 300.0),
        z_mm=float(ends[:, 2].mean()) + draw.between("arm_z_mm", -5.0, 40.0),
        length_mm=draw.between("arm_length_mm", 760.0, 940.0),
        elbow_radius_mm=draw.between("arm_elbow_radius_mm", 42.0, 56.0),
        wrist_radius_mm=draw.between("arm_wrist_radius_mm", 27.0, 36.0),
        rise_deg=draw.between("arm_rise_deg", -9.0, 9.0),
        turn_deg=draw.between("arm_turn_deg", -12.0, 12.0) + (180.0 if draw.chance(0.5) else 0.0),
        offset_k=draw.between("arm_offset_k", -1.0, 2.0),
        albedo=draw.between("arm_albedo", 0.2, 0.5),
        gloss=draw.between("arm_gloss", 0.0, 0.05),
    )
    return _plain(draw, phantom, arm)


def _cooler_bodies(draw: Draw) -> Situation | None:
    phantom = udder(draw)
    return _plain(draw, phantom, *cooler_bodies(draw, draw.count(2, 6)))


def _low_contrast(draw: Draw) -> Situation | None:
    """Teats and board of nearly one grey, dark or middling, the board perhaps textured."""
    phantom, grey = udder(draw), draw.between("grey", 0.05, 0.35)
    found = _plain(draw, phantom)
    board = backdrop(
        draw,
        (0.8 * grey, 1.3 * grey),
        texture=(0.02, 0.2),
        weave=draw.weave("cloud", "grain", "waves"),
    )
    return replace(
        found, teat_paint=Paint(grey, draw.between("teat_gloss", 0.0, 0.05)), backdrop=board
    )


def _dim_light(draw: Draw) -> Situation | None:
    found = _plain(draw, udder(draw, lean_deg=(0.0, 5.0)))
    light = lighting(draw, (0.06, 0.28))
    return replace(found, lighting=light, exposure=Exposure(gain=draw.between("gain", 1.0, 2.5)))


def _missing_or_hidden(draw: Draw) -> Situation | None:
    """A teat is missing, or a panel or a post before it hides it from one camera or all."""
    phantom = udder(draw, lean_deg=(0.0, 4.0))
    if apart(phantom, EYES_MM) < CLEAR_MM:
        return None
    at = draw.count(0, 3)
    if draw.chance(1 / 3):
        return _plain(draw, Phantom(phantom.teats[:at] + phantom.teats[at + 1 :]))
    found = _screened(draw, _plain(draw, phantom), phantom.ends_mm[at])
    hidden = hidden_ways(found)
    return found if hidden[at].any() and hidden.any(axis=1).sum() <= 2 else None


def _screened(
    draw: Draw, found: Situation, end_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> Situation:
    """With something upright between an end and the cameras."""
    eye = np.asarray(EYES_MM[draw.count(0, 2)])
    y = float(end_mm[1]) - draw.between("screen_y_mm", 28.0, 130.0)
    x = float(eye[0] + (end_mm[0] - eye[0]) * (y - eye[1]) / (end_mm[1] - eye[1])) + draw.between(
        "screen_x_mm", -6.0, 6.0
    )
    tall = float(end_mm[2]) + draw.between("screen_height_mm", 8.0, 40.0)
    if draw.chance(0.4):
        post = make_object(
            "rod",
            x_mm=x,
            y_mm=y,
            height_mm=tall,
            radius_mm=draw.between("screen_radius_mm", 8.0, 16.0),
            albedo=draw.between("screen_albedo", 0.1, 0.7),
        )
        return replace(found, objects=(post,))
    wide = draw.between("screen_width_mm", 26.0, 50.0)
    turn = draw.between("screen_turn_rad", -0.4, 0.4)
    pattern = Pattern("plain", round(wide), round(tall), 1.0, 0.0)
    across = (float(np.cos(turn)), float(np.sin(turn)), 0.0)
    corner = (x - 0.5 * wide * across[0], y - 0.5 * wide * across[1], float(pattern.rows))
    albedo = draw.between("screen_albedo", 0.1, 0.8)
    panel = Board(corner, across, pattern=pattern, name="panel", light_albedo=albedo)
    return replace(found, boards=(panel,))


def _anywhere(draw: Draw) -> Situation | None:
    """Teats anywhere in view at any lean, before any background, among things that are no teats."""
    teats = []
    for _ in range(4):
        shape = TeatShape(
            draw.between("teat_length_mm", 105.0, 155.0), draw.between("teat_radius_mm", 8.5, 13.0)
        )
        x_tilt, y_tilt = (
            float(np.radians(draw.between("tilt_deg", -16.0, 16.0))) for _ in range(2)
        )
        base = draw.between("teat_x_mm", -265.0, 20.0), draw.between("teat_y_mm", 125.0, 375.0)
        teats.append(Teat(base, shape, (x_tilt, y_tilt)))
    phantom = Phantom(tuple(teats))
    clutter = tuple(_clutter(draw) for _ in range(draw.count(0, 3)))
    found = _plain(draw, phantom, *clutter)
    textured = replace(
        found.backdrop,
        posters=posters(draw, draw.count(0, 9)),
        board_weave=draw.weave("cloud", "grain", "waves"),
        board_texture=draw.between("board_texture", 0.02, 0.3),
    )
    light: Lighting = lighting(draw, (0.5, 1.15))
    return (
        replace(found, backdrop=textured, lighting=light)
        if apart(phantom, EYES_MM[2:]) >= CLEAR_MM
        else None
    )


def _clutter(draw: Draw) -> SceneObject:
    x_mm = draw.between("thing_x_mm", -450.0, 250.0)
    kind = draw.count(0, 3)
    if kind == 3:
        return cooler_bodies(draw, 1)[0]
    name, ranges = (
        (
            "rod",
            {"height_mm": (80.0, 420.0), "radius_mm": (5.0, 14.0), "albedo": (0.05, 0.7)}
            | {"y_mm": (420.0, 900.0)},
        ),
        ("cold_teat", {"y_mm": (150.0, 700.0), "length_mm": (100.0, 160.0), "albedo": (0.05, 0.5)}),
        ("hot_cup", {"y_mm": (400.0, 700.0), "height_mm": (50.0, 120.0), "offset_k": (-8.0, 3.0)}),
    )[kind]
    drawn = {key: draw.between(f"thing_{key}", *each) for key, each in ranges.items()}
    return make_object(name, x_mm=x_mm, **drawn)


Family = Callable[[Draw], Situation | None]
SPOKEN = {
    "non_vertical": "non-vertical teats",
    "overlapping": "overlapping teats",
    "hot_body_at_base": "hot body at the base",
    "hot_body_at_ends": "hot body at the ends",
}


def spoken(name: str) -> str:
    """A situation's name as people say it, for all that is printed or drawn; files and JSON keep
    the name itself.
    """
    return SPOKEN.get(name, name.replace("_", " "))


SITUATIONS: dict[str, tuple[str, Family]] = {
    "ideal": ("Four upright teats, none touching or covering another; neutral background.", _ideal),
    "non_vertical": (
        "Four teats, each leaning another way by 5 to 19 degrees; neutral background.",
        partial(_ideal, lean_deg=(5.0, 19.0)),
    ),
    "overlapping": (
        (
            "Two teats touching; of the two others the near one covers part of the far one, as the"
            " cameras see it."
        ),
        _overlapping,
    ),
    "spurious_teat": (
        "Four teats, and one or two unheated teat-shaped objects beside them.",
        _spurious_teat,
    ),
    "hot_body_at_base": (
        "Four teats, and a cup of hot water amid them that leaves their ends free.",
        _hot_body_at_base,
    ),
    "hot_body_at_ends": (
        "Four teats, and a person's bare forearm behind their ends.",
        _hot_body_at_ends,
    ),
    "cooler_bodies": (
        "Four teats, and behind them several bodies a few kelvin cooler than the teats.",
        _cooler_bodies,
    ),
    "low_contrast": ("Four teats before a board of nearly their own grey.", _low_contrast),
    "dim_light": ("Four teats in dim light.", _dim_light),
    "missing_or_hidden": (
        "Three teats, or four of which something hides one or two from a camera.",
        _missing_or_hidden,
    ),
    "anywhere": ("Four teats anywhere in view, leaning any way, among other things.", _anywhere),
}
