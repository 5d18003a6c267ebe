"""A set with a fault is taken again and counted, and refused at last; a recording is asked once.
Then the same in a whole run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from bench.record.recording import Recording, RecordingCameras, RecordingWriter
from bench.rig.frame_capture import CALLED, CHECKED, FRAMES_FACT, HINTS, FrameChecks, FrameTaker
from bench.rig.loading import find_rig, load_rig
from bench.rig.model import CamerasTable, FocusTable
from instruments.camera.emulator import FAULTS, EmulatedCameras
from instruments.camera.frame import FrameFault, FrameSet
from instruments.errors import DeviceError, LinkError
from tests.bench.operated_runs import ONE, record_of, texts
from tests.instruments.camera.small_world import GalleryWorld


@dataclass
class Bench:
    """A taker with its cameras, the waits it made and the events it told."""

    cameras: EmulatedCameras = field(default_factory=lambda: EmulatedCameras(GalleryWorld()))
    waits: list[float] = field(default_factory=list)
    events: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rig = load_rig(find_rig(None))
        noted = self.waits.append, lambda *event: self.events.append(event)
        self.taker = FrameTaker(self.cameras, rig.rig.cameras, rig.calibration, *noted)
        self.taker.take()


@pytest.mark.slow
@pytest.mark.parametrize("fault", [FrameFault.DROPPED, FrameFault.FLAT_FIELD])
def test_a_fault_is_cured_by_another_try_and_counted_or_refused(fault: FrameFault) -> None:
    """One without a set, and one that is seen in it; each fault is seen in `test_frame_checks`."""
    bench = Bench()
    bench.cameras.faults.inject(fault, times=2)
    bench.taker.take()
    assert bench.waits == [0.5, 0.5]
    assert bench.taker.counts == {f"{FAULTS[fault]}: {fault}": 2}
    assert [kind for kind, _ in bench.events] == ["camera", "camera"]
    assert f"{FAULTS[fault]} camera: {CALLED.get(fault, fault)}: " in bench.events[0][1]
    assert bench.events[0][1].endswith("Taken again; 3 tries are left.")
    bench.cameras.faults.inject(fault)
    with pytest.raises(DeviceError) as refused:
        bench.taker.take()
    assert (
        f"cameras: no usable frame set in 4 tries: {FAULTS[fault]} camera: {CALLED.get(fault, fault)}: "
        in str(refused.value)
    )
    assert str(refused.value).endswith(HINTS[fault])
    assert bench.taker.counts == {f"{FAULTS[fault]}: {fault}": 6}
    assert bench.events[-1][1].endswith("Refused.")
    assert len(bench.waits) == 5


@pytest.mark.slow
def test_two_faults_at_once_are_both_told() -> None:
    bench = Bench()
    bench.cameras.faults.inject("black", times=1, camera="right")
    bench.cameras.faults.inject("flat-field event", times=1)
    bench.taker.take()
    assert bench.taker.counts == {"right: black": 1, "thermal: flat-field event": 1}


def test_every_fault_has_its_hint() -> None:
    assert HINTS.keys() == set(FrameFault)


class Gone:
    identity: Mapping[str, str] = {}

    def capture(self) -> FrameSet:
        raise LinkError("left camera", "is gone")

    def close(self) -> None:
        pass


def test_a_camera_that_is_gone_is_not_asked_again() -> None:
    waits: list[float] = []
    taker = FrameTaker(Gone(), CamerasTable(url="emulator:"), None, waits.append, lambda *_: None)
    with pytest.raises(LinkError, match="is gone"):
        taker.take()
    assert waits == []


@pytest.mark.slow
def test_a_recording_is_asked_once_for_its_next_frame_is_another_trials(tmp_path: Path) -> None:
    frames = EmulatedCameras(GalleryWorld()).capture()
    writer = RecordingWriter(tmp_path)
    for name in ("0", "1"):
        writer.add(name, frames)
    taker = FrameTaker(
        RecordingCameras(Recording(tmp_path)),
        CamerasTable(url="recording:x"),
        None,
        lambda _: pytest.fail("waited"),
        lambda *_: None,
    )
    taker.take()
    said = "; ".join(f"{name} camera: frozen: .*" for name in ("left", "right", "thermal"))
    with pytest.raises(DeviceError, match=f"no usable frame set in 1 try: {said}"):
        taker.take()


def test_each_check_says_how_many_pictures_it_looked_at() -> None:
    """Without calibration, focus reference and frames before, nothing is compared with them."""
    rig = load_rig(find_rig(None))
    flat = np.zeros((4, 4), np.uint8)
    unfocused = rig.rig.cameras.checks.model_copy(update={"focus_px": FocusTable()})
    checks = FrameChecks(rig.rig.cameras.model_copy(update={"checks": unfocused}), None)
    assert set(checks.looked) == set(CHECKED)
    assert not any(checks.looked.values())
    checks.notice(FrameSet(flat, flat))
    assert {fault for fault, count in checks.looked.items() if count} == {
        *("black", "saturated", "half a frame")
    }
    checks.notice(FrameSet(flat, flat, exposed_s={"left": 0.0, "right": 0.0}))
    counts = {"black": 4, "saturated": 4, "half a frame": 4, "frozen": 2, "late": 2}
    assert +checks.looked == counts


@pytest.mark.slow
def test_a_run_goes_on_through_faults_that_pass_and_keeps_count_of_them(tmp_path: Path) -> None:
    faults = """faults = [
    { instrument = "cameras", name = "flat-field event", times = 2 },
    { instrument = "cameras", name = "swapped", times = 1 },
    ]"""
    run = record_of(tmp_path, emulation=faults, script=ONE, whole=True)
    assert (run.ending, len(run.trials)) == ("finished", 1)
    assert run.facts["camera faults"] == {"thermal: flat-field event": 2, "left: swapped": 1}
    assert len(texts(run, "camera")) == 2
    looked = run.facts[FRAMES_FACT]
    assert looked["black"] >= 6
    assert min(looked[name] for name in ("swapped", "flat-field event", "late")) > 0
    assert looked["out of focus"] == 0, "its rig has no reference"


@pytest.mark.slow
def test_a_run_ends_safely_when_a_fault_stays(tmp_path: Path) -> None:
    black = '{ instrument = "cameras", name = "black", camera = "right" }'
    run = record_of(tmp_path, emulation=f"faults = [{black}]\n[limits]\naway_s = 20.0")
    assert (run.ending, len(run.trials)) == ("faulted", 0)
    assert run.facts["camera faults"] == {"right: black": 4}
    assert texts(run, "camera")[-1].endswith("Refused.")
    assert "bath is safe" in texts(run, "safe")
