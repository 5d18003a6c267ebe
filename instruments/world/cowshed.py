"""Families of scenes with what a cowshed shows and the thesis's six leave out: quarters of unlike
warmth, a warm room.

Ranges are our choice where no source is named.
"""

from __future__ import annotations

from dataclasses import replace

from instruments.world.draws import Draw, plain, udder
from instruments.world.setups import Situation


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
