"""Frame sets with faults are noticed by name; good ones of every situation give no false alarm, nor
do drawn dim ones, nor a path tracer's.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.config import read_calibration
from bench.record.recording import Recording
from bench.rig.frame_capture import FrameChecks, StereoOrder
from bench.rig.loading import find_rig, load_rig
from bench.rig.model import CamerasTable, Checks, FocusTable
from detector.calibration import Calibration
from instruments.camera.emulator import FAULTS, KEPT_BACK, EmulatedCameras
from instruments.camera.frame import FrameFault, FrameSet
from instruments.world.situations import situation as drawn_situation
from tests.examples import few
from tests.instruments.camera.small_world import GalleryWorld, SmallWorld
from tests.situations import SITUATIONS, situation

pytestmark = pytest.mark.slow

SHOWN = [fault for fault in FAULTS if fault not in KEPT_BACK]


@cache
def calibration() -> Calibration:
    return load_rig(find_rig(None)).calibration


def table(checks: Checks) -> CamerasTable:
    return CamerasTable(url="emulator:", checks=checks)


def checks(**changed: Any) -> FrameChecks:
    rig = load_rig(find_rig(None)).rig.cameras
    return FrameChecks(table(rig.checks.model_copy(update=changed)), calibration())


@pytest.mark.parametrize("name", few(SITUATIONS, 4))
def test_no_false_alarm_in_any_situation(name: str) -> None:
    cameras, looks = EmulatedCameras(SmallWorld(situation(name))), checks()
    for _ in range(2):  # each frame has fresh noise
        assert looks.notice(cameras.capture()) == []


@pytest.mark.parametrize(("name", "seed"), [("dim_light", 2), ("low_contrast", 1)])
def test_no_false_alarm_in_scenes_that_are_hard_to_see(name: str, seed: int) -> None:
    drawn = drawn_situation(name, seed)
    state = drawn.state((32.5,) * len(drawn.phantom.teats), 31.5, 21.0)
    assert checks().notice(EmulatedCameras(SmallWorld(state)).capture()) == []


def test_no_false_alarm_in_what_a_path_tracer_rendered(shared_data: Path) -> None:
    """Frames of all eleven situations from a program that shares no code with the bench; each of
    them swapped is noticed.
    """
    recording = Recording(shared_data / "path_traced")
    rig = read_calibration(recording.calibration_path)
    looks = FrameChecks(table(Checks(focus_px=FocusTable(left=0.7, right=0.7))), rig)
    order = StereoOrder(rig)
    for frame in recording.frames[::3]:  # one of each situation
        frames = recording.load(frame)
        assert looks.notice(frames) == [], frame
        assert order.swapped(frames.right, frames.left), frame
    assert len({recording.truth[frame][0].situation for frame in recording.frames[::3]}) == 11


@pytest.mark.parametrize("camera", ["right", "thermal"])
def test_each_fault_of_another_camera(camera: str) -> None:
    """One after the other, each for one set; between two the set is good again."""
    sharp = checks(focus_px=FocusTable(thermal=2.0)) if camera == "thermal" else checks()
    cameras = EmulatedCameras(GalleryWorld())
    for fault in SHOWN:
        if fault in (FrameFault.SWAPPED, FrameFault.FLAT_FIELD):
            continue
        blurred = (fault, camera) == (FrameFault.OUT_OF_FOCUS, "thermal")
        looks = sharp if blurred else checks()
        assert looks.notice(cameras.capture()) == []
        cameras.faults.inject(fault, camera=camera, amount=12.0 if blurred else None, times=1)
        noticed = {(one.fault, one.camera) for one in looks.notice(cameras.capture())}
        assert noticed >= {(fault, camera)}


def grey(height: int, width: int, seed: int = 1) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(40, 200, (height, width), dtype=np.uint8)


def test_another_size_than_the_calibrations() -> None:
    frames = FrameSet(grey(1024, 1360), grey(480, 640), grey(240, 320))
    looks = checks(swapped=False, focus_px=FocusTable())
    noticed = {one.camera: one for one in looks.notice(frames)}
    assert noticed["right"].sentence == "640 x 480, the calibration is for 1360 x 1024"
    assert noticed["thermal"].fault is FrameFault.WRONG_SIZE
    small = FrameSet(grey(48, 64), grey(48, 64, 2), grey(48, 64, 3))
    assert FrameChecks(table(Checks()), None).notice(small) == []


def test_a_thermal_frame_that_is_flat_is_no_fault_where_nothing_need_be_warm() -> None:
    flat = np.full((480, 640), 128, np.uint8) + np.random.default_rng(1).integers(
        0, 4, (480, 640), dtype=np.uint8
    )
    frames = FrameSet(grey(1024, 1360), grey(1024, 1360, 2), flat)
    for warm in (True, False):
        looks = FrameChecks(table(Checks(swapped=False)), calibration(), flat=warm)
        noticed = looks.notice(frames)
        assert [one.fault for one in noticed] == ([FrameFault.FLAT_FIELD] if warm else [])
        for one in noticed:  # of water that is cold, as of a shutter
            assert "no contrast" in str(one)
            assert str(one).index("is the bath warm?") < str(one).index("shutter")


def test_looks_can_be_left_out() -> None:
    cameras = EmulatedCameras(GalleryWorld())
    looks = checks(frozen=False, swapped=False, focus_px=FocusTable())
    looks.notice(cameras.capture())
    for fault in (FrameFault.FROZEN, FrameFault.SWAPPED, FrameFault.OUT_OF_FOCUS):
        cameras.faults.inject(fault, times=1)
        assert looks.notice(cameras.capture()) == []


def test_a_depth_pictures_faults_are_noticed_and_rows_without_measurement_are_none() -> None:
    deep = load_rig(find_rig("emulated-depth"))
    frames = EmulatedCameras(GalleryWorld()).capture()
    tenths = np.full((240, 320), 10_763, np.uint16)
    tenths[:80] = 0  # the room behind is too dark
    cases = {
        None: tenths,
        FrameFault.WRONG_SIZE: tenths[::2],
        FrameFault.BLACK: np.zeros_like(tenths),
        FrameFault.FROZEN: tenths,
    }
    for fault, depth in cases.items():
        looks = FrameChecks(table(Checks(swapped=False)), deep.calibration)
        if fault is FrameFault.FROZEN:
            assert looks.notice(replace(gallery_set(), depth_dmm=tenths)) == []
        found = looks.notice(replace(frames, depth_dmm=depth))
        assert [(one.camera, one.fault) for one in found] == ([("depth", fault)] if fault else [])


def gallery_set() -> FrameSet:
    """Another frame set of the same scene."""
    cameras = EmulatedCameras(GalleryWorld())
    cameras.capture()
    return cameras.capture()
