"""Families of scenes with what a cowshed shows and the thesis's six leave out: quarters of unlike
warmth, a warm room, straw, legs and a tail, teats of a cow, wet skin, pipes and hoses; teats that
point outward, a swollen quarter, liners, and rods beside a teat's edge.

Ranges are our choice where no source is named.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from instruments.world.draws import PLACES, Draw, footing, plain, shape, udder
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom, Spots, Teat, TeatForm, TeatShape, Udder
from instruments.world.setups import EYES_MM, Situation, collisions, hidden_ways
from instruments.world.shading import Paint


def cool_quarters(draw: Draw) -> Situation:
    """The warmest quarter is as warm as the water makes it, each other up to 5 K cooler.

    Quarters differ by up to 3.0 K in the mean with inflammation alone (33.2 to 36.2 degC; Colak et
    al., J. Dairy Sci. 91, 2008, 4244); wind, wetness and blood flow add to it, 5 K is our choice.
    """
    found = plain(draw, udder(draw))
    warmest = draw.count(0, len(found.phantom.teats) - 1)
    cooler_k = [draw.between("quarter_cooler_k", 0.0, 5.0) for _ in found.phantom.teats]
    cooler_k[warmest] = 0.0
    return replace(found, cooler_k=tuple(cooler_k))


def warm_room(draw: Draw) -> Situation:
    """A room nearly as warm as the teats, as in a shed in summer, with all that isn't heated."""
    return replace(plain(draw, udder(draw)), room_c=draw.between("room_c", 26.0, 31.0))


COATS = ((0.03, 0.12), (0.12, 0.35), (0.45, 0.75))  # albedo: black, brown, white
STRAW_MM = 2.5  # radius at most


def straw_and_legs(draw: Draw) -> Situation | None:
    """Straws before the teats, across some of them, hardly an end hidden; a leg or two and a tail.

    Legs and tail are cooler than teats: bare skin of the udder is the warmest outside of a cow, by
    2 to 9 K in a shed (our choice); coat has an emissivity of 0.98. Straw is as warm as the air, a
    stalk 2 to 5 mm across.
    """
    phantom = udder(draw, lean_deg=(0.0, 4.0))
    straws = tuple(_straw(draw, phantom) for _ in range(draw.count(2, 5)))
    alone = Situation("", 0, "", phantom, straws)
    low = min(min(hull.a_mm[2], hull.b_mm[2]) for each in straws for hull in each.hulls)
    if low < STRAW_MM or any(collisions(alone)) or hidden_ways(alone).any():
        return None
    legs = tuple(_leg(draw, number) for number in range(draw.count(1, 2)))
    tail = (_tail(draw),) if draw.chance(0.6) else ()
    return plain(draw, phantom, *straws, *legs, *tail)


def _leg(draw: Draw, number: int) -> SceneObject:
    """The first to the left of the other."""
    leg = draw.each(
        "leg", x_mm=((-430.0, -190.0), (-140.0, 130.0))[number], y_mm=(350.0, 620.0),
        share=(0.85, 1.15), lean_deg=(-5.0, 5.0), cooler_k=(2.0, 8.0),
    )  # fmt: skip
    return make_object("leg", **_coated(draw, "leg", leg))


def _tail(draw: Draw) -> SceneObject:
    tail = draw.each(
        "tail", x_mm=(-300.0, 20.0), y_mm=(330.0, 480.0), z_mm=(60.0, 220.0),
        radius_mm=(10.0, 18.0), sway_mm=(-50.0, 50.0), cooler_k=(3.0, 9.0),
    )  # fmt: skip
    return make_object("tail", **_coated(draw, "tail", tail))


def _coated(draw: Draw, name: str, limb: dict[str, float]) -> dict[str, float]:
    """Cooler than the teats, and of a coat."""
    limb["offset_k"] = -limb.pop("cooler_k")
    return limb | draw.each(name, albedo=draw.one_of(*COATS))


