"""Frames drawn from the thesis's own tables, and the pictures that its stages make of them, kept in
golden/.

Four teats whose outlines pass through table 4.1's ends of verticals and table 4.2's middles of
horizontals; dark round-ended teats in the optical pictures where section 3.2.2's homographies put
section 4.1.7's ends. `python -m tests.detector.thesis_tables` writes golden/ anew: look at every
picture before it is kept.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration.thesis_rig import HOMOGRAPHY_LEFT, HOMOGRAPHY_RIGHT
from detector.external.serve import Pictures
from detector.thesis.detector import published_homography
from tests.detector.conftest import teats_picture
from tests.detector.thesis_fits import thesis_published

GOLDEN = Path(__file__).parent / "golden"
TABLE_4_1_COLUMNS = (104, 148, 182, 222, 272, 316, 359, 407)
TABLE_4_1_ROWS = (126, 116, 140, 145, 129, 134, 110, 121)
TABLE_4_1 = np.column_stack([TABLE_4_1_COLUMNS, TABLE_4_1_ROWS]).astype(np.float64)
TABLE_4_2 = np.array([[373, 88], [126, 100], [288, 107], [186, 112]], dtype=np.float64)
SECTION_4_1_7 = np.array([[126, 100], [186, 112], [288, 107], [373, 88]], dtype=np.float64)
HOMOGRAPHIES = {"left": np.array(HOMOGRAPHY_LEFT), "right": np.array(HOMOGRAPHY_RIGHT)}
MASKS = ("edges", "verticals", "horizontals")
HOT, COLD = 40, 200
Picture = NDArray[np.uint8]


def thermal_picture() -> Picture:
    """Un-mirrored, 640 x 480, hot is black. The tables count pixels from 1."""
    picture = np.full((480, 640), COLD, np.uint8)
    t = np.linspace(0, 1, 40)[:, None]
    for (left, right), apex in zip(
        (TABLE_4_1 - 1).reshape(4, 2, 2), SECTION_4_1_7 - 1, strict=True
    ):
        corners = np.array([left[0], apex[1]]), np.array([right[0], apex[1]])
        up = (1 - t) ** 2 * left + 2 * t * (1 - t) * corners[0] + t**2 * apex
        down = (1 - t) ** 2 * apex + 2 * t * (1 - t) * corners[1] + t**2 * right
        outline = np.vstack([[left[0], 479], up, down, [right[0], 479]])
        cv2.fillPoly(picture, [np.rint(outline).astype(np.int32)], HOT)
    return picture


def optical_ends(camera: str) -> NDArray[np.float64]:
    """Where a homography puts the teat ends (4, 2) px."""
    return np.asarray(np.column_stack([SECTION_4_1_7, np.ones(4)]) @ HOMOGRAPHIES[camera].T[:, :2])


def frames() -> Pictures:
    left, right = (
        teats_picture((1360, 1024), optical_ends(camera), np.full(4, 13.0))
        for camera in ("left", "right")
    )
    return Pictures(left, right, np.ascontiguousarray(thermal_picture()[:, ::-1]))


def stage_pictures() -> dict[str, Picture]:
    """The stages' masks white on black, and the four left regions above what is bright in them."""
    found = published_homography().detect(frames(), thesis_published())
    masks = {stage.name: stage.data["mask"] for stage in found.trace if stage.name in MASKS}
    pictures = {name: np.where(masks[name], np.uint8(255), np.uint8(0)) for name in MASKS}
    regions = found.stage("regions")
    assert regions is not None
    bright = np.where(regions.data["left_bright"], np.uint8(255), np.uint8(0))
    pictures["regions"] = np.vstack(
        [np.hstack(list(regions.data["left"])), np.hstack(list(bright))]
    )
    return pictures


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for name, picture in {"thermal": thermal_picture(), **stage_pictures()}.items():
        cv2.imwrite(str(GOLDEN / f"thesis-{name}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
