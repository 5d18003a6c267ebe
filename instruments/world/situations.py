"""Families of scenes: from a name and a seed to everything that a scene needs.

The thesis's six (section 5.2), and ideal, low contrast, dim light, a teat missing or hidden, and
anything anywhere; and those of a cowshed. Each draws until a scene can be set up (no overlaps,
ends within reach of arm and cameras) and fits its name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from weakref import WeakValueDictionary

import numpy as np

from instruments.world import cowshed
from instruments.world.boards import Board, Pattern
from instruments.world.draws import (
    Draw,
    Parameter,
    Range,
    backdrop,
    cooler_bodies,
    lighting,
    plain,
    posters,
    shape,
    udder,
)
from instruments.world.objects import SceneObject, check_known, make_object
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.sensor import Exposure
from instruments.world.setups import EYES_MM, Situation, apart, hidden_ways, situation_faults
from instruments.world.shading import Paint

ATTEMPTS = 1000
CLEAR_MM = 4.0  # between teats that don't overlap, as seen
CLOSE = ("overlapping", "anywhere")  # families with a rule of their own for it


# of a run of any length: its report asks for them again, when `member` may have forgotten the first
_in_use = WeakValueDictionary[tuple[str, int], Situation]()


def situation(name: str, seed: int) -> Situation:
    """Member ``seed`` of the family. Raises ValueError for an unknown name or negative seed."""
    found = _in_use.get((name, seed))
    if found is None:
        found = _in_use[name, seed] = member(name, seed)[0]
    return found


@lru_cache(maxsize=1024)
def member(name: str, seed: int) -> tuple[Situation, Mapping[str, Parameter]]:
    """As `situation`, with its parameters by name: the first attempt that succeeds."""
    check_known("situation", name, SITUATIONS)
    if seed < 0:
        raise ValueError(f"a situation's seed must be 0 or more, is {seed}")
    for attempt in range(ATTEMPTS):
        found, parameters = _drawn(name, seed, attempt)
        if found:
            return found, parameters
    raise RuntimeError(
        f"nothing that can be set up was found for {name} {seed} in {ATTEMPTS} draws: the family's"
        " limits contradict each other"
    )


def _drawn(name: str, seed: int, attempt: int) -> tuple[Situation | None, Mapping[str, Parameter]]:
    """One attempt at a member, None where it doesn't fit, and its parameters by name."""
    draw, (about, family) = Draw(name, seed, attempt), SITUATIONS[name]
    found = family(draw)
    if found is None or (name not in CLOSE and apart(found.phantom, EYES_MM) < CLEAR_MM):
        return None, draw.parameters
    found = replace(found, name=name, seed=seed, about=about)
    return None if situation_faults(found) else found, draw.parameters


def _upright(draw: Draw, lean_deg: Range = (0.0, 2.0)) -> Situation:
    return plain(draw, udder(draw, lean_deg=lean_deg))


def _overlapping(draw: Draw) -> Situation | None:
    """Two teats touch side by side; of the two others the near one covers part of the far one."""
    middle, across = draw.between("middle_x_mm", -185.0, -105.0), draw.either()
    y = draw.between("touching_y_mm", 200.0, 270.0)
    shapes = [shape(draw, (118.0, 148.0), (9.5, 12.5)) for _ in range(4)]
    radii = [each.radius_mm for each in shapes]
    gap, turn = draw.between("gap_mm", 0.0, 1.5), draw.between("turn_rad", -0.35, 0.35)
    step = radii[0] + radii[1] + gap
    first = middle + across * draw.between("touching_x_mm", 30.0, 60.0)
    second = first + across * step * float(np.cos(turn)), y + step * float(np.sin(turn))
    near_x = middle - across * draw.between("near_x_mm", 15.0, 45.0)
    near_y = y - draw.between("near_y_mm", 15.0, 50.0)
    eye_x, eye_y, _ = EYES_MM[2]
    far_y = near_y + draw.between("far_y_mm", 35.0, 95.0)
    covered = draw.between("covered_share", 0.25, 0.75) * (radii[2] + radii[3]) * draw.either()
    far_x = eye_x + (near_x - eye_x) * (far_y - eye_y) / (near_y - eye_y) + covered
    feet = ((first, y), second, (near_x, near_y), (far_x, far_y))
    teats = tuple(Teat(foot, each) for foot, each in zip(feet, shapes, strict=True))
    return plain(draw, Phantom(teats)) if apart(Phantom(teats[:3]), EYES_MM) > -2.0 else None


