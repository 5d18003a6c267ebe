"""Lines of rods and posts far behind, an edge of which lies beside a teat's own in one picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import draw, rig_renderer, warm
from bench.scoring.matching import gate_mm, match
from detector.calibration import ParameterCovariance
from detector.fused.detector import FusedDetector
from instruments.world.objects import make_object
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.setups import EYES_MM, Situation
from tests.detector.fused.beside_scenes import NAME, beside_scene

EXACT = ParameterCovariance((), np.zeros((0, 0)))
SEED = 1


@pytest.mark.slow
@pytest.mark.parametrize("k", [20130, 20142, 20176, 20189])
def test_a_line_behind_a_teat_does_not_move_its_depth(k: int) -> None:
    """Nothing was learned on these; version 26 was off by 4.7, 14.1, 4.2 and 5.1 mm."""
    rig = load_rig(find_rig(None))
    shot = draw(rig_renderer(rig, SEED), NAME, warm(beside_scene(k)), [SEED, k])
    answer = FusedDetector().detect(shot.frames, replace(rig.calibration, covariance=EXACT))
    ends = np.array([row.xyz_mm for row in shot.truth])
    visible = np.array([row.visible for row in shot.truth])
    found = np.array([teat.world_mm for teat in answer.teats])
    result = match(found, ends, visible, gate_mm(ends))
    assert (result.counts.matched, result.counts.false) == (result.counts.visible, 0)
    assert max(float(np.linalg.norm(found[i] - ends[j])) for i, j in result.pairs) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("beside_mm", [0.5, 1.0, 1.5])
def test_an_end_that_a_line_may_have_moved_is_named(beside_mm: float) -> None:
    """One dark rod 216 mm behind one teat: ends are 6.5, 11.4 and 17 mm off."""
    phantom = Phantom((Teat((-140.0, 240.0), TeatShape(135.0, 11.0)),))
    end, (eye_x, eye_y, _), radius, away = phantom.ends_mm[0], EYES_MM[0], 8.0, 216.0
    share = (end[1] + away - eye_y) / (end[1] - eye_y)
    x = eye_x + (end[0] - 11.0 - beside_mm - eye_x) * share + radius
    rod = make_object(
        "rod", x_mm=float(x), y_mm=float(end[1] + away), height_mm=float(end[2] + 150.0),
        radius_mm=radius, albedo=0.05,
    )  # fmt: skip
    rig = load_rig(find_rig(None))
    situation = Situation("ideal", 0, "", phantom, (rod,))
    shot = draw(rig_renderer(rig, 39), "ideal", warm(situation), [39, 0])
    calibration = replace(rig.calibration, covariance=EXACT)
    answer = FusedDetector().detect(shot.frames, calibration)
    (teat,) = answer.teats
    assert np.linalg.norm(teat.world_mm - shot.truth[0].xyz_mm) > 3.0
    assert "unsure at left (84" in str(answer.reason)
    assert "): an end that may be more than 5 mm off in depth" in str(answer.reason)
    # whatever the calibration states, plain teats have no such sentence
    plain = replace(situation, objects=())
    shot = draw(rig_renderer(rig, 39), "ideal", warm(plain), [39, 0])
    for stated in (calibration, replace(calibration, covariance=None)):
        assert FusedDetector().detect(shot.frames, stated).reason is None
