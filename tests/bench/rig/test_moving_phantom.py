"""A picture taken while the stage moves: the emulated cameras smear what the stage carries, and see
it still once it stands.
"""

from __future__ import annotations

import numpy as np
import pytest

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import find_rig, load_rig
from bench.script.phantom import shipped_phantom
from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.operators.operator import Arrangement
from instruments.stage.driver import Stage


def test_the_world_moves_as_fast_as_the_stage() -> None:
    with EmulatedRig(load_rig(find_rig(None)), VirtualClock(), seed=5) as twin:
        twin.operator.ask(Arrangement("ideal", shipped_phantom("table-5-1"), (), ""))
        clock = twin.world.clock
        stage = Stage(Link(twin.urls["stage"], clock, who="stage"), clock)
        stage.connect()
        stage.home()
        stage.move_to(-150.0, -137.5)
        assert twin.world.scene().velocity_mm_s == (0.0, 0.0, 0.0)
        seen: list[tuple[float, float, float]] = []
        for later_s in np.arange(0.05, 2.0, 0.1):
            clock.call_at(
                clock.now() + float(later_s), lambda: seen.append(twin.world.scene().velocity_mm_s)
            )
        stage.move_to(-140.0, -137.5, feed_mm_min=600.0)
        stage.close()
        assert max(velocity[0] for velocity in seen) == pytest.approx(10.0, rel=0.01)
        assert all(velocity[1:] == (0.0, 0.0) for velocity in seen)
        assert twin.world.scene().velocity_mm_s == (0.0, 0.0, 0.0)
