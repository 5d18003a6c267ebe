"""A set with a fault is taken again and counted, and refused at last; a recording is asked once.
Then the same in a whole run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from bench.record.reader import read_run
from bench.rig.frame_capture import HINTS, FrameTaker
from bench.rig.loading import find_rig, load_rig
from bench.rig.model import Cameras as CamerasTable
from instruments.camera.emulator import FAULTS, EmulatedCameras
from instruments.camera.frame import FrameFault, FrameSet
from instruments.camera.recording import Recording, RecordingCameras, RecordingWriter
from instruments.errors import DeviceError, LinkError
from tests.bench.rig.test_emulated_faults import with_emulation
from tests.bench.run.test_end_to_end import run_command
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
@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_cured_by_another_try_and_counted_or_refused(fault: FrameFault) -> None:
    bench = Bench()
    bench.cameras.faults.inject(fault, times=2)
    bench.taker.take()
    assert bench.waits == [0.5, 0.5]
    assert bench.taker.counts == {f"{FAULTS[fault]}: {fault}": 2}
    assert [kind for kind, _ in bench.events] == ["camera", "camera"]
    assert f"{FAULTS[fault]} camera: {fault}: " in bench.events[0][1]
    assert bench.events[0][1].endswith("Taken again; 3 tries are left.")
    bench.cameras.faults.inject(fault)
    with pytest.raises(DeviceError) as refused:
        bench.taker.take()
    assert f"cameras: no usable frame set in 4 tries: {FAULTS[fault]} camera: {fault}: " in str(
        refused.value
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


def record_of(folder: Path) -> tuple[list[str], dict[str, int], int]:
    """Events of the cameras, counts of their faults, and how many trials are whole."""
    run = read_run(folder)
    events = [str(event["text"]) for event in run.events if event["kind"] == "camera"]
    return events, run.facts.get("camera faults", {}), len(run.trials)


@pytest.mark.slow
def test_a_run_goes_on_through_faults_that_pass_and_keeps_count_of_them(
    tmp_path: Path, short_script: Path
) -> None:
    faults = [
        '{ instrument = "cameras", name = "flat-field event", times = 2 }',
        '{ instrument = "cameras", name = "swapped", times = 1 }',
    ]
    rig = with_emulation(tmp_path, f"faults = [{', '.join(faults)}]")
    code, folder = run_command(["run", str(short_script), "--rig", str(rig)], tmp_path / "runs")
    events, counts, trials = record_of(folder)
    assert code in (0, 1, 4)
    assert counts == {"thermal: flat-field event": 2, "left: swapped": 1}
    assert len(events) == 2
    assert trials == 6


@pytest.mark.slow
@pytest.mark.timeout(900)  # a busy machine draws its report for minutes
def test_a_run_ends_safely_when_a_fault_stays(tmp_path: Path, short_script: Path) -> None:
    rig = with_emulation(
        tmp_path, 'faults = [{ instrument = "cameras", name = "black", camera = "right" }]'
    )
    rig.write_text(
        rig.read_text(encoding="utf-8") + "\n[limits]\naway_s = 20.0\n", encoding="utf-8"
    )
    code, folder = run_command(["run", str(short_script), "--rig", str(rig)], tmp_path / "runs")
    events, counts, trials = record_of(folder)
    assert code == 3
    assert counts == {"right: black": 4}
    assert events[-1].endswith("Refused.")
    assert trials == 0