def _straw(draw: Draw, phantom: Phantom) -> SceneObject:
    """Close before a teat, as the thermal camera sees it, at any angle across it."""
    teat = draw.count(0, len(phantom.teats) - 1)
    below, before = draw.each("straw", below_mm=(4.0, 90.0), before_mm=(4.0, 25.0)).values()
    on_axis = phantom.ends_mm[teat] - below * phantom.axes[teat]
    sight = np.asarray(EYES_MM[2]) - on_axis
    before = phantom.teats[teat].shape.radius_mm + before
    x, y, z = (on_axis + before * sight / np.linalg.norm(sight)).tolist()
    straw = draw.each("straw", length_mm=(50.0, 170.0), rise_deg=(-85.0, 85.0))
    rise = math.radians(straw["rise_deg"])
    aside = draw.between("straw_aside", -0.35, 0.35) * straw["length_mm"]
    straw |= {"x_mm": x + aside * math.cos(rise), "y_mm": y, "z_mm": z + aside * math.sin(rise)}
    look = draw.each(
        "straw", radius_mm=(1.0, STRAW_MM), turn_deg=(-25.0, 25.0), offset_k=(-0.5, 1.0),
        albedo=(0.25, 0.6),
    )  # fmt: skip
    return make_object("straw", **straw, **look)


# of barrels as breeders class them: radius at the base, and near the end, as shares of the barrel's
BASE = {"cylinder": (1.0, 1.12), "funnel": (1.2, 1.45), "bottle": (0.78, 0.92)}
NEAR_END = {"cylinder": (0.92, 1.0), "funnel": (0.70, 0.85), "bottle": (1.04, 1.18)}


def cow_teats(draw: Draw) -> Situation:
    """Teats of a cow's length and shape on a warm udder, each end 0 to 2.5 K cooler than its base.

    Lengths of 35 to 70 mm are our choice for dairy cows (Zwertvaegher et al., J. Dairy Sci.
    95, 2012: front teats longer and wider than hind ones), barrels 18 to 27 mm across. A quarter of
    ends is round, half flat within a round rim, a quarter pointed (after Appleman, J. Dairy Sci.
    56, 1973, 411; his discs count as flat, his cones as pointed: a dish hides its own apex). Bends
    of 0 to 12 degrees, leans and the udder are our choice. The end is where the axis leaves it.
    """
    foot_mm = footing(draw, (28.0, 42.0), (52.0, 75.0), (30.0, 48.0))
    height = draw.between("udder_mm", 60.0, 88.0)
    feet = tuple(foot_mm(*place) for place in PLACES)
    teats = tuple(_teat(draw, foot, height) for foot in feet)
    found = plain(draw, Phantom(teats, udder=Udder(feet, height)))
    # an udder faces up, to lamps and ceiling, and gets twice a teat's light
    paint = replace(found.teat_paint, albedo=0.65 * found.teat_paint.albedo)
    cooler_k = draw.between("ends_cooler_k", 0.0, 2.5)
    return replace(found, teat_paint=paint, ends_cooler_k=cooler_k)


def _teat(draw: Draw, foot_mm: tuple[float, float], height_mm: float) -> Teat:
    """Out of the udder there, where that is so high."""
    long, radius = draw.each("teat", length_mm=(35.0, 70.0), radius_mm=(9.0, 13.5)).values()
    lean = math.radians(draw.between("lean_deg", 0.0, 12.0))
    way = draw.between("lean_way_rad", 0.0, 2.0 * math.pi)
    slope = math.tan(lean) * math.cos(way), math.tan(lean) * math.sin(way)
    base = foot_mm[0] - slope[0] * height_mm, foot_mm[1] - slope[1] * height_mm
    whole_mm = height_mm * math.hypot(1.0, *slope) + long
    shape = TeatShape(whole_mm, radius, _form(draw, long, radius))
    return Teat(base, shape, (math.atan(slope[0]), math.atan(slope[1])))


