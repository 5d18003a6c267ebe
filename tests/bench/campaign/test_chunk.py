"""A chunk: its rows are those of `score` on a recording of the same scenes, whatever came before."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.campaign.chunk import Bench, SceneId, run_scene
from bench.rig.loading import LoadedRig
from bench.script.detectors import make_detectors
from instruments.world.situations import member, situation
from tests.bench.campaign.small_campaign import Knowing, run_chunk, small_bench


@pytest.fixture(scope="module")
def bench(small_rig: LoadedRig) -> Bench:
    return small_bench(small_rig, *make_detectors(["fused", "thesis"]))


@pytest.mark.slow
def test_rows_depend_on_the_scene_alone(bench: Bench) -> None:
    scenes = [SceneId("ideal", 3), SceneId("overlapping", 1)]
    both, second = run_chunk(bench, scenes), run_chunk(bench, scenes[1:])
    assert [(row.family, row.member, row.detector) for row in both.scenes] == [
        (scene.family, scene.member, name) for scene in scenes for name in ("fused", "thesis")
    ]
    assert both.scenes[2:] == second.scenes
    assert run_scene(bench, scenes[0]).scenes == both.scenes[:2]
    assert both.cpu_s > 0.0
    assert len({row.frames for row in both.scenes}) == 2
    assert len(both.taken) == len(both.scenes)
    for row in both.scenes:
        mine = [t for t in both.teats if (t.family, t.detector) == (row.family, row.detector)]
        assert sum(t.status == "found" for t in mine) == row.found
        assert sum(t.status in ("found", "missed") for t in mine) == row.visible


@pytest.mark.slow
def test_answers_are_counted_against_the_truth(small_rig: LoadedRig) -> None:
    scene = SceneId("ideal", 0)
    ends = situation("ideal", 0).phantom.ends_mm
    half_mm = ends[:3] + np.array([0.5, 0.0, 0.0])
    right = Knowing([*half_mm, ends[0] + [0.0, 300.0, 0.0]])
    off = Knowing([*ends[:3], ends[3] + [0.0, 0.0, 6.0]], name="off")
    failing = Knowing([], breaks=True, name="failing")
    rows = run_scene(small_bench(small_rig, right, off, failing), scene)
    first, second, third = rows.scenes
    assert (first.visible, first.found, first.missed, first.false_teats) == (4, 3, 1, 1)
    assert (first.failure, second.failure, third.failure) == ("false", "error", "failure")
    assert second.max_mm == pytest.approx(6.0, abs=1e-5)
    found = [teat for teat in rows.teats if teat.detector == "knowing" and teat.status == "found"]
    assert [t.x_mm for t in found] == pytest.approx([0.5] * 3)
    assert {t.sd_x_mm for t in found} == {0.5}
    assert all(math.isclose(t.nees or 0.0, 1.0, rel_tol=1e-5) for t in found)
    # a false end that states 0.5 mm, and one 6 mm off that does
    assert (first.sure_wrong, second.sure_wrong, third.sure_wrong) == (1, 1, 0)
    assert (first.stated, first.inside, second.stated, second.inside) == (3, 3, 4, 3)
    assert [first.nees, second.nees] == pytest.approx([1.0, 36.0], rel=1e-5)
    drawn = member("ideal", 0)[1]
    assert first.parameters == second.parameters == ",".join(drawn)
    for share, one in zip(first.shares, drawn.values(), strict=True):
        assert one.low + share / 255 * (one.high - one.low) == pytest.approx(
            one.value, abs=(one.high - one.low) / 500
        )
