"""One instrument alone, without a rig file: a bath or a stage at a port, cameras by their URLs. A
rig's are opened by `open_rig`, which also watches what heats.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass
from pathlib import Path

from bench.api.loading import AnyRig, load_rig
from bench.config import ConfigError, check_within, read_text
from bench.record.recording import added_to
from bench.rig.alone import OpenCameras, open_bath
from bench.rig.frame_capture import FrameTaker
from bench.rig.leaving import to_stderr
from bench.safety import latch
from bench.safety.bath_monitor import RATE_S, seconds_to_stable
from bench.safety.liveness import Liveness
from bench.safety.stability import BathState, StabilityGate
from instruments.bath.access import RowAnswer
from instruments.bath.driver import OwnBath
from instruments.bath.interface import Bath
from instruments.bath.reading import BathReading
from instruments.camera.radiometric import PROFILES
from instruments.captures.capture import CaptureFile
from instruments.clock import Clock, RealClock
from instruments.errors import InstrumentError
from textfiles.bounds import ABOVE_0, COUNT


@dataclass(frozen=True, slots=True)
class BathView:
    """What `watch_bath` sees: a ``reading``, or why there was none (``fault``); ``stable_in_s`` at
    the least, None while the bath doesn't get nearer; ``reasons``: what the gate waits for.
    """

    reading: BathReading | None
    set_point_c: float
    started: bool
    state: BathState
    stable_in_s: float | None
    reasons: tuple[str, ...]
    fault: str = ""


def watch_bath(
    bath: Bath, every_s: float = 1.0, *, clock: Clock | None = None, window_s: float = 600.0
) -> Iterator[BathView]:
    """Read a bath again and again, until you leave: when is it stable within ``window_s``? Changes
    nothing. ``clock``: a rig's own; real time for None. A reading that fails is a view too.
    """
    check_within(ABOVE_0, every_s=every_s, window_s=window_s)
    moving, gate = Liveness(bath.profile), StabilityGate(bath.get("set_point"), window_s=window_s)
    works, started, seen = bath.profile.row("run").values["started"], True, deque[BathReading]()
    with nullcontext(clock) if clock else closing(RealClock()) as time:
        while True:
            reading, fault = None, ""
            try:
                reading, set_point_c = bath.read(), bath.get("set_point")
                started = bath.get("run") == works
                gate.change_set_point(set_point_c)
                raw, alarm, teat_c = moving(reading), bool(reading.alarm), reading.external_c
                gate.add(reading.t_s, reading.temp_c, raw=raw, alarm=alarm, teat_c=teat_c)
                seen.append(reading)
                while reading.t_s - seen[0].t_s > RATE_S:
                    seen.popleft()
            except InstrumentError as error:  # it may come back
                reading, fault = None, str(error)
            left_s, why = seconds_to_stable(gate, seen), tuple(gate.reasons)
            yield BathView(reading, gate.set_point_c, started, gate.state, left_s, why, fault)
            time.sleep(every_s)


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


def thermal_profiles() -> tuple[str, ...]:
    """What a rig file may name as the ``profile`` of a thermal camera that gives temperatures."""
    return tuple(PROFILES)


@dataclass(frozen=True, slots=True)
class TriedBath:
    """What became of each row of a profile; ``doubt``: why what answers may be no controller."""

    rows: tuple[RowAnswer, ...]
    doubt: str


def try_bath(bath: Bath) -> TriedBath:
    """Ask a bath for each row of its profile by itself, for a profile that is being made: open it
    with ``identify=False``. Writes nothing. Raises LinkError, ConfigError for a plug-in's.
    """
    if not isinstance(bath, OwnBath):
        what = (
            "a plug-in's bath has no profile to be made; 'teatbench plugin check' tries its driver"
        )
        raise ConfigError.plain(f"{bath.url}: {what}")
    return TriedBath(tuple(bath.try_rows()), bath.doubt)


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
    table, clock, known = cameras.table, cameras.clock, cameras.rig.made_calibration
    taker = FrameTaker(
        cameras.frame_set, table, known, clock.sleep, lambda _, text: warn(text), flat=False
    )
    with added_to(folder, read_text(cameras.rig.calibration_path) if known else None) as writer:
        for number in range(count):
            if number:
                clock.sleep(table.settle_s)
            name = f"{len(list((Path(folder) / 'frames').iterdir())):04d}"
            writer.add(name, taker.take())
            yield name


def acknowledge(rig: AnyRig, *, capture: CaptureFile | None = None) -> bool:
    """Let a rig run again whose interlock has tripped, once its bath reads as it may; False where
    none has, and nothing was done. Raises ConfigError, InstrumentError.
    """
    loaded = load_rig(rig)
    if found := latch.latched(loaded):
        with open_bath(loaded.rig.bath.url, loaded.profile, capture=capture) as bath:
            latch.acknowledge(loaded, found, bath.read())
    return bool(found)
