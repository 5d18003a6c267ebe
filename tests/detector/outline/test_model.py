"""The model's closed-form outlines against hulls of sampled surfaces, projected by OpenCV."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detector.calibration import Calibration
from detector.geometry import Camera, Motion
from detector.outline.model import (
    COUNT,
    END,
    HEIGHT,
    SIDE_A,
    SIDE_B,
    Outline,
    apexes,
    axes,
    numbers_of,
    outlines,
)
from tests.examples import few

TEATS = np.array(
    [
        [-50.0, 60.0, 1200.0, 0.1, -0.2, 11.0, 0.0, 1.0],
        [120.0, 0.0, 1100.0, -0.15, 0.2, 9.0, 0.0, 0.85],
        [0.0, -40.0, 1600.0, 0.0, 0.0, 13.0, 0.0, 1.2],
    ]
)
OUTLINE = Outline.of(60.0, 8, 15)
PLAIN = numbers_of(Camera((1, 1), (1.0, 1.0), (0.0, 0.0)), Motion.identity())[None]


def surface(
    teat: np.ndarray[tuple[int], np.dtype[np.float64]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    axis = axes(teat[None])[0]
    e1 = np.cross(axis, [0.0, 0.0, 1.0])
    e1 /= np.linalg.norm(e1)
    turn = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    ring = np.cos(turn)[:, None] * e1 + np.sin(turn)[:, None] * np.cross(axis, e1)
    cap = [
        teat[:3] + teat[5] * (np.sin(p) * ring - teat[HEIGHT] * np.cos(p) * axis)
        for p in np.linspace(0, np.pi / 2, 400)
    ]
    return np.concatenate([*cap, teat[:3] + teat[5] * ring + 90.0 * axis])


@pytest.mark.slow
@pytest.mark.parametrize("number", few(range(len(TEATS)), 3))
def test_outlines_lie_on_the_hull_of_the_projected_surface(rig: Calibration, number: int) -> None:
    motion = rig.right_from_left.inverse()
    teat = TEATS[number]
    lens = np.array(
        [[rig.left.fc[0], 0, rig.left.cc[0]], [0, rig.left.fc[1], rig.left.cc[1]], [0, 0, 1]]
    )
    # a lens that bends lines would make the outline hollow, and a hull isn't
    straight = replace(rig.left, kc=(0.0, 0.0, 0.0, 0.0, 0.0))
    projected = cv2.projectPoints(surface(teat), motion.om, motion.T, lens, None)[0]
    hull = cv2.convexHull(projected.astype(np.float32))
    found = outlines(teat[None], numbers_of(straight, motion)[None], OUTLINE)[0][0]
    off = [cv2.pointPolygonTest(hull, (float(x), float(y)), True) for x, y in found]
    assert np.abs(off).max() < 0.02


def test_the_parts_are_left_end_and_right() -> None:
    part = OUTLINE.part
    pixels = outlines(TEATS[2:], PLAIN, OUTLINE)[0][0]
    assert pixels[part == SIDE_A][:, 0].max() < pixels[part == SIDE_B][:, 0].min()
    assert pixels[part == END][:, 1].max() < pixels[part != END][:, 1].min()


def test_normals_point_outward() -> None:
    pixels, normals, _ = outlines(TEATS, PLAIN, OUTLINE)
    middle = pixels.mean(axis=1, keepdims=True)
    assert (np.einsum("mnd,mnd->mn", normals, pixels - middle) > 0).all()


def test_slopes_are_the_differences(rig: Calibration) -> None:
    camera = numbers_of(rig.left, rig.right_from_left.inverse())[None]
    _, normals, closed = outlines(TEATS, camera, OUTLINE, slopes_too=True)
    for i, step in enumerate((0.05, 0.05, 0.5, 1e-3, 1e-3, 0.05, 1e-4, 5e-3)):
        moved = [
            outlines(TEATS + sign * step * np.eye(COUNT)[i], camera, OUTLINE)[0] for sign in (-1, 1)
        ]
        differences = np.einsum("mnd,mnd->mn", moved[1] - moved[0], normals) / (2 * step)
        inner = slice(1, -1)  # the last point's normal is one-sided
        scale = np.abs(differences).max()
        assert np.abs(closed[:, inner, i] - differences[:, inner]).max() < 0.12 * scale, i


def test_the_apex_is_on_the_axis_a_height_above_the_middle() -> None:
    ends = apexes(TEATS)
    reach = np.linalg.norm(ends - TEATS[:, :3], axis=1)
    assert np.allclose(reach, [11.0, 7.65, 15.6])
    assert np.allclose(np.cross(ends - TEATS[:, :3], axes(TEATS)), 0)


def test_a_teat_around_the_camera_has_no_outline() -> None:
    inside = np.array([[0.0, 0.0, 5.0, 0.0, 0.0, 11.0, 0.0, 1.0]])
    assert np.isnan(outlines(inside, PLAIN, OUTLINE)[0]).any()
