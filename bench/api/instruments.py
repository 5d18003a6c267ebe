"""One instrument alone, without a rig file: a bath or a stage at a port, cameras by their URLs. A
rig's are opened by `open_rig`, which also watches what heats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from bench.api.shots import AnyRig, load_rig
from bench.config import ConfigError, check_within, read_text, writing
from bench.record.recording import RecordingWriter
from bench.rig.alone import OpenCameras, open_bath
from bench.rig.alone import attached as attached
from bench.rig.alone import cameras_of_rig as cameras_of_rig
from bench.rig.alone import check_target as check_target
from bench.rig.alone import figures as figures
from bench.rig.alone import jog as jog
from bench.rig.alone import pictures as pictures
from bench.rig.alone import shown as shown
from bench.rig.frame_capture import FrameTaker
from bench.rig.leaving import to_stderr
from bench.safety import latch
from instruments.bath.driver import Bath
from instruments.captures.capture import CaptureFile
from textfiles.bounds import COUNT


def describe_bath(bath: Bath) -> Mapping[str, object]:
    """Who it is, and what it reports; units are in the names, None is what it doesn't report."""
    reading, run = bath.read(), bath.profile.row("run")
    return {
        **bath.identity,
        "temp_c": reading.temp_c,
        "set_point_c": bath.get("set_point"),
        "run": run.label(bath.get("run")),
        "output_percent": reading.power_percent,
        "external_c": reading.external_c,
        "safety_c": reading.safety_c,
        "alarm": reading.alarm,
        "alarm_text": bath.profile.alarm_text(reading.alarm) if reading.alarm else "none",
        "warning": reading.warning,
        "remote": reading.remote,
        "restarted": reading.restarted,
        "number_unit": bath.unit_source,
        "set_point_needs": reading.not_met or "nothing else",
        "pump": bath.pump,
        "comms_loss": bath.profile.comms_loss,
    }


def record_frames(
    cameras: OpenCameras,
    folder: Path | str,
    count: int = 1,
    *,
    warn: Callable[[str], None] = to_stderr,
) -> Iterator[str]:
    """Add ``count`` frame sets to a recording in ``folder``, each checked and taken again where it
    has a fault; the names of the frames, as they are taken. Raises ConfigError for one camera
    alone, RecordingError, DeviceError.
    """
    if cameras.frame_set is None:
        raise ConfigError.plain(
            "one camera alone makes no frame set: name left, right and perhaps thermal, or a rig"
        )
    check_within(COUNT, count=count)
    with writing(Path(folder)):
        writer, table, clock = RecordingWriter(folder), cameras.table, cameras.clock
    if cameras.rig.made_calibration is not None:
        writer.add_calibration(read_text(cameras.rig.calibration_path))
    say, checks = (lambda _, text: warn(text)), cameras.checks
    taker = FrameTaker(cameras.frame_set, table, None, clock.sleep, say, checks=checks)
    for number in range(count):
        if number:
            clock.sleep(table.settle_s)
        name = f"{len(list((Path(folder) / 'frames').iterdir())):04d}"
        writer.add(name, taker.take())
        yield name


def acknowledge(rig: AnyRig, *, capture: CaptureFile | None = None) -> None:
    """Let a rig run again whose interlock has tripped, once its bath reads as it may. Raises
    ConfigError, InstrumentError.
    """
    loaded = load_rig(rig)
    if found := latch.latched(loaded):
        with open_bath(loaded.rig.bath.url, loaded.profile, capture=capture) as bath:
            latch.acknowledge(loaded, found, bath.read())