def _spurious_teat(draw: Draw) -> Situation | None:
    phantom, decoys, standing = udder(draw), [], []
    for _ in range(draw.count(1, 2)):
        decoy = draw.each("decoy", length_mm=(115.0, 150.0), radius_mm=(9.5, 12.5))
        decoy |= draw.each("decoy", x_mm=(-290.0, 60.0), y_mm=(150.0, 380.0))
        decoys.append(make_object("cold_teat", **decoy))
        (hull,) = decoys[-1].hulls
        standing.append(Teat((hull.a_mm[0], hull.a_mm[1]), TeatShape(hull.b_mm[2] + 11.0)))
    found = plain(draw, phantom)
    if apart(Phantom((*phantom.teats, *standing)), EYES_MM) < CLEAR_MM:
        return None
    return replace(found, objects=tuple(replace(one, paint=found.teat_paint) for one in decoys))


def _hot_body_at_base(draw: Draw) -> Situation:
    """A cup amid the teats, as the udder: it hides some bases and no end."""
    phantom = udder(draw, spread=draw.between("spread", 1.0, 1.2))
    x, y = phantom.bases_mm[:, :2].mean(axis=0).tolist()
    cup = draw.each(
        "cup", x_mm=(-15.0, 15.0), y_mm=(-12.0, 25.0), below_mm=(25.0, 60.0),
        radius_mm=(20.0, 32.0), offset_k=(-0.5, 4.0), albedo=(0.2, 0.8), gloss=(0.0, 0.15),
    )  # fmt: skip
    cup["x_mm"] += x
    cup["y_mm"] += y
    cup["height_mm"] = float(phantom.ends_mm[:, 2].min()) - cup.pop("below_mm")
    return plain(draw, phantom, make_object("hot_cup", **cup))


def _hot_body_at_ends(draw: Draw) -> Situation:
    """A forearm behind the ends, from either side."""
    phantom = udder(draw)
    arm = draw.each(
        "arm", x_mm=(-230.0, -60.0), y_mm=(110.0, 300.0), z_mm=(-5.0, 40.0),
        length_mm=(760.0, 940.0), elbow_radius_mm=(42.0, 56.0), wrist_radius_mm=(27.0, 36.0),
        rise_deg=(-9.0, 9.0), turn_deg=(-12.0, 12.0),
    )  # fmt: skip
    arm["y_mm"] += float(phantom.ends_mm[:, 1].max())
    arm["z_mm"] += float(phantom.ends_mm[:, 2].mean())
    arm["turn_deg"] += 180.0 if draw.chance(0.5) else 0.0
    look = draw.each("arm", offset_k=(-1.0, 2.0), albedo=(0.2, 0.5), gloss=(0.0, 0.05))
    return plain(draw, phantom, make_object("warm_arm", **arm, **look))


def _cooler_bodies(draw: Draw) -> Situation:
    phantom = udder(draw)
    return plain(draw, phantom, *cooler_bodies(draw, draw.count(2, 6)))


def _low_contrast(draw: Draw) -> Situation:
    """Teats and board of nearly one grey, dark or middling, the board perhaps textured."""
    phantom, grey = udder(draw), draw.between("grey", 0.05, 0.35)
    found, greys = plain(draw, phantom), (0.8 * grey, 1.3 * grey)
    board = backdrop(draw, greys, texture=(0.02, 0.2), weave=draw.one_of("cloud", "grain", "waves"))
    paint = Paint(grey, draw.between("teat_gloss", 0.0, 0.05))
    return replace(found, teat_paint=paint, backdrop=board)


def _dim_light(draw: Draw) -> Situation:
    found = plain(draw, udder(draw, lean_deg=(0.0, 5.0)))
    light = lighting(draw, (0.06, 0.28))
    return replace(found, lighting=light, exposure=Exposure(gain=draw.between("gain", 1.0, 2.5)))


def _missing_or_hidden(draw: Draw) -> Situation | None:
    """A teat is missing, or a panel or a post before it hides it from one camera or all."""
    phantom = udder(draw, lean_deg=(0.0, 4.0))
    if apart(phantom, EYES_MM) < CLEAR_MM:
        return None
    at = draw.count(0, 3)
    if draw.chance(1 / 3):
        return plain(draw, Phantom(phantom.teats[:at] + phantom.teats[at + 1 :]))
    found = _screened(draw, plain(draw, phantom), phantom.ends_mm[at])
    hidden = hidden_ways(found)
    return found if hidden[at].any() and hidden.any(axis=1).sum() <= 2 else None


