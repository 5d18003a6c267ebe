"""The eleven families: each draws, from name and seed alone, until a scene can be set up and fits
its name.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from instruments.world.boards import Board, Pattern
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.sensor import Exposure
from instruments.world.shading import Lighting, Paint
from instruments.world.situations.draws import (
    Draw,
    apart,
    backdrop,
    cooler_bodies,
    dark_paint,
    light_paint,
    lighting,
    posters,
    udder,
)
from instruments.world.situations.situation import EYES_MM, Situation, faults, hidden_ways

ATTEMPTS = 1000
CLEAR_MM = 4.0  # between teats that don't overlap, as seen


def situation(name: str, seed: int) -> Situation:
    """Member ``seed`` of the family. Raises ValueError for an unknown name or negative seed."""
    if name not in SITUATIONS:
        close = difflib.get_close_matches(name, SITUATIONS, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        raise ValueError(f"there is no situation {name!r}{hint} Known: {', '.join(SITUATIONS)}")
    if seed < 0:
        raise ValueError(f"a situation's seed must be 0 or more, is {seed}")
    about, family = SITUATIONS[name]
    for attempt in range(ATTEMPTS):
        drawn = family(Draw(name, seed, attempt))
        if drawn is not None:
            found = replace(drawn, name=name, seed=seed, about=about)
            if not faults(found):
                return found
    raise RuntimeError(
        f"nothing that can be set up was found for {name} {seed} in {ATTEMPTS} draws: the family's"
        " limits contradict each other"
    )


def _plain(draw: Draw, phantom: Phantom, *objects: SceneObject) -> Situation:
    """A neutral background: dark teats on light, or one time in three light on dark."""
    light = draw.chance(1 / 3)
    return Situation(
        "", 0, "", phantom, objects,
        lighting=lighting(draw),
        teat_paint=light_paint(draw) if light else dark_paint(draw),
        backdrop=backdrop(draw, (0.05, 0.12) if light else (0.40, 0.68)),
    )  # fmt: skip


def _clear(phantom: Phantom) -> bool:
    return apart(phantom, EYES_MM) >= CLEAR_MM


def _ideal(draw: Draw) -> Situation | None:
    phantom = udder(draw)
    return _plain(draw, phantom) if _clear(phantom) else None


def _non_vertical(draw: Draw) -> Situation | None:
    phantom = udder(draw, lean_deg=(5.0, 19.0))
    return _plain(draw, phantom) if _clear(phantom) else None


def _overlapping(draw: Draw) -> Situation | None:
    """Two teats touch side by side; of the two others the near one covers part of the far one."""
    middle, across = draw.between(-185.0, -105.0), draw.either()
    y = draw.between(200.0, 270.0)
    shapes = [TeatShape(draw.between(118.0, 148.0), draw.between(9.5, 12.5)) for _ in range(4)]
    gap = draw.between(0.0, 1.5)
    turn = draw.between(-0.35, 0.35)
    step = shapes[0].radius_mm + shapes[1].radius_mm + gap
    first = middle + across * draw.between(30.0, 60.0)
    touching = [
        (first, y),
        (first + across * step * float(np.cos(turn)), y + step * float(np.sin(turn))),
    ]
    near = (middle - across * draw.between(15.0, 45.0), y - draw.between(15.0, 50.0))
    eye = EYES_MM[2]
    far_y = near[1] + draw.between(35.0, 95.0)
    hidden = draw.between(0.25, 0.75) * (shapes[2].radius_mm + shapes[3].radius_mm) * draw.either()
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
        size = {"length_mm": draw.between(115.0, 150.0), "radius_mm": draw.between(9.5, 12.5)}
        decoys.append(
            make_object(
                "cold_teat",
                x_mm=draw.between(-290.0, 60.0),
                y_mm=draw.between(150.0, 380.0),
                **size,
            )
        )
    found = _plain(draw, phantom, *decoys)
    painted = tuple(replace(decoy, paint=found.teat_paint) for decoy in decoys)
    standing = [
        Teat((d.hulls[0].a_mm[0], d.hulls[0].a_mm[1]), TeatShape(d.hulls[0].b_mm[2] + 11.0))
        for d in decoys
    ]
    together = Phantom((*phantom.teats, *standing))
    return replace(found, objects=painted) if _clear(together) else None


def _hot_body_at_base(draw: Draw) -> Situation | None:
    """A cup amid the teats, as the udder: it hides some bases and no end."""
    phantom = udder(draw, spread=draw.between(1.0, 1.2))
    x, y = phantom.bases_mm[:, :2].mean(axis=0)
    lowest = float(phantom.ends_mm[:, 2].min())
    cup = make_object(
        "hot_cup",
        x_mm=float(x) + draw.between(-15.0, 15.0),
        y_mm=float(y) + draw.between(-12.0, 25.0),
        height_mm=lowest - draw.between(25.0, 60.0),
        radius_mm=draw.between(20.0, 32.0),
        offset_k=draw.between(-0.5, 4.0),
        albedo=draw.between(0.2, 0.8),
        gloss=draw.between(0.0, 0.15),
    )
    return _plain(draw, phantom, cup) if _clear(phantom) else None


def _hot_body_at_ends(draw: Draw) -> Situation | None:
    """A forearm behind the ends, from either side."""
    phantom = udder(draw)
    ends = phantom.ends_mm
    arm = make_object(
        "warm_arm",
        x_mm=draw.between(-230.0, -60.0),
        y_mm=float(ends[:, 1].max()) + draw.between(110.0, 300.0),
        z_mm=float(ends[:, 2].mean()) + draw.between(-5.0, 40.0),
        length_mm=draw.between(760.0, 940.0),
        elbow_radius_mm=draw.between(42.0, 56.0),
        wrist_radius_mm=draw.between(27.0, 36.0),
        rise_deg=draw.between(-9.0, 9.0),
        turn_deg=draw.between(-12.0, 12.0) + (180.0 if draw.chance(0.5) else 0.0),
        offset_k=draw.between(-1.0, 2.0),
        albedo=draw.between(0.2, 0.5),
        gloss=draw.between(0.0, 0.05),
    )
    return _plain(draw, phantom, arm) if _clear(phantom) else None


def _cooler_bodies(draw: Draw) -> Situation | None:
    phantom = udder(draw)
    return (
        _plain(draw, phantom, *cooler_bodies(draw, draw.count(2, 6))) if _clear(phantom) else None
    )


def _low_contrast(draw: Draw) -> Situation | None:
    """Teats and board of nearly one grey, dark or middling, the board perhaps textured."""
    phantom = udder(draw)
    grey = draw.between(0.05, 0.35)
    found = _plain(draw, phantom)
    board = backdrop(
        draw,
        (0.8 * grey, 1.3 * grey),
        texture=(0.02, 0.2),
        weave=draw.weave("cloud", "grain", "waves"),
    )
    return (
        replace(found, teat_paint=Paint(grey, draw.between(0.0, 0.05)), backdrop=board)
        if _clear(phantom)
        else None
    )


def _dim_light(draw: Draw) -> Situation | None:
    phantom = udder(draw, lean_deg=(0.0, 5.0))
    found = _plain(draw, phantom)
    dim = replace(
        found, lighting=lighting(draw, (0.06, 0.28)), exposure=Exposure(gain=draw.between(1.0, 2.5))
    )
    return dim if _clear(phantom) else None


def _missing_or_hidden(draw: Draw) -> Situation | None:
    """A teat is missing, or a panel or a post before it hides it from one camera or all."""
    phantom = udder(draw, lean_deg=(0.0, 4.0))
    if not _clear(phantom):
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
    y = float(end_mm[1]) - draw.between(28.0, 130.0)
    x = float(eye[0] + (end_mm[0] - eye[0]) * (y - eye[1]) / (end_mm[1] - eye[1])) + draw.between(
        -6.0, 6.0
    )
    tall = float(end_mm[2]) + draw.between(8.0, 40.0)
    if draw.chance(0.4):
        post = make_object(
            "rod",
            x_mm=x,
            y_mm=y,
            height_mm=tall,
            radius_mm=draw.between(8.0, 16.0),
            albedo=draw.between(0.1, 0.7),
        )
        return replace(found, objects=(post,))
    wide = draw.between(26.0, 50.0)
    pattern = Pattern("plain", 1, 1, 1.0, 0.0)
    turn = draw.between(-0.4, 0.4)
    across = (float(np.cos(turn)), float(np.sin(turn)), 0.0)
    pattern = replace(pattern, rows=round(tall), columns=round(wide))
    corner = (x - 0.5 * wide * across[0], y - 0.5 * wide * across[1], float(pattern.rows))
    panel = Board(
        corner, across, pattern=pattern, name="panel", light_albedo=draw.between(0.1, 0.8)
    )
    return replace(found, boards=(panel,))


def _anywhere(draw: Draw) -> Situation | None:
    """Teats anywhere in view at any lean, before any background, among things that are no teats."""
    teats = []
    for _ in range(4):
        shape = TeatShape(draw.between(105.0, 155.0), draw.between(8.5, 13.0))
        tilt = (
            float(np.radians(draw.between(-16.0, 16.0))),
            float(np.radians(draw.between(-16.0, 16.0))),
        )
        teats.append(Teat((draw.between(-265.0, 20.0), draw.between(125.0, 375.0)), shape, tilt))
    phantom = Phantom(tuple(teats))
    clutter = tuple(_clutter(draw) for _ in range(draw.count(0, 3)))
    found = _plain(draw, phantom, *clutter)
    textured = replace(
        found.backdrop,
        posters=posters(draw, draw.count(0, 9)),
        board_weave=draw.weave("cloud", "grain", "waves"),
        board_texture=draw.between(0.02, 0.3),
    )
    light: Lighting = lighting(draw, (0.5, 1.15))
    return (
        replace(found, backdrop=textured, lighting=light)
        if apart(phantom, EYES_MM[2:]) >= CLEAR_MM
        else None
    )


def _clutter(draw: Draw) -> SceneObject:
    x = draw.between(-450.0, 250.0)
    match draw.count(0, 3):
        case 0:
            size = {
                "height_mm": draw.between(80.0, 420.0),
                "radius_mm": draw.between(5.0, 14.0),
                "albedo": draw.between(0.05, 0.7),
            }
            return make_object("rod", x_mm=x, y_mm=draw.between(420.0, 900.0), **size)
        case 1:
            return make_object(
                "cold_teat",
                x_mm=x,
                y_mm=draw.between(150.0, 700.0),
                length_mm=draw.between(100.0, 160.0),
                albedo=draw.between(0.05, 0.5),
            )
        case 2:
            return make_object(
                "hot_cup",
                x_mm=x,
                y_mm=draw.between(400.0, 700.0),
                height_mm=draw.between(50.0, 120.0),
                offset_k=draw.between(-8.0, 3.0),
            )
        case _:
            return cooler_bodies(draw, 1)[0]


Family = Callable[[Draw], Situation | None]
SITUATIONS: dict[str, tuple[str, Family]] = {
    "ideal": ("Four upright teats, none touching or covering another; neutral background.", _ideal),
    "non_vertical": (
        "Four teats, each leaning another way by 5 to 19 degrees; neutral background.",
        _non_vertical,
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
