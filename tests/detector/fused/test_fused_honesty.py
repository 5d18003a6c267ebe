"""Are the stated covariances honest? Normalised squared errors against chi-square, on two members
of each of the first eleven families.

The scenes are rendered by the bench's own renderer, which shares no code with the detector; the
path-traced ones are next door.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from bench.campaign.perturbations import Applied
from bench.report.trials import project_all
from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import rig_renderer
from bench.scoring.matching import gate_mm, match
from detector.calibration import ParameterCovariance
from detector.external.serve import Pictures
from detector.fused.detector import FusedDetector
from detector.protocol import Detection
from instruments.world.situations import SITUATIONS
from tests.detector.fused.difficult import DIFFICULT, rendered

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]
SEEDS = (100, 101)
# those of a cowshed are counted in campaigns
FAMILIES = tuple(SITUATIONS)[:11]


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
            scene = rendered(renderer, name, noise, seed)
            left, right = change(scene.left), change(scene.right)
            frames = Pictures(left, right, None, scene.thermal_k)
            answer = FusedDetector().detect(frames, exact)
            yield Seen(name, answer, scene.ends_mm, scene.visible)


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


@pytest.mark.parametrize(
    ("every", "found", "false"),
    [
        pytest.param(16, 23, 0, id="a sixteenth"),  # 24 and 0 of 24
        pytest.param(1, 318, 3, id="all", marks=pytest.mark.weekly),  # 320 and 2 of 327
    ],
)
def test_difficult_scenes_keep_nearly_all_their_ends(every: int, found: int, false: int) -> None:
    """Of scenes that were picked because a decision failed on them, so that no rate follows."""
    count = {"visible": 0, "found": 0, "false": 0}
    for family, noise, member in DIFFICULT[::every]:
        (one,) = seen((family,), (member,), noise)
        ends_mm = np.array([teat.world_mm for teat in one.answer.teats]).reshape(-1, 3)
        counts = match(ends_mm, one.ends_mm, one.visible, gate_mm(one.ends_mm)).counts
        count["visible"] += counts.visible
        count["found"] += counts.matched
        count["false"] += counts.false
    assert count["found"] >= found, count
    assert count["false"] <= false, count


@pytest.mark.parametrize(
    ("family", "noise", "member", "px", "way"),
    [
        pytest.param("low_contrast", 777, 31011, (1, 9), "columns", id="faint ends"),
        pytest.param("low_contrast", 777, 31005, (1, 9), "columns", id="hardly an end"),
        pytest.param("hot_body_at_ends", 777, 31014, (1, 9), "columns", id="before an arm"),
        pytest.param("overlapping", 779, 92010, (9, 1), "rows", id="touching: a sharp gap"),
    ],
)
def test_motion_is_a_reason(
    family: str, noise: int, member: int, px: tuple[int, int], way: str
) -> None:
    """Ends were given 4 mm off with a third of a millimetre stated, and 93 mm from any end."""
    (one,) = seen((family,), (member,), noise, lambda image: cv2.blur(image, px))
    assert one.answer.teats == ()
    assert f"by motion along the {way}" in str(one.answer.reason)


def test_nothing_false_is_said_of_any_family(members: list[Seen]) -> None:
    for one in members:
        found = np.array([teat.world_mm for teat in one.answer.teats]).reshape(-1, 3)
        counts = match(found, one.ends_mm, one.visible, gate_mm(one.ends_mm)).counts
        assert counts.false == 0, one.family
        assert counts.matched == counts.visible, one.family


def test_a_warm_end_that_is_missed_has_a_sentence() -> None:
    """The thermal picture shows one end faintly: it went missing without a word."""
    (one,) = seen(("straw_and_legs",), (70022,), 3)
    ends_px = project_all(load_rig(find_rig(None)).calibration, one.ends_mm)["thermal"]
    assert ends_px is not None
    found = np.array([teat.world_mm for teat in one.answer.teats]).reshape(-1, 3)
    near = match(found, one.ends_mm, one.visible, gate_mm(one.ends_mm)).pairs
    said = re.findall(r"at thermal \((-?\d+), (-?\d+)\)", one.answer.reason or "")
    for j in np.flatnonzero(one.visible):
        away = [np.hypot(*(ends_px[j] - [float(u), float(v)])) for u, v in said]
        # 30 px of the delivered picture are some 8 of the sensor's, from the end to its middle
        assert j in {of for _, of in near} or min(away, default=np.inf) < 30.0


AN_ARMS_EDGE = pytest.mark.xfail(
    strict=True,
    reason="the sides of two teats lead to an arm's edge, 7 mm up, that bends as an end does and is"
    " as close; what is stated is 1.3 mm",
)


@pytest.mark.parametrize(
    ("family", "noise", "member"),
    [
        pytest.param("cow_teats", 1, 1047, id="one side"),
        pytest.param("cow_teats", 1, 1000, id="a pointed end"),
        pytest.param("swollen", 1, 200, id="either side alone"),
        pytest.param("overlapping", 1, 1032, id="one side, touching"),
        pytest.param(
            "hot_body_at_ends", 999, 60002, id="half an end that sides lead to", marks=AN_ARMS_EDGE
        ),
        pytest.param("cooler_bodies", 777, 31219, id="end and side, one picture shows less"),
        pytest.param("cluttered", 1127, 110176, id="a post behind the end disturbs its edges"),
        pytest.param("cluttered", 1127, 110386, id="one side in all pictures, a post before it"),
        pytest.param("wet", 1127, 110095, id="gloss: lines in unlike light"),
        pytest.param("swollen", 1, 298, id="one side, far from the usual width"),
        pytest.param("rods", 1, 277, id="one side, leaning in depth"),
        pytest.param("cooler_bodies", 1, 295, id="one side, leaning in depth, an arm"),
    ],
)
def test_what_is_hidden_or_disturbed_of_a_teat_widens_its_covariance(
    family: str, noise: int, member: int
) -> None:
    (one,) = seen((family,), (member,), noise)
    assert max(normalised(one)) < scipy.stats.chi2.ppf(1 - 1e-4, 3)


@pytest.mark.parametrize(("family", "member"), [("overlapping", 3004), ("anywhere", 3003)])
def test_short_sides_widen_it_where_the_thermal_camera_is_off(family: str, member: int) -> None:
    """Its pose turned by 0.3 degrees: few fits are left, of which some show little of their sides.
    Ends were 1.2 and 1.8 mm off, six standard deviations.
    """
    rig = load_rig(find_rig(None))
    scene = rendered(rig_renderer(rig, 101), family, 101, member)
    frames = Pictures(scene.left, scene.right, None, scene.thermal_k)
    turned = Applied("thermal-pose", 0.3).stated(replace(rig.calibration, covariance=None))
    one = Seen(family, FusedDetector().detect(frames, turned), scene.ends_mm, scene.visible)
    assert len(one.answer.teats) > 1
    assert max(normalised(one)) < scipy.stats.chi2.ppf(0.99, 3)


@pytest.mark.weekly
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
