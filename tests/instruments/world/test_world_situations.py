"""A situation in the world: seen by the cameras, warmed by the plant, carried by the stage."""

from __future__ import annotations

import numpy as np
import pytest

from instruments.clock import VirtualClock
from instruments.world.objects import make_object
from instruments.world.phantom import PlatePose
from instruments.world.situations import situation
from instruments.world.world import World
from tests.instruments.world.scenes import renderer


def world() -> World:
    return World(VirtualClock(), 3, renderer, ambient_c=20.0, bath_start_c=30.0)


@pytest.mark.slow
def test_the_world_stands_as_the_situation_says() -> None:
    found, bench = situation("missing_or_hidden", 3), world()
    bench.arrange(found.phantom, [{"kind": "rod", "y_mm": 900.0}], found)
    seen = bench.scene()
    for name in ("lighting", "backdrop", "teat_paint", "boards"):
        assert getattr(seen, name) == getattr(found, name)
    assert seen.objects == (*found.objects, make_object("rod", y_mm=900.0))
    assert np.array_equal(seen.phantom.ends_mm, found.phantom.ends_mm)


@pytest.mark.slow
def test_a_situation_s_phantom_rides_on_the_stage() -> None:
    found, bench = situation("ideal", 1), world()
    bench.stage_pose = lambda: PlatePose(5.0, -3.0)
    bench.stage_velocity = lambda: (300.0, 0.0, 0.0)
    bench.arrange(found.phantom, [], found)
    assert bench.ends_mm() == pytest.approx(found.phantom.ends_mm + np.array([5.0, -3.0, 0.0]))
    assert np.array_equal(bench.scene().phantom.ends_mm, bench.ends_mm())
    assert bench.scene().velocity_mm_s == (300.0, 0.0, 0.0)


def test_the_next_arrangement_takes_it_away() -> None:
    found, bench = situation("low_contrast", 1), world()
    bench.arrange(found.phantom, [], found)
    bench.arrange(found.phantom, [])
    seen = bench.scene()
    assert seen.backdrop != found.backdrop
    assert seen.objects == ()
    assert seen.boards == ()


def test_drift_and_teats_follow_clock_and_plant() -> None:
    bench, found = world(), situation("ideal", 1)
    bench.arrange(found.phantom, [], found)
    bench.clock.sleep(42.0)
    seen = bench.scene()
    assert seen.time_s == pytest.approx(bench.clock.now())
    assert seen.teat_fall == pytest.approx(2.0 * 0.046 / 1.9)
    assert seen.teat_temps_c == pytest.approx(bench.plant.teat_c.tolist())
