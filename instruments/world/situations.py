"""Families of scenes: from a name and a seed to everything that a scene needs.

The thesis's six (section 5.2), and ideal, low contrast, dim light, a teat missing or hidden, and
anything anywhere; and those of a cowshed. Each draws until a scene can be set up (no overlaps,
ends within reach of arm and cameras) and fits its name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from instruments.world import cowshed
from instruments.world.boards import Board, Pattern
from instruments.world.draws import (
    Draw,
    Parameter,
    backdrop,
    cooler_bodies,
    lighting,
    plain,
    posters,
    udder,
)
from instruments.world.objects import SceneObject, check_known, make_object
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.sensor import Exposure
from instruments.world.setups import EYES_MM, Situation, apart, faults, hidden_ways
from instruments.world.shading import Lighting, Paint

ATTEMPTS = 1000
CLEAR_MM = 4.0  # between teats that don't overlap, as seen
CLOSE = ("overlapping", "anywhere")  # families with a rule of their own for it


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


def _ideal(draw: Draw, lean_deg: tuple[float, float] = (0.0, 2.0)) -> Situation | None:
    return plain(draw, udder(draw, lean_deg=lean_deg))


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
    return plain(draw, phantom) if apart(Phantom(teats[:3]), EYES_MM) > -2.0 else None


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
    found = plain(draw, phantom, *decoys)
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
    return plain(draw, phantom, cup)


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
    return plain(draw, phantom, arm)


def _cooler_bodies(draw: Draw) -> Situation | None:
    phantom = udder(draw)
    return plain(draw, phantom, *cooler_bodies(draw, draw.count(2, 6)))


def _low_contrast(draw: Draw) -> Situation | None:
    """Teats and board of nearly one grey, dark or middling, the board perhaps textured."""
    phantom, grey = udder(draw), draw.between("grey", 0.05, 0.35)
    found = plain(draw, phantom)
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
    found = plain(draw, phantom, *clutter)
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
    "cool_quarters": (
        "Four teats, up to three of them as much as 5 K cooler than the warmest.",
        cowshed.cool_quarters,
    ),
    "warm_room": ("Four teats in surroundings of 26 to 31 degC.", cowshed.warm_room),
    "straw_and_legs": (
        "Four teats with straws across them, and hind legs and a tail behind them.",
        cowshed.straw_and_legs,
    ),
    "cow_teats": (
        "Four teats of a cow's length and shape on a warm udder.",
        cowshed.cow_teats,
    ),
    "wet": (
        "Four wet teats with drops and dirt on them, cooled by evaporation.",
        cowshed.wet,
    ),
    "cluttered": (
        "Four teats before pipes and posts, with teat cups and hoses beside and behind them.",
        cowshed.cluttered,
    ),
}