def _form(draw: Draw, long_mm: float, radius_mm: float) -> TeatForm:
    """Of a teat that stands out so far, its foot 12 mm within the udder. A pointed end is half an
    ellipsoid; the barrel's radius is a quadratic curve from there to the base.
    """
    kind, end = draw.one_of(*BASE), draw.one_of("round", "flat", "flat", "pointed")
    base = radius_mm * draw.between("base_share", *BASE[kind])
    last = radius_mm * draw.between("end_share", *NEAR_END[kind])
    flat = last * draw.between("flat_share", 0.5, 0.75) if end == "flat" else 0.0
    tall = last * (draw.between("point_share", 1.25, 1.8) if end == "pointed" else 1.0)
    focus2 = tall**2 - last**2
    balls = [(tall, last)]
    if focus2:
        aways = np.linspace(focus2 / tall, 0.0, 5)
        balls = [(tall - away, last * math.sqrt(1.0 - away**2 / focus2)) for away in aways]
    start = balls[-1][0]
    for part in np.linspace(0.0, 1.0, 6)[1:].tolist():
        radius = (1.0 - part) ** 2 * last + 2.0 * part * (1.0 - part) * radius_mm + part**2 * base
        balls.append((start + part * (long_mm - start), radius))
    balls.append((long_mm + 12.0, 1.15 * base))
    bend = math.radians(draw.between("bend_deg", 0.0, 12.0)) / long_mm
    way = draw.between("bend_way_rad", 0.0, 2.0 * math.pi)
    return TeatForm(tuple((float(at), float(r)) for at, r in balls), flat, bend, way)


WATER = Paint(albedo=0.04, gloss=0.9, emissivity=0.96, gloss_exponent=300.0)
DIRT = Paint(albedo=0.09, gloss=0.0, emissivity=0.95), Paint(0.45, 0.0, 0.94)  # muck, dried clay
BARE_MM = 6.0  # from the end, where neither drop nor dirt hides it


def wet(draw: Draw) -> Situation:
    """Wet teats: narrow highlights, darker paint, drops and dirt, and skin that evaporation cools.

    A film at 33 degC in a room of 20 degC and 60 % humidity loses some 60 K times the coefficient
    of convection (Lewis relation, 16.5 K/kPa): 200 to 700 W/m2 for 3 to 12 W/(m2 K). The phantom's
    water heats skin by some 200 W/(m2 K), so that it is 1 to 4 K cooler; its end up to 3 K more
    than its base (our choice). Water has an emissivity of 0.96. A film takes 10 to 40 % of the
    light (Lekner and Dorf, Applied Optics 27, 1988).
    """
    found = plain(draw, udder(draw, lean_deg=(0.0, 5.0)))
    film = draw.each(
        "wet", albedo_share=(0.6, 0.9), gloss=(0.15, 0.9), emissivity=(0.955, 0.98),
        gloss_exponent=(60.0, 400.0),
    )  # fmt: skip
    paint = Paint(found.teat_paint.albedo * film.pop("albedo_share"), **film)
    drop_mm, cooler_k = draw.between("drop_mm", 0.9, 2.2), draw.between("wet_cooler_k", 1.0, 4.0)
    drops = _scattered(draw, draw.count(4, 16), (0.7 * drop_mm, drop_mm))
    dirt = [_scattered(draw, draw.count(0, 5), (4.0, 8.5)) for _ in DIRT]
    spots = (
        Spots("drops", WATER, drops, 0.6 * drop_mm, draw.between("drop_cooler_k", 0.0, 1.5)),
        *(Spots("dirt", *each, 0.6) for each in zip(DIRT, dirt, strict=True)),
    )
    return replace(
        found,
        phantom=replace(found.phantom, spots=tuple(each for each in spots if each.places)),
        teat_paint=paint,
        cooler_k=(cooler_k,) * len(found.phantom.teats),
        ends_cooler_k=draw.between("ends_cooler_k", 0.0, 3.0),
    )


def _scattered(
    draw: Draw, most: int, radius_mm: tuple[float, float]
) -> tuple[tuple[int, float, float, float], ...]:
    """Up to so many places on each teat, by a seed of their own."""
    rng = np.random.Generator(np.random.PCG64(draw.count(0, 2**31)))
    return tuple(
        (
            teat,
            float(rng.uniform(BARE_MM + radius_mm[1], 100.0)),
            float(rng.uniform(0.0, 2.0 * np.pi)),
            float(rng.uniform(*radius_mm)),
        )
        for teat in range(len(PLACES))
        for _ in range(int(rng.integers(0, most + 1)))
    )


