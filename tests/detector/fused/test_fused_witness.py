"""Cameras that disagree: a reason in place of ends, or a covariance that covers it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.campaign.perturbations import Applied
from detector.calibration import Calibration, ParameterCovariance
from detector.external.serve import Pictures
from detector.fused.detector import FusedDetector
from tests.detector.fused.conftest import Body, Draw

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames(draw_scene: Draw) -> Pictures:
    ends = [(-255.0, 275.0, 132.0), (-205.0, 200.0, 137.0), (-80.0, 270.0, 134.0)]
    return draw_scene([Body(end, (0.05, -0.05)) for end in ends])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("vergence=0.1", "thermal against optical"),
        ("vergence=-0.1", "thermal against optical"),
        ("column=2", "thermal against optical"),
        ("row=1", "rows of left and right"),
        ("thermal-pose=0.3", "thermal against optical"),
        ("thermal-pose=-0.5", "thermal against optical"),
    ],
)
def test_cameras_that_disagree_are_a_reason(
    frames: Pictures, rig: Calibration, change: str, says: str
) -> None:
    found = FusedDetector().detect(frames, Applied.parse(change).stated(rig))
    assert found.teats == ()
    assert found.reason is not None
    assert found.reason.startswith("cameras disagree by ")
    assert says in found.reason
    exact = replace(rig, covariance=ParameterCovariance((), np.zeros((0, 0))))
    assert says in str(FusedDetector().detect(frames, Applied.parse(change).stated(exact)).reason)


def test_light_that_hides_the_same_side_of_all_teats_is_not_the_cameras(
    draw_scene: Draw, rig: Calibration
) -> None:
    """Both optical pictures show the teats without their last 3 mm, the thermal one whole."""
    ends = np.array([(-255.0, 275.0, 132.0), (-205.0, 200.0, 137.0), (-80.0, 270.0, 134.0)])
    whole = [Body((x, y, z), (0.05, -0.05)) for x, y, z in ends.tolist()]
    lit = [
        replace(body, end_mm=(body.end_mm[0] - 1.5, *body.end_mm[1:]), radius_mm=9.5, seen_by="LR")
        for body in whole
    ]
    exact = replace(rig, covariance=ParameterCovariance((), np.zeros((0, 0))))
    seen = draw_scene([*lit, *(replace(body, seen_by="T") for body in whole)])
    found = FusedDetector().detect(seen, exact)
    assert len(found.teats) == 3, found.reason
    for teat in found.teats:
        off = teat.world_mm - ends[np.linalg.norm(ends - teat.world_mm, axis=1).argmin()]
        assert teat.covariance_mm2 is not None
        assert off @ np.linalg.solve(teat.covariance_mm2, off) < 11.345
        assert np.sqrt(np.linalg.eigvalsh(teat.covariance_mm2)[-1]) < 5.0


def test_a_calibration_that_states_so_much_may_be_off_by_it(
    frames: Pictures, rig: Calibration
) -> None:
    named = (("right", "cx"), ("right", "cy"))
    loose = replace(rig, covariance=ParameterCovariance(named, np.diag([1.0, 1.0])))
    assert len(FusedDetector().detect(frames, Applied("row", 1.0).stated(loose)).teats) == 3


@pytest.mark.parametrize("change", ["column=0", "column=0.5", "column=-0.5", "focal=0.2"])
def test_a_small_fault_is_covered_by_what_is_stated(
    frames: Pictures, rig: Calibration, change: str
) -> None:
    """Half a pixel is below what 160 x 120 thermal pixels tell."""
    found = FusedDetector().detect(frames, Applied.parse(change).stated(rig))
    ends = np.array([(-255.0, 275.0, 132.0), (-205.0, 200.0, 137.0), (-80.0, 270.0, 134.0)])
    assert len(found.teats) == 3
    for teat in found.teats:
        off = teat.world_mm - ends[np.linalg.norm(ends - teat.world_mm, axis=1).argmin()]
        assert teat.covariance_mm2 is not None
        sd = np.sqrt(np.linalg.eigvalsh(teat.covariance_mm2)[-1])
        assert sd > 1.0
        assert np.linalg.norm(off) < 4.0 * sd
