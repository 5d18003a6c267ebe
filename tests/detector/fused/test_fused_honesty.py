"""Are the stated covariances honest? Normalised squared errors against chi-square, on two members
of each of the first eleven families.

The scenes are rendered by the bench's own renderer, which shares no code with the detector; the
path-traced ones are next door.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import rig_renderer, warm
from bench.scoring.matching import gate_mm, match
from detector.calibration import ParameterCovariance
from detector.fused.detector import FusedDetector
from detector.protocol import Detection
from instruments.world.situations import SITUATIONS, situation

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]
SEEDS = (100, 101)
# those of a cowshed are counted in campaigns
FAMILIES = tuple(SITUATIONS)[:11]


@dataclass(frozen=True)
class Taken:
    """A frame set made of arrays."""

    left: NDArray[Any]
    right: NDArray[Any]
    thermal: NDArray[Any] | None
    thermal_k: NDArray[Any]


@dataclass(frozen=True)
class Seen:
    """An answer on a member of a family, its ends (n, 3) mm, and which of them all cameras see."""

    family: str
    answer: Detection
    ends_mm: Array
    visible: NDArray[np.bool_]


def seen(
    families: tuple[str, ...],
    seeds: tuple[int, ...],
    noise: int = 1,
    change: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray,
) -> Iterator[Seen]:
    """``change``: of both optical pictures."""
    rig = load_rig(find_rig(None))
    renderer = rig_renderer(rig, noise)
    # the scenes are drawn by it: it is exact, and says so
    exact = replace(rig.calibration, covariance=ParameterCovariance((), np.zeros((0, 0))))
    for name in families:
        for seed in seeds:
            state = warm(situation(name, seed))
            taken = renderer.render(state, np.random.default_rng([noise, seed, *name.encode()]))
            left, right = change(taken.left), change(taken.right)
            frames = Taken(left, right, None, taken.thermal_ck / 100.0)
            visible = np.array([row.all() for row in renderer.visible_ends(state)])
            yield Seen(
                name,
                FusedDetector().detect(frames, exact),
                state.phantom.ends_mm,
                visible,
            )


def normalised(one: Seen) -> list[float]:
    """Normalised squared errors of the answers on visible ends, gross errors included."""
    found = np.array([teat.world_mm for teat in one.answer.teats]).reshape(-1, 3)
    pairs = match(found, one.ends_mm, one.visible, gate_mm(one.ends_mm)).pairs
    return [
        squared(found[i] - one.ends_mm[j], one.answer.teats[i].covariance_mm2) for i, j in pairs
    ]


def squared(error: Array, covariance: Array | None) -> float:
    assert covariance is not None
    return float(error @ np.linalg.solve(covariance, error))


@pytest.fixture(scope="module")
def members() -> list[Seen]:
    return list(seen(FAMILIES, SEEDS))


FOUND, FALSE = 312, 6  # 314 and 5 of 327
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


def test_difficult_scenes_keep_nearly_all_their_ends() -> None:
    """Of scenes that were picked because a decision failed on them, so that no rate follows."""
    count = {"visible": 0, "found": 0, "false": 0}
    for family, noise, member in DIFFICULT:
        (one,) = seen((family,), (member,), noise)
        found = np.array([teat.world_mm for teat in one.answer.teats]).reshape(-1, 3)
        counts = match(found, one.ends_mm, one.visible, gate_mm(one.ends_mm)).counts
        count["visible"] += counts.visible
        count["found"] += counts.matched
        count["false"] += counts.false
    assert count["found"] >= FOUND, count
    assert count["false"] <= FALSE, count


@pytest.mark.parametrize(
    ("family", "member"),
    [
        pytest.param("low_contrast", 31011, id="faint ends"),
        pytest.param("low_contrast", 31005, id="hardly an end"),
        pytest.param("hot_body_at_ends", 31014, id="before an arm"),
    ],
)
def test_motion_along_the_teats_is_a_reason(family: str, member: int) -> None:
    """Of 9 px: ends were given 4 mm off with standard deviations of a third of a millimetre."""
    (one,) = seen((family,), (member,), 777, lambda image: cv2.blur(image, (1, 9)))
    assert one.answer.teats == ()
    assert one.answer.reason is not None
    assert "by motion along the columns" in one.answer.reason


def test_motion_across_the_teats_is_a_reason() -> None:
    """Of 9 px: the gap between touching teats looks sharp, and an end was given 93 mm from any."""
    (one,) = seen(("overlapping",), (92010,), 779, lambda image: cv2.blur(image, (9, 1)))
    assert one.answer.teats == ()
    assert one.answer.reason is not None
    assert "by motion along the rows" in one.answer.reason


def test_nothing_false_is_said_of_any_family(members: list[Seen]) -> None:
    every_end_and_none_else(members)


def every_end_and_none_else(members: list[Seen]) -> None:
    for one in members:
        found = np.array([teat.world_mm for teat in one.answer.teats]).reshape(-1, 3)
        counts = match(found, one.ends_mm, one.visible, gate_mm(one.ends_mm)).counts
        assert counts.false == 0, one.family
        assert counts.matched == counts.visible, one.family


TOO_NARROW = pytest.mark.xfail(
    strict=True, reason="the learned factors state too little of these ends: docs/detectors.md"
)


@pytest.mark.parametrize(
    ("family", "noise", "member"),
    [
        pytest.param("cow_teats", 1, 1047, id="one side", marks=TOO_NARROW),
        pytest.param("overlapping", 1, 1032, id="one side, touching"),
        pytest.param(
            "hot_body_at_ends", 999, 60002, id="half an end that sides lead to", marks=TOO_NARROW
        ),
        pytest.param("cooler_bodies", 777, 31219, id="end and side, one picture shows less"),
        pytest.param("cluttered", 1127, 110176, id="a post behind the end disturbs its edges"),
        pytest.param("cluttered", 1127, 110386, id="one side in all pictures, a post before it"),
        pytest.param("wet", 1127, 110095, id="gloss: lines in unlike light"),
    ],
)
def test_what_is_hidden_or_disturbed_of_a_teat_widens_its_covariance(
    family: str, noise: int, member: int
) -> None:
    (one,) = seen((family,), (member,), noise)
    assert max(normalised(one)) < scipy.stats.chi2.ppf(1 - 1e-4, 3)


def test_the_place_between_pixels_shifts_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Upright sides have one place between pixels all along: a shift by it is one of depth."""

    def mean_mm() -> float:
        errors = list[float]()
        for one in seen(("ideal", "warm_room"), (61000, 61001, 61002)):
            found = np.array([teat.world_mm for teat in one.answer.teats])
            pairs = match(found, one.ends_mm, one.visible, gate_mm(one.ends_mm)).pairs
            errors += [float(np.linalg.norm(found[i] - one.ends_mm[j])) for i, j in pairs]
        assert len(errors) == 24
        return float(np.mean(errors))

    without_shift = mean_mm()
    as_found = "detector.fused.detector.unaliased"
    monkeypatch.setattr(as_found, lambda fitted, p: (fitted, np.zeros((len(fitted.teats), 3, 3))))
    assert without_shift < 0.9 * mean_mm()


def test_normalised_squared_errors_are_those_of_honest_covariances(members: list[Seen]) -> None:
    """3 where the covariances are true; more where they are too narrow. Bar-Shalom, Li, Kirubarajan,
    "Estimation with applications", section 5.4.2.
    """
    sums = np.concatenate([normalised(one) for one in members])
    n = len(sums)
    assert n > 80
    assert 2.0 < np.mean(sums) < scipy.stats.chi2.ppf(0.975, 3 * n) / n
    # no end far beyond what is stated of it
    assert np.max(sums) < scipy.stats.chi2.ppf(1 - 0.001 / n, 3)
