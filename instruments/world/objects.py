"""What stands in the scene beside the phantom, made by name: solids, paint and a temperature.

A temperature is in degC, "teat" (the teats' mean) or "ambient", plus an offset in kelvin.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from itertools import pairwise
from typing import Any, Literal

from instruments.world.phantom import Phantom
from instruments.world.shading import Paint
from instruments.world.solids import Hull, Point, ball, chain, cylinder

Warmth = float | Literal["teat", "ambient"]
Hulls = tuple[Hull, ...]
TEAT_PAINT = Paint(albedo=0.07, gloss=0.05, emissivity=0.95)
ARM_STATIONS = (0.0, 0.15, 0.3, 0.42, 0.54, 0.68, 0.76, 0.84, 0.92, 1.0)
JOINT_MM = 4.0
# a hind leg: height and radius of hoof's top, pastern, fetlock, cannon, hock, thigh
LEG_MM = (
    (62.0, 44.0), (105.0, 36.0), (150.0, 40.0), (215.0, 33.0),
    (350.0, 32.0), (450.0, 46.0), (520.0, 44.0), (840.0, 90.0),
)  # fmt: skip
PIECES = 10  # of what hangs
HOSE_PAINT = Paint(albedo=0.13, gloss=0.03, emissivity=0.93)


@dataclass(frozen=True, slots=True)
class SceneObject:
    """A thing in the scene, world frame: its solids, its paint, its temperature."""

    name: str
    hulls: Hulls
    paint: Paint
    temperature: Warmth
    offset_k: float = 0.0


def phantom_objects(
    phantom: Phantom, paint: Paint, teat_temps_c: Iterable[float], hose_c: float
) -> tuple[SceneObject, ...]:
    """Teats, then flanges and hoses, as warm as their water, or the udder; then drops and dirt."""
    upright, feet, bows, udder, spots = _hulls(phantom)
    temps_c = tuple(teat_temps_c)
    teats = [
        SceneObject(f"teat {i}", hulls, paint, temp)
        for i, (hulls, temp) in enumerate(zip(upright, temps_c, strict=True))
    ]
    on_teats = [
        SceneObject(each.name, hulls, each.paint, sum(temps_c) / len(temps_c), -each.cooler_k)
        for each, hulls in zip(phantom.spots, spots, strict=True)
    ]
    if udder:
        return (*teats, SceneObject("udder", udder, paint, hose_c), *on_teats)
    flanges = [SceneObject(f"flange {i}", (hull,), paint, hose_c) for i, hull in enumerate(feet)]
    hoses = [SceneObject(f"hose {i}", hulls, HOSE_PAINT, hose_c) for i, hulls in enumerate(bows)]
    return (*teats, *flanges, *hoses, *on_teats)


@lru_cache(maxsize=16)  # a state is asked for its things by every camera
def _hulls(
    phantom: Phantom,
) -> tuple[tuple[Hulls, ...], Hulls, tuple[Hulls, ...], Hulls, list[Hulls]]:
    return (
        phantom.teat_hulls(),
        phantom.flange_hulls(),
        phantom.hose_hulls(),
        phantom.udder_hulls(),
        [phantom.spot_hulls(spots) for spots in phantom.spots],
    )


def _cold_teat(
    x_mm: float = -25.0, y_mm: float = 225.0, length_mm: float = 135.0, radius_mm: float = 11.0
) -> Hulls:
    """Section 5.2.3: shaped as a teat, not heated."""
    top = (x_mm, y_mm, length_mm - radius_mm)
    return (Hull((x_mm, y_mm, 0.0), top, radius_mm, radius_mm, flat_a=True),)


def _hot_cup(
    x_mm: float = -192.0,
    y_mm: float = 240.0,
    height_mm: float = 85.0,
    radius_mm: float = 30.0,
    foot_radius_mm: float | None = None,
) -> Hulls:
    """Section 5.2.4: a cup amid the teats in place of the udder, wider at its rim."""
    foot = 0.8 * radius_mm if foot_radius_mm is None else foot_radius_mm
    return (cylinder((x_mm, y_mm, 0.0), (x_mm, y_mm, height_mm), foot, radius_mm),)


def _warm_arm(
    x_mm: float = -150.0,
    y_mm: float = 480.0,
    z_mm: float = 155.0,
    length_mm: float = 860.0,
    elbow_radius_mm: float = 52.0,
    wrist_radius_mm: float = 34.0,
    rise_deg: float = -4.0,
    turn_deg: float = 4.0,
) -> Hulls:
    """Section 5.2.5: a forearm and hand behind the teat ends, from left (elbow) to right."""
    rise, turn = math.radians(rise_deg), math.radians(turn_deg)
    way = (math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise))

    def along(part: float) -> Point:
        reach = (part - 0.5) * length_mm
        return x_mm + reach * way[0], y_mm + reach * way[1], z_mm + reach * way[2]

    def radius(part: float) -> float:
        """Elbow, belly of the forearm, wrist at 0.68, back of the hand, fingertips."""
        if part <= 0.68:
            belly = 0.5 + 0.5 * math.cos(math.pi * part / 0.68)
            return wrist_radius_mm + (elbow_radius_mm - wrist_radius_mm) * belly
        hand = (part - 0.68) / 0.32
        back = 0.35 * math.sin(math.pi * min(hand / 0.8, 1.0))
        return wrist_radius_mm * (1.0 + back - 0.45 * hand**3)

    # Slices that overlap a little, so that no pixel lies half on one and half on the next.
    slices = [(start, end + JOINT_MM / length_mm) for start, end in pairwise(ARM_STATIONS)]
    forearm = [cylinder(along(a), along(b), radius(a), radius(b)) for a, b in slices]
    return (*forearm, ball(along(0.0), radius(0.0)), ball(along(1.0), radius(1.0)))


def _cooler_body(
    x_mm: float = -190.0,
    y_mm: float = 480.0,
    z_mm: float = 0.0,
    height_mm: float = 180.0,
    radius_mm: float = 60.0,
    top_radius_mm: float | None = None,
) -> Hulls:
    """Section 5.2.6: a cooler leg or flank behind the teats: upright, tapered, round on top."""
    top = 0.85 * radius_mm if top_radius_mm is None else top_radius_mm
    if not height_mm > top:
        raise ValueError(
            f"height_mm must be more than the radius of the round top ({top:g} mm), is"
            f" {height_mm:g}"
        )
    head = (x_mm, y_mm, z_mm + height_mm - top)
    return cylinder((x_mm, y_mm, z_mm), head, radius_mm, top), ball(head, top)


def _ball(
    x_mm: float = -190.0, y_mm: float = 480.0, z_mm: float = 230.0, radius_mm: float = 60.0
) -> Hulls:
    """A sphere, hung anywhere."""
    return (ball((x_mm, y_mm, z_mm), radius_mm),)


def _rod(
    x_mm: float = -190.0, y_mm: float = 600.0, height_mm: float = 300.0, radius_mm: float = 8.0
) -> Hulls:
    """An upright post behind the teats: clutter for the optical cameras."""
    return (cylinder((x_mm, y_mm, 0.0), (x_mm, y_mm, height_mm), radius_mm),)


def _straight(
    x_mm: float = -190.0,
    y_mm: float = 150.0,
    z_mm: float = 100.0,
    length_mm: float = 100.0,
    radius_mm: float = 1.5,
    rise_deg: float = 30.0,
    turn_deg: float = 0.0,
) -> Hulls:
    """Straight, with its middle there: a straw, a pipe; along x, turned to y, risen to z."""
    rise, turn = math.radians(rise_deg), math.radians(turn_deg)
    half = 0.5 * length_mm
    x, y, z = (
        half * math.cos(rise) * math.cos(turn),
        half * math.cos(rise) * math.sin(turn),
        half * math.sin(rise),
    )
    ends = (x_mm - x, y_mm - y, z_mm - z), (x_mm + x, y_mm + y, z_mm + z)
    return (cylinder(*ends, radius_mm),)


_pipe = partial(_straight, y_mm=450.0, z_mm=170.0, length_mm=1200.0, radius_mm=18.0, rise_deg=0.0)


def _hose(
    x_mm: float = -190.0,
    y_mm: float = 420.0,
    z_mm: float = 60.0,
    span_mm: float = 300.0,
    sag_mm: float = 120.0,
    radius_mm: float = 8.0,
    turn_deg: float = 0.0,
) -> Hulls:
    """Hangs between two places ``span_mm`` apart, its lowest there; along x, turned to y."""
    turn = math.radians(turn_deg)
    parts = [2.0 * step / PIECES - 1.0 for step in range(PIECES + 1)]
    points = [
        (
            x_mm + 0.5 * span_mm * part * math.cos(turn),
            y_mm + 0.5 * span_mm * part * math.sin(turn),
            z_mm + sag_mm * part**2,
        )
        for part in parts
    ]
    return chain(points, [radius_mm] * len(points))


def _leg(
    x_mm: float = -190.0, y_mm: float = 450.0, share: float = 1.0, lean_deg: float = 0.0
) -> Hulls:
    """A hind leg from the hoof up, leaning to x; ``share`` scales its girth."""
    slope = math.tan(math.radians(lean_deg))
    stations = [
        (low + part * (high - low), wide + (narrow - wide) * 0.5 * (1.0 - math.cos(math.pi * part)))
        for (low, wide), (high, narrow) in pairwise(LEG_MM)
        for part in (0.0, 0.33, 0.67)
    ]
    points = [(x_mm + slope * height, y_mm, height) for height, _ in stations]
    radii = [share * radius for _, radius in stations]
    (x, y, z), radius = points[0], radii[0]
    return cylinder((x, y, 0.0), (x, y, z), 1.2 * radius, radius), *chain(points, radii)


def _tail(
    x_mm: float = -190.0,
    y_mm: float = 420.0,
    z_mm: float = 140.0,
    top_mm: float = 680.0,
    radius_mm: float = 12.0,
    sway_mm: float = 30.0,
) -> Hulls:
    """Hangs from ``top_mm`` to ``z_mm``, where it is half as thick; a quarter of a wave aside."""
    parts = [step / PIECES for step in range(PIECES + 1)]
    points = [
        (x_mm + sway_mm * math.sin(2.2 * part), y_mm, top_mm + part * (z_mm - top_mm))
        for part in parts
    ]
    return chain(points, [radius_mm * (1.0 - 0.5 * part) for part in parts])


# what every kind takes beside its shape
LOOK = ("temperature", "offset_k", "albedo", "gloss", "emissivity")
KINDS: dict[str, tuple[Callable[..., Hulls], tuple[Warmth, float, float, float, float]]]
KINDS = {
    "cold_teat": (_cold_teat, ("ambient", 0.0, 0.07, 0.05, 0.95)),
    "hot_cup": (_hot_cup, ("teat", 1.0, 0.7, 0.1, 0.94)),
    "warm_arm": (_warm_arm, ("teat", 0.6, 0.35, 0.02, 0.98)),
    "cooler_body": (_cooler_body, ("teat", -5.0, 0.3, 0.02, 0.97)),
    "ball": (_ball, ("teat", -5.0, 0.3, 0.02, 0.97)),
    "rod": (_rod, ("ambient", 0.0, 0.1, 0.0, 0.95)),
    "straw": (_straight, ("ambient", 0.0, 0.45, 0.03, 0.95)),
    "pipe": (_pipe, ("teat", 2.0, 0.4, 0.1, 0.9)),
    "hose": (_hose, ("ambient", 0.0, 0.06, 0.05, 0.95)),
    "leg": (_leg, ("teat", -5.0, 0.3, 0.0, 0.98)),
    "tail": (_tail, ("teat", -7.0, 0.15, 0.0, 0.98)),
}


_shape_of = cache(inspect.signature)


def parameters(kind: str) -> tuple[str, ...]:
    """The parameters that a kind takes. Raises ValueError for a kind that isn't known."""
    check_known("kind of object", kind, KINDS)
    return (*_shape_of(KINDS[kind][0]).parameters, *LOOK)


def make_object(kind: str, **params: Any) -> SceneObject:
    """An object by name. Raises ValueError with the wrong parameter and the likely one."""
    names = parameters(kind)
    for name, value in params.items():
        check_known(f"parameter of {kind}", name, names)
        if name == "temperature" and isinstance(value, str):
            check_known(f"temperature of {kind} (besides degC)", value, ("teat", "ambient"))
        elif type(value) not in (int, float) or not math.isfinite(value):
            raise ValueError(f"{kind}: {name} must be a finite number, is {value!r}")
    shape, usual = KINDS[kind]
    look: dict[str, Any] = dict(zip(LOOK, usual, strict=True))
    look |= {name: params.pop(name) for name in LOOK if name in params}
    warmth, offset_k = look.pop("temperature"), look.pop("offset_k")
    try:
        return SceneObject(kind, shape(**params), Paint(**look), warmth, offset_k)
    except ValueError as fault:
        raise ValueError(f"{kind}: {fault}") from fault


def check_known(what: str, name: str, names: Iterable[str]) -> None:
    """Raises ValueError with the likely name where ``name`` is none of ``names``."""
    known = list(names)
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        raise ValueError(f"{name!r} is no {what}{hint} Known: {', '.join(known)}")
