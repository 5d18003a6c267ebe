"""What a fit leaves out of an outline speaks for it or against it all the same."""

from __future__ import annotations

import numpy as np
import pytest

from detector.calibration import Calibration
from detector.fused.detector import _Scene, _start, _Thermal
from detector.fused.parameters import Parameters
from detector.outline import pictures
from detector.outline.fine import FINE_OUTLINE, Fitted, fine
from detector.outline.model import CX, END, RADIUS, SIDE_A
from detector.outline.prior import world_from_teats
from tests.detector.fused.conftest import Body, Draw


@pytest.fixture(scope="module")
def scene(draw_scene: Draw, udder: list[Body], rig: Calibration) -> _Scene:
    """Of four teats, before anything is fitted."""
    frames, p = draw_scene(udder), Parameters()
    left = pictures.optical(frames.left, rig.left.image_size, "left")
    right = pictures.optical(frames.right, rig.right.image_size, "right")
    thermal = _Thermal.of(frames, rig, p.prior)
    return _start(thermal, left, right, rig, p, [], None)[1]


@pytest.fixture(scope="module")
def teat(scene: _Scene, udder: list[Body]) -> Fitted:
    """The third one's fit."""
    body, start = udder[2], np.zeros((1, 8))
    start[0, :3] = world_from_teats(scene.calibration).inverse().apply(np.array(body.end_mm))
    start[0, 1] += body.radius_mm
    start[0, RADIUS], start[0, -1] = body.radius_mm, 1.0
    return fine(start, None, scene.views, scene.p.prior)


def test_a_side_that_was_left_out_and_is_elsewhere_speaks_against_a_fit(
    scene: _Scene, teat: Fitted
) -> None:
    """Half of the outline is right, the other half, which was left out, is a pixel inside of it."""
    part = FINE_OUTLINE.part
    half = part == SIDE_A
    half[np.flatnonzero(part == END)[: (part == END).sum() // 2]] = True
    narrow = teat.teats.copy()
    narrow[:, RADIUS] -= 0.5
    narrow[:, CX] += 0.5
    left_out = np.tile(half, len(scene.views))[None]
    fitted = fine(narrow, left_out, scene.views, scene.p.prior, steps=0)
    whole, narrow_one = scene.judged(teat).evidence, scene.judged(fitted).evidence
    assert min(whole.end[0, :2].min(), whole.both[0, :2].min()) > 0.95
    assert narrow_one.end[0, :2].max() < 0.7
    assert (narrow_one.both[0, :2] == 0.0).all()