def cluttered(draw: Draw) -> Situation | None:
    """A pipe or two across behind the teats, about as high as their ends, posts behind it, teat
    cups and hoses beside and behind; no end hidden.

    Milk leaves the udder at some 38 degC and wash water is warmer, cold water and steel as cold as
    the room: 10 K cooler to 8 K warmer than the teats (our choice). Bare stainless steel has an
    emissivity of 0.15 to 0.35 and mirrors the room, painted or dirty things 0.85 to 0.96.
    """
    phantom = udder(draw, lean_deg=(0.0, 4.0))
    cups = tuple(_cup(draw) for _ in range(draw.count(0, 2)))
    alone = Situation("", 0, "", phantom, cups)
    if any(collisions(alone)) or hidden_ways(alone).any():
        return None
    pipes = tuple(_pipe(draw, number) for number in range(draw.count(1, 2)))
    posts = tuple(_post(draw) for _ in range(draw.count(0, 3)))
    hoses = tuple(_hose(draw) for _ in range(draw.count(0, 2)))
    return plain(draw, phantom, *cups, *pipes, *posts, *hoses)


def _metal(draw: Draw, name: str) -> dict[str, float]:
    """What pipes and posts look like, bare or painted."""
    bare = draw.chance(0.4)
    return draw.each(
        name,
        offset_k=(-10.0, 8.0),
        albedo=(0.12, 0.65),
        gloss=(0.15, 0.5) if bare else (0.0, 0.1),
        emissivity=(0.15, 0.35) if bare else (0.85, 0.96),
    )


def _pipe(draw: Draw, number: int) -> SceneObject:
    """The second above the first."""
    pipe = draw.each(
        "pipe", x_mm=(-300.0, 50.0), y_mm=(360.0, 450.0),
        z_mm=((90.0, 190.0), (240.0, 330.0))[number], length_mm=(700.0, 1300.0),
        radius_mm=(9.0, 25.0), rise_deg=(-3.0, 3.0), turn_deg=(-4.0, 4.0),
    )  # fmt: skip
    return make_object("pipe", **pipe, **_metal(draw, "pipe"))


def _post(draw: Draw) -> SceneObject:
    post = draw.each(
        "post", x_mm=(-430.0, 160.0), y_mm=(560.0, 900.0), height_mm=(300.0, 900.0),
        radius_mm=(8.0, 24.0),
    )  # fmt: skip
    return make_object("rod", **post, temperature="teat", **_metal(draw, "post"))


def _cup(draw: Draw) -> SceneObject:
    """Of a milking cluster, on the table beside the teats or behind them."""
    cup = draw.each(
        "cup", radius_mm=(22.0, 32.0), x_mm=(-360.0, 120.0), y_mm=(140.0, 330.0),
        height_mm=(90.0, 170.0), foot_share=(0.75, 1.0),
    )  # fmt: skip
    cup["foot_radius_mm"] = cup["radius_mm"] * cup.pop("foot_share")
    return make_object("hot_cup", **cup, **_metal(draw, "cup"))


def _hose(draw: Draw) -> SceneObject:
    """Black rubber, as warm as the room or as what flows in it."""
    hose = draw.each(
        "hose", x_mm=(-330.0, 60.0), y_mm=(490.0, 530.0), z_mm=(40.0, 140.0),
        span_mm=(150.0, 400.0), sag_mm=(60.0, 260.0), radius_mm=(6.0, 12.0), turn_deg=(-3.0, 3.0),
        offset_k=(-10.0, 3.0), albedo=(0.03, 0.2),
    )  # fmt: skip
    return make_object("hose", **hose, temperature="teat")


def outward(draw: Draw) -> Situation:
    """Teats that point away from the udder's middle, by 20 to 40 degrees (our choice)."""
    foot_mm = footing(draw, (18.0, 32.0), (55.0, 80.0), (22.0, 40.0))
    teats = []
    for across, away in PLACES:
        form = shape(draw, (105.0, 140.0), (9.5, 12.5))
        lean = math.radians(draw.between("lean_deg", 20.0, 40.0))
        way = math.atan2(0.6 * away, across) + draw.between("lean_way_rad", -0.5, 0.5)
        slope = math.tan(lean) * math.cos(way), math.tan(lean) * math.sin(way)
        teats.append(Teat(foot_mm(across, away), form, (math.atan(slope[0]), math.atan(slope[1]))))
    return plain(draw, Phantom(tuple(teats)))


