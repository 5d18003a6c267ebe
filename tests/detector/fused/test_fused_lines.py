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
