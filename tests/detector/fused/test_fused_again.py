"""Starts that lead nowhere, ends that are followed up their sides, and what is inside of an outline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from detector.fused import depth_search
from detector.fused.parameters import Parameters
from detector.fused.refine import _inside
from detector.outline.model import CX
from tests.detector.fused.conftest import Body, Find


@pytest.mark.parametrize("seed", range(5))
def test_points_inside_of_an_outline_are_those_of_opencv(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 30))
    outline = np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(20, 60, (30, 1)) + 100.0
    points = rng.uniform(20, 180, (3, 200, 2))
    polygon = outline.astype(np.float32).reshape(-1, 1, 2)
    off = np.array(
        [
            cv2.pointPolygonTest(polygon, (float(x), float(y)), True)
            for x, y in points.reshape(-1, 2)
        ]
    ).reshape(3, 200)
    for room in (3.0, 1.0):
        sure = np.abs(off + room) > 0.01  # OpenCV's is in single precision
        assert (_inside(points, outline, room)[sure] == (off > -room)[sure]).all()


@pytest.mark.slow
def test_first_starts_that_lead_nowhere_leave_the_rest(
    find: Find, udder: list[Body], monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = depth_search.best_starts
    first = Parameters().first_starts

    def beside_and_usual(*given: Any) -> Any:
        teats = usual(*given)
        beside = np.repeat(teats[:1], first, axis=0)
        beside[:, CX] += 1e4  # in no picture
        return np.concatenate([beside, teats])

    monkeypatch.setattr("detector.fused.detector.best_starts", beside_and_usual)
    assert len(find(udder).teats) == len(udder)


@pytest.mark.slow
def test_a_bright_dome_isnt_the_whole_teat(find: Find, udder: list[Body]) -> None:
    """A flatter rim below the end has more contrast, before a thing as warm as the teat."""
    teat = replace(udder[2], end_mm=(-140.0, 205.0, 136.0), height=1.0, radius_mm=11.0, grey=60.0)
    rim = replace(teat, end_mm=(-140.0, 204.9, 130.0), height=0.4, grey=150.0, seen_by="LR")
    arm = replace(teat, end_mm=(-140.0, 330.0, 220.0), radius_mm=60.0, grey=85.0, kelvin=305.5)
    bodies = [teat, rim, arm, udder[0], udder[3]]
    found = find(bodies, noise=1.0)
    ways = [float(np.linalg.norm(one.world_mm - np.array(teat.end_mm))) for one in found.teats]
    near = [way for way in ways if way < 25.0]
    assert len(near) == 1
    assert near[0] < 1.0, near