def swollen(draw: Draw) -> Situation:
    """One quarter's teat is swollen: wider at its end, wider still at its base, and warmer."""
    phantom = udder(draw, lean_deg=(0.0, 5.0))
    which = draw.count(0, len(phantom.teats) - 1)
    size = draw.each("swollen", end_mm=(13.5, 16.5), base_mm=(18.0, 24.0), warmer_k=(0.0, 2.0))
    long_mm, (end, base) = phantom.teats[which].shape.length_mm, (size["end_mm"], size["base_mm"])
    form = TeatForm(((end, end), (0.4 * long_mm, 0.5 * (end + base)), (long_mm - 1.3 * base, base)))
    teats = list(phantom.teats)
    teats[which] = replace(teats[which], shape=TeatShape(long_mm, end, form))
    cooler_k = [size["warmer_k"]] * len(teats)
    cooler_k[which] = 0.0
    return replace(plain(draw, Phantom(tuple(teats))), cooler_k=tuple(cooler_k))


def liners(draw: Draw) -> Situation | None:
    """Liners of a cluster upright behind and beside the teats, their rims level with the ends, and
    a hose: black rubber, nearly as warm as a teat. Or domes as wide as no teat.
    """
    phantom = udder(draw, lean_deg=(0.0, 4.0))
    level = float(phantom.ends_mm[:, 2].mean())
    things = list[SceneObject]()
    for _ in range(draw.count(1, 4)):
        at = draw.each(
            "liner", x_mm=(-330.0, 60.0), y_mm=(300.0, 520.0), height_mm=(-30.0, 25.0),
            radius_mm=(13.0, 21.0), offset_k=(-4.0, 3.0), albedo=(0.03, 0.5),
        )  # fmt: skip
        at["height_mm"] += level
        if draw.chance(0.3):
            at["top_radius_mm"] = at["radius_mm"] = at["radius_mm"] + 6.0
            things.append(make_object("cooler_body", **at))
        else:
            things.append(make_object("rod", **at, temperature="teat"))
    if draw.chance(0.5):
        things.append(_hose(draw))
    found = plain(draw, phantom, *things)
    return None if any(collisions(found)) or hidden_ways(found).any() else found


def rods(draw: Draw) -> Situation | None:
    """One teat to four, and behind some an upright rod, post or leg's edge that one camera sees
    beside the teat's own.
    """
    phantom = udder(draw, lean_deg=(0.0, 6.0))
    phantom = Phantom(phantom.teats[: draw.count(1, len(phantom.teats))])
    things = list[SceneObject]()
    for end, teat in zip(phantom.ends_mm.tolist(), phantom.teats, strict=True):
        if things and draw.chance(0.5):
            continue
        eye_x, eye_y, _ = draw.one_of(*EYES_MM[:2])
        rod = draw.each(
            "rod", y_mm=(40.0, 300.0), x_mm=(-3.0, 3.0), radius_mm=(3.0, 14.0),
            height_mm=(-40.0, 200.0), albedo=(0.04, 0.6),
        )  # fmt: skip
        side, edge = draw.either(), teat.shape.radius_mm + draw.between("rod_beside_mm", -3.0, 6.0)
        share = (end[1] + rod["y_mm"] - eye_y) / (end[1] - eye_y)
        rod["x_mm"] += eye_x + (end[0] + side * edge - eye_x) * share + side * rod["radius_mm"]
        rod["y_mm"] += end[1]
        rod["height_mm"] += end[2]
        warm = {"temperature": "teat", "offset_k": -draw.between("rod_cooler_k", 0.0, 12.0)}
        things.append(make_object("rod", **rod, **warm))
    alone = Situation("", 0, "", phantom, tuple(things))
    return None if any(collisions(alone)) else plain(draw, phantom, *things)
