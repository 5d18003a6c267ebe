"""The emulated stage as a rig file says: its firmware, its axes, its errors of geometry, and what
goes wrong with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from bench.config import ConfigError
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, load_rig
from bench.rig.opening import open_instruments
from instruments.clock import VirtualClock
from instruments.drivers.protocols import Stage
from instruments.world.phantom import PlatePose
from tests.bench.test_config import rig_with as emulated_rig


def rig_with(folder: Path, stage: str = "", emulation: str = "") -> LoadedRig:
    """The emulated rig with more said of its stage and its emulation."""
    table = '[stage]\nurl = "emulator:"\n'
    path = emulated_rig(folder, {table: f"{table}{stage}\n"})
    path.write_text(f"{path.read_text(encoding='utf-8')}\n{emulation}\n", encoding="utf-8")
    return load_rig(path)


@contextmanager
def homed(rig: LoadedRig) -> Iterator[tuple[EmulatedRig, Stage]]:
    """The rig's world, and its stage as the bench opens it."""
    with (
        EmulatedRig(rig, clock := VirtualClock(), seed=1) as twin,
        open_instruments(rig, ("stage",), clock, twin=twin) as devices,
    ):
        assert devices.stage
        devices.stage.connect()
        devices.stage.home()
        yield twin, devices.stage


NOT_EMULATED = (
    *('dialect = "marlin"', "scale_errors = [0.5, 0, 0, 0]", "backlash_mm = [-1, 0, 0]"),
    *("squareness = 1", "yaw_rad = nan"),
)


@pytest.mark.parametrize(
    ("stage", "emulation", "name"),
    [
        ('axes = "XYZA"', '[emulation.stage]\ndialect = "grblHAL"', "grblHAL"),
        ("", '[emulation.stage]\ndialect = "FluidNC"', "FluidNC"),
        ('dialect = "marlin"\nreference_mm = [150.0, 137.5]', "", "Marlin"),
    ],
)
def test_the_plate_stands_as_any_firmware_says(
    tmp_path: Path, stage: str, emulation: str, name: str
) -> None:
    rig = rig_with(tmp_path, stage, emulation)
    assert rig.rig.stage is not None
    with homed(rig) as (twin, driver):
        assert driver.identity.dialect == name
        driver.move_to(**rig.rig.stage.machine(PlatePose()))
        reference = twin.world.phantom()
        turn_rad = math.radians(30) if "A" in rig.rig.stage.axes else 0.0
        wanted = PlatePose(20.0, -10.0, 5.0 if "Z" in rig.rig.stage.axes else 0.0, turn_rad)
        driver.move_to(**rig.rig.stage.machine(wanted))
        assert np.allclose(twin.world.ends_mm(), reference.moved(wanted).ends_mm, atol=0.01)


@pytest.mark.parametrize(
    ("stage", "emulation", "why"),
    [
        ('dialect = "smoothie"', "", "dialect"),
        ('dialect = "marlin"\naxes = "XYA"', "", "a Marlin stage is driven in X, Y and Z"),
        ('dialect = "marlin"\nmicrosteps = [1.0, 1.0]', "", "microsteps"),
        ('dialect = "zaber"\nzaber_axes = ["1"]', "", "a Zaber stage XY needs 2 devices"),
        ('axes = "XYA"', "", r'stage\.axes: the firmware "grbl" has no axis A: set dialect = "grb'),
        *(("", f"[emulation.stage]\n{line}", r"emulation\.stage\.") for line in NOT_EMULATED),
    ],
)
def test_a_stage_that_can_not_be_is_refused(
    tmp_path: Path, stage: str, emulation: str, why: str
) -> None:
    with pytest.raises(ConfigError, match=why):
        rig_with(tmp_path, stage, emulation)


def test_play_depends_on_the_side_from_which_a_place_is_reached(tmp_path: Path) -> None:
    with homed(rig_with(tmp_path, "", "[emulation.stage]\nbacklash_mm = [0.2, 0.0, 0.0]")) as (
        twin,
        stage,
    ):
        stage.move_to(-150.0, -100.0)
        from_above = twin.world.ends_mm()
        stage.move_to(-160.0, -100.0)
        stage.move_to(-150.0, -100.0)
        assert np.allclose(twin.world.ends_mm() - from_above, [-0.2, 0.0, 0.0], atol=1e-9)


def test_the_world_moves_as_fast_as_the_stage(tmp_path: Path) -> None:
    """A picture taken meanwhile is smeared: the cameras see what the stage carries move."""
    with homed(rig_with(tmp_path)) as (twin, stage):
        stage.move_to(-150.0, -137.5)
        clock, world = twin.world.clock, twin.world
        assert world.scene().velocity_mm_s == (0.0, 0.0, 0.0)
        seen: list[tuple[float, float, float]] = []
        for later_s in np.arange(0.05, 2.0, 0.1):
            clock.call_at(
                clock.now() + float(later_s), lambda: seen.append(world.scene().velocity_mm_s)
            )
        stage.move_to(-140.0, -137.5, feed_mm_min=600.0)
        assert max(velocity[0] for velocity in seen) == pytest.approx(10.0, rel=0.01)
        assert all(velocity[1:] == (0.0, 0.0) for velocity in seen)
        assert world.scene().velocity_mm_s == (0.0, 0.0, 0.0)
