"""Families of scenes with what a cowshed shows and the thesis's six leave out: quarters of unlike
warmth, a warm room, straw, legs and a tail.

Ranges are our choice where no source is named.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from instruments.world.draws import Draw, plain, udder
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom
from instruments.world.setups import EYES_MM, Situation, collisions, hidden_ways


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
    """A room nearly as warm as the teats, as in a shed in summer; all that is not heated is as
    warm as the room.
    """
    return replace(plain(draw, udder(draw)), room_c=draw.between("room_c", 26.0, 31.0))


COATS = ((0.03, 0.12), (0.12, 0.35), (0.45, 0.75))  # albedo: black, brown, white
STRAW_MM = 2.5  # radius at most


def straw_and_legs(draw: Draw) -> Situation | None:
    """Straws before the teats, one across each of some, no end hidden; a leg or two and a tail.

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
    return make_object(
        "leg",
        x_mm=draw.between("leg_x_mm", *((-430.0, -190.0), (-140.0, 130.0))[number]),
        y_mm=draw.between("leg_y_mm", 350.0, 620.0),
        share=draw.between("leg_share", 0.85, 1.15),
        lean_deg=draw.between("leg_lean_deg", -5.0, 5.0),
        offset_k=-draw.between("leg_cooler_k", 2.0, 8.0),
        albedo=draw.between("leg_albedo", *COATS[draw.count(0, 2)]),
    )


def _tail(draw: Draw) -> SceneObject:
    return make_object(
        "tail",
        x_mm=draw.between("tail_x_mm", -300.0, 20.0),
        y_mm=draw.between("tail_y_mm", 330.0, 480.0),
        z_mm=draw.between("tail_z_mm", 60.0, 220.0),
        radius_mm=draw.between("tail_radius_mm", 10.0, 18.0),
        sway_mm=draw.between("tail_sway_mm", -50.0, 50.0),
        offset_k=-draw.between("tail_cooler_k", 3.0, 9.0),
        albedo=draw.between("tail_albedo", *COATS[draw.count(0, 2)]),
    )


def _straw(draw: Draw, phantom: Phantom) -> SceneObject:
    """Close before a teat, as the thermal camera sees it, at any angle across it."""
    teat = draw.count(0, len(phantom.teats) - 1)
    below = draw.between("straw_below_mm", 4.0, 90.0)
    on_axis = phantom.ends_mm[teat] - below * phantom.axes[teat]
    sight = np.asarray(EYES_MM[2]) - on_axis
    before = phantom.teats[teat].shape.radius_mm + draw.between("straw_before_mm", 4.0, 25.0)
    x, y, z = (on_axis + before * sight / np.linalg.norm(sight)).tolist()
    length = draw.between("straw_length_mm", 50.0, 170.0)
    rise = draw.between("straw_rise_deg", -85.0, 85.0)
    aside = draw.between("straw_aside", -0.35, 0.35) * length
    return make_object(
        "straw",
        x_mm=x + aside * math.cos(math.radians(rise)),
        y_mm=y,
        z_mm=z + aside * math.sin(math.radians(rise)),
        length_mm=length,
        radius_mm=draw.between("straw_radius_mm", 1.0, STRAW_MM),
        rise_deg=rise,
        turn_deg=draw.between("straw_turn_deg", -25.0, 25.0),
        offset_k=draw.between("straw_offset_k", -0.5, 1.0),
        albedo=draw.between("straw_albedo", 0.25, 0.6),
    )
