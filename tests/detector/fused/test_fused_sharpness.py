"""Pictures of a quality that makes ends unsure: a wider covariance, or a reason; and warmth that
is a teat's own.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.external.serve import Pictures
from detector.fused.detector import FusedDetector
from detector.protocol import Detection
from tests.detector.fused.conftest import Body, Draw, Find

pytestmark = pytest.mark.slow

BODIES = [
    Body(end, (0.05, -0.05))
    for end in ((-255.0, 275.0, 132.0), (-205.0, 200.0, 137.0), (-80.0, 270.0, 134.0))
]


@pytest.fixture(scope="module")
def frames(draw_scene: Draw) -> Pictures:
    return draw_scene(BODIES)


def greatest_sd_mm(found: Detection) -> NDArray[np.float64]:
    """Along the vertical of the world, where a blurred or clipped end is off."""
    assert len(found.teats) == len(BODIES)
    return np.array(
        [np.sqrt(t.covariance_mm2[2, 2]) for t in found.teats if t.covariance_mm2 is not None]
    )


@pytest.mark.parametrize(
    ("sd_px", "says"),
    [((4.0, 0.0), "along the rows"), ((0.0, 4.0), "along the columns"), ((2.0, 2.0), "focus")],
)
def test_blurred_pictures_are_a_reason(
    frames: Pictures, rig: Calibration, sd_px: tuple[float, float], says: str
) -> None:
    blurred = [
        cv2.GaussianBlur(picture, (0, 0), max(sd_px[0], 1e-3), sigmaY=max(sd_px[1], 1e-3))
        for picture in (frames.left, frames.right)
    ]
    found = FusedDetector().detect(replace(frames, left=blurred[0], right=blurred[1]), rig)
    assert found.teats == ()
    assert found.reason is not None
    assert "blurred" in found.reason
    assert says in found.reason


def test_shade_that_fades_towards_all_ends_is_no_blur(find: Find) -> None:
    """Lit from above before a wall as bright: the last 3 mm go from dark to nearly the wall's grey."""
    shaded = [
        replace(body, end_mm=(*body.end_mm[:2], body.end_mm[2] - low), grey=150.0 - 40.0 * low)
        for body in BODIES
        for low in np.arange(0.0, 3.01, 0.3)
    ]
    answer = find(shaded)
    assert len(answer.teats) == len(BODIES), answer.reason


def test_clipped_and_slightly_blurred_pictures_widen_covariances(
    frames: Pictures, rig: Calibration
) -> None:
    def sd_mm(change: object) -> NDArray[np.float64]:
        left, right = (change(each) for each in (frames.left, frames.right))  # type: ignore[operator]
        return greatest_sd_mm(FusedDetector().detect(replace(frames, left=left, right=right), rig))

    plain = sd_mm(lambda picture: picture)
    clipped = sd_mm(lambda picture: np.minimum(2.0 * picture, 255.0).astype(np.uint8))
    blurred = sd_mm(lambda picture: cv2.GaussianBlur(picture, (0, 0), 1.2))
    assert (clipped > 1.7 * plain).all()
    assert (blurred > 1.2 * plain).all()


def test_a_cool_quarter_is_a_teat_and_a_cold_thing_of_its_shape_is_left_out(find: Find) -> None:
    """9 K cooler than the others; 18 K cooler, and colder than the room."""
    cool, cold = ([replace(BODIES[0], kelvin=warmth), *BODIES[1:]] for warmth in (296.5, 287.0))
    assert len(find(cool).teats) == 3
    answer = find(cold)
    assert len(answer.teats) == 2
    assert "it isn't as warm as a teat all over" in str(answer.reason)