def _screened(draw: Draw, found: Situation, end_mm: Floats) -> Situation:
    """With something upright between an end and the cameras."""
    (eye_x, eye_y, _), (end_x, end_y, end_z) = draw.one_of(*EYES_MM), end_mm.tolist()
    y = end_y - draw.between("screen_y_mm", 28.0, 130.0)
    x = eye_x + (end_x - eye_x) * (y - eye_y) / (end_y - eye_y)
    x += draw.between("screen_x_mm", -6.0, 6.0)
    tall = end_z + draw.between("screen_height_mm", 8.0, 40.0)
    if draw.chance(0.4):
        look = draw.each("screen", radius_mm=(8.0, 16.0), albedo=(0.1, 0.7))
        post = make_object("rod", x_mm=x, y_mm=y, height_mm=tall, **look)
        return replace(found, objects=(post,))
    wide, turn = draw.each("screen", width_mm=(26.0, 50.0), turn_rad=(-0.4, 0.4)).values()
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
        form = shape(draw, (105.0, 155.0), (8.5, 13.0))
        x_tilt, y_tilt = (
            float(np.radians(draw.between("tilt_deg", -16.0, 16.0))) for _ in range(2)
        )
        x, y = draw.each("teat", x_mm=(-265.0, 20.0), y_mm=(125.0, 375.0)).values()
        teats.append(Teat((x, y), form, (x_tilt, y_tilt)))
    phantom = Phantom(tuple(teats))
    clutter = tuple(_clutter(draw) for _ in range(draw.count(0, 3)))
    found = plain(draw, phantom, *clutter)
    textured = replace(
        found.backdrop,
        posters=posters(draw, draw.count(0, 9)),
        board_weave=draw.one_of("cloud", "grain", "waves"),
        board_texture=draw.between("board_texture", 0.02, 0.3),
    )
    found = replace(found, backdrop=textured, lighting=lighting(draw, (0.5, 1.15)))
    return found if apart(phantom, EYES_MM[2:]) >= CLEAR_MM else None


CLUTTER: tuple[tuple[str, dict[str, Range]], ...] = (
    (
        "rod",
        {"height_mm": (80.0, 420.0), "radius_mm": (5.0, 14.0)}
        | {"albedo": (0.05, 0.7), "y_mm": (420.0, 900.0)},
    ),
    ("cold_teat", {"y_mm": (150.0, 700.0), "length_mm": (100.0, 160.0), "albedo": (0.05, 0.5)}),
    ("hot_cup", {"y_mm": (400.0, 700.0), "height_mm": (50.0, 120.0), "offset_k": (-8.0, 3.0)}),
)


def _clutter(draw: Draw) -> SceneObject:
    x_mm = draw.between("thing_x_mm", -450.0, 250.0)
    number = draw.count(0, len(CLUTTER))
    if number == len(CLUTTER):
        return cooler_bodies(draw, 1)[0]
    kind, ranges = CLUTTER[number]
    return make_object(kind, x_mm=x_mm, **draw.each("thing", **ranges))


SPOKEN = {
    "non_vertical": "non-vertical teats",
    "overlapping": "overlapping teats",
    "hot_body_at_base": "hot body at the base",
    "hot_body_at_ends": "hot body at the ends",
}


def spoken(name: str) -> str:
    """A situation's name for people; files and JSON keep the name itself."""
    return SPOKEN.get(name, name.replace("_", " "))


# what to set up, in a sentence, and what draws it; None where a draw doesn't fit the name
SITUATIONS: dict[str, tuple[str, Callable[[Draw], Situation | None]]] = {
    "ideal": (
        "Four upright teats, none touching or covering another; neutral background.",
        _upright,
    ),
    "non_vertical": (
        "Four teats, each leaning another way by 5 to 19 degrees; neutral background.",
        partial(_upright, lean_deg=(5.0, 19.0)),
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
    "cool_quarters": (
        "Four teats, up to three of them as much as 5 K cooler than the warmest.",
        cowshed.cool_quarters,
    ),
    "warm_room": ("Four teats in surroundings of 26 to 31 degC.", cowshed.warm_room),
    "straw_and_legs": (
        "Four teats with straws across them, and hind legs and a tail behind them.",
        cowshed.straw_and_legs,
    ),
    "cow_teats": ("Four teats of a cow's length and shape on a warm udder.", cowshed.cow_teats),
    "wet": ("Four wet teats with drops and dirt on them, cooled by evaporation.", cowshed.wet),
    "cluttered": (
        "Four teats before pipes and posts, with teat cups and hoses beside and behind them.",
        cowshed.cluttered,
    ),
    "outward": ("Four teats that point outward by 20 to 40 degrees.", cowshed.outward),
    "swollen": ("Four teats, one of them swollen.", cowshed.swollen),
    "liners": (
        "Four teats before and beside liners whose rims are level with the ends.",
        cowshed.liners,
    ),
    "rods": ("One teat to four, with rods behind that one camera sees beside them.", cowshed.rods),
}
