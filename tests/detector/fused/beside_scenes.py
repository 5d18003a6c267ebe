"""Scenes of lines beside teats: upright rods and posts far behind, an edge of which lies in one
optical picture within some pixels of a teat's own, inside or outside, and in the other does not.
"""

from __future__ import annotations

from dataclasses import replace

from instruments.world.draws import Draw, plain, udder
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom
from instruments.world.setups import EYES_MM, Situation, situation_faults
from instruments.world.situations import ATTEMPTS

NAME = "beside"
FEWER = 0.3  # the share of further teats that have none


def beside_scene(k: int) -> Situation:
    """The k-th: one teat to four, and behind most an upright thing as warm as they or cooler."""
    for attempt in range(ATTEMPTS):
        found = replace(_drawn(Draw(NAME, k, attempt)), name=NAME, seed=k)
        if not situation_faults(found):
            return found
    raise RuntimeError(f"nothing that can be set up was found for {NAME} {k}")


def _drawn(draw: Draw) -> Situation:
    phantom = udder(draw, lean_deg=(0.0, 6.0))
    phantom = Phantom(phantom.teats[: draw.count(1, len(phantom.teats))])
    things = list[SceneObject]()
    for end, teat in zip(phantom.ends_mm.tolist(), phantom.teats, strict=True):
        if things and draw.chance(FEWER):
            continue
        eye_x, eye_y, _ = draw.one_of(*EYES_MM[:2])
        rod = draw.each(
            "rod", y_mm=(80.0, 300.0), radius_mm=(3.0, 30.0), height_mm=(20.0, 200.0),
            albedo=(0.04, 0.6),
        )  # fmt: skip
        edge = draw.either() * (teat.shape.radius_mm + draw.between("rod_beside_mm", -2.0, 4.0))
        share = (end[1] + rod["y_mm"] - eye_y) / (end[1] - eye_y)
        rod["x_mm"] = eye_x + (end[0] + edge - eye_x) * share + draw.either() * rod["radius_mm"]
        rod["y_mm"] += end[1]
        rod["height_mm"] += end[2]
        warmth = {"temperature": "teat", "offset_k": -draw.between("rod_cooler_k", 0.0, 12.0)}
        things.append(make_object("rod", **rod, **warmth))
    return plain(draw, phantom, *things)
