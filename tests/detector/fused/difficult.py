"""Scenes of the bench's own renderer, and those on which decisions of the detector failed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.rig.scenes import warm
from instruments.world.scene import Renderer
from instruments.world.situations import situation


class Rendered(NamedTuple):
    """Pictures, ends (n, 3) mm, and which of them all cameras see."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    thermal_k: NDArray[np.float64]
    ends_mm: NDArray[np.float64]
    visible: NDArray[np.bool_]


def rendered(renderer: Renderer, family: str, noise: int, member: int) -> Rendered:
    """A member of a family by a renderer of that noise."""
    state = warm(situation(family, member))
    taken = renderer.render(state, np.random.default_rng([noise, member, *family.encode()]))
    visible = np.array([row.all() for row in renderer.visible_ends(state)])
    thermal_k = taken.thermal_ck / 100.0
    return Rendered(taken.left, taken.right, thermal_k, state.phantom.ends_mm, visible)


# family, noise, member: scenes on which earlier decisions failed, and on what
DIFFICULT = (
    ("cow_teats", 1, 1003),  # short teats
    ("cow_teats", 1, 1008),  # flat and pointed ends
    ("hot_body_at_ends", 1, 1007),  # an end 15 mm and more up its sides
    ("hot_body_at_ends", 1, 20142),  # an end 40 mm up its sides
    ("hot_body_at_ends", 1, 20082),  # one side, warm on both
    ("hot_body_at_ends", 1, 21010),  # shaded ends that are no blur
    ("cooler_bodies", 1, 20147),  # a whole end, a side in one picture only
    ("overlapping", 1, 20088),  # one side, near and sure
    ("straw_and_legs", 1, 20081),  # a cold straw across a teat
    ("straw_and_legs", 1, 21137),  # a straw across an end too
    ("straw_and_legs", 1, 388),  # half an end and no warm side
    ("overlapping", 1, 566),  # a gap between teats before an arm
    ("cow_teats", 1, 31046),  # a funnel's narrow end
    ("anywhere", 1, 30002),  # an end far from the others, clear in all pictures
    ("cluttered", 1, 20005),  # a hose behind the udder
    ("cluttered", 1, 62),  # a hose 240 mm from the nearest end
    ("cluttered", 1, 747),  # a bent hose, clear in all pictures
    ("cluttered", 1, 30068),  # many starts about one teat
    ("anywhere", 1, 31065),  # an end far from the others, clear in the optical ones
    ("hot_body_at_ends", 1, 31022),  # an end that only the thermal picture shows
    ("hot_body_at_ends", 1, 31135),  # half an end of a fit that is close and warm
    ("hot_body_at_ends", 1, 52072),  # one teat's shaded end is no blur
    ("cooler_bodies", 1, 31010),  # more starts
    ("cooler_bodies", 1, 31204),  # nearly a whole end, a side in one picture only
    ("overlapping", 1, 31165),  # one side, less sure, three quarters of an end
    ("overlapping", 1, 31084),  # more fits
    ("low_contrast", 1, 52084),  # one side, less sure, warm all round
    ("anywhere", 777, 31258),  # a whole end, one line of it warm
    ("missing_or_hidden", 999, 61005),  # a whole end, one line of it cold
    ("overlapping", 777, 31312),  # a short teat's whole end, hardly a side
    ("anywhere", 999, 61025),  # an end that one optical picture shows
    ("hot_body_at_ends", 999, 61025),  # most of an end in the thermal picture
    ("cooler_bodies", 999, 61032),  # one side, warm on both
    ("hot_body_at_ends", 999, 60034),  # a nomination's fourth best depth
    ("hot_body_at_ends", 777, 31212),  # an end where both sides stop and bend
    ("cluttered", 999, 60100),  # an end slid to where the sides stop
    ("hot_body_at_ends", 777, 31336),  # four ends that may be too high or low
    ("anywhere", 999, 62054),  # half an end that sides lead to, closely
    ("cool_quarters", 20261128, 500007),  # a cool quarter beside a warm one
    ("cooler_bodies", 20261128, 500428),  # a whole end and one whole side
    ("cooler_bodies", 20261128, 500284),  # a short end, mostly warm, no side
    ("cooler_bodies", 20261128, 500421),  # close, a side in one picture only
    ("hot_body_at_ends", 20261129, 600445),  # two of four ends shaded
    ("low_contrast", 20261129, 600489),  # four shaded ends that are no blur
    ("cooler_bodies", 20261129, 601099),  # two thermal outlines elsewhere
    ("cluttered", 20261129, 600515),  # a hose as hot as no teat
    ("cooler_bodies", 1111, 71146),  # whole end, both sides in warmth only
    ("cooler_bodies", 1111, 71172),  # end and sides whole in warmth only
    ("overlapping", 1111, 70248),  # a whole end, one side in one picture
    ("cool_quarters", 20261130, 700638),  # the warmest quarter, a side in part
    ("cow_teats", 1111, 70098),  # a shape whose edges fit nothing closely
    ("low_contrast", 1114, 80092),  # a dark and a bright side: no motion
    ("cooler_bodies", 1114, 80574),  # most of the end, a side in warmth only
    ("low_contrast", 1114, 80345),  # half the end, the outline in warmth
    ("cooler_bodies", 1114, 80580),  # both sides lead to it in one picture
    ("overlapping", 1114, 80725),  # a whole end at an unsure place
    ("missing_or_hidden", 1115, 83176),  # something cold before one side
    ("missing_or_hidden", 1115, 83389),  # one cold line of a whole end
    ("hot_body_at_ends", 1115, 83031),  # half an end before a warm arm
    ("anywhere", 777, 31080),  # a cold gap between two warm teats
    ("cooler_bodies", 777, 31270),  # sides that lead to half an end
    ("hot_body_at_ends", 999, 60005),  # sides that lead to an arm's rim
    ("missing_or_hidden", 999, 60104),  # a side and two thirds, not close
    ("anywhere", 20261128, 500207),  # sides that go on beyond half an end
    ("cluttered", 999, 60054),  # a hose 290 mm from the nearest end, not warm
    ("missing_or_hidden", 1111, 71012),  # warmth beyond it all round, not close
    ("overlapping", 1111, 71069),  # warmth beyond it all round, closely
    ("overlapping", 1112, 72129),  # one side, neither it nor an end warm
    ("cooler_bodies", 1111, 71024),  # half an end, a side in one picture only
    ("cooler_bodies", 1111, 71176),  # half an end at an unsure place
    ("cow_teats", 1111, 71219),  # half way down a teat, no warm end
    ("hot_body_at_ends", 20261129, 600776),  # half an end, nothing of it warm
    ("hot_body_at_ends", 20261129, 600981),  # an end that isn't warm, not close
    ("cooler_bodies", 1113, 73122),  # two thirds of a thermal end alone
    ("missing_or_hidden", 20261130, 700379),  # half an end with faint sides
    ("overlapping", 20261130, 700939),  # a side in one picture, nothing warm
    ("anywhere", 20261202, 900229),  # a fifth end, whole
    ("cluttered", 20261202, 900505),  # a fifth end, both sides
    ("hot_body_at_ends", 20261202, 900794),  # a fifth end before an arm
    ("missing_or_hidden", 20261204, 1101153),  # of which little says where it is
    ("cooler_bodies", 20261206, 1300645),  # a quarter of an end, closely
    ("overlapping", 20261206, 1300322),  # a whole end, nothing of it warm
    ("overlapping", 20261207, 1400255),  # a whole end of which a third is warm
    ("missing_or_hidden", 20261207, 1400364),  # a side in one picture, no other
    ("cow_teats", 20261206, 1300413),  # a side of a short teat, no warm end
)
