"""A rig that is real to the bench: emulators in this process, the bench in another, real time
between them.

What a kill of the bench leaves on the bath is seen from here, by the plant itself and by a second
Modbus client.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from bench.record.recording import RecordingWriter
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.script.phantom import shipped_phantom
from instruments.clock import RealClock
from instruments.operators.operator import Arrangement
from tests.bench.operated_runs import ONE
from tests.bench.small_cameras import write_calibration

CHECK = "check_point_mm = [-190.0, 120.0, 15.0]\ncheck_touches = {}"

RELAY = 'pump_url = "{}"\npump_profile = "modbus-relay"'

STAGE = """
[stage]
url = "{stage}"
feed_mm_per_min = {feed}
"""
QUICK_HOMING = "stage = { settings = { 24 = 1200, 25 = 12000, 26 = 10 } }\n"
PLAYED = """
[cameras]
url = "recording:{recording}"
settle_s = {settle_s}
"""

RIG = """
name = "a real rig"
calibration = "calibration.toml"

[operator]
url = "{operator}"

[arm]
url = "{arm}"
touches = 1
packets = 2
answer_s = 60.0
{check_part}

[bath]
url = "{bath}"
profile = "{profile}"
cut_out_tested = "2024-03-01"
{pump_part}

{stage_part}

{cameras_part}

[limits]
bath_silence_s = {silence_s}
{limits}
"""


@dataclass
class RealRig:
    """``twin`` answers at the rig's URLs; ``folder`` has rig file, script and the runs' folder."""

    twin: EmulatedRig
    folder: Path
    rig_path: Path
    script_path: Path

    @property
    def out(self) -> Path:
        return self.folder / "runs"

    def run_folder(self) -> Path:
        (found,) = self.out.iterdir()
        return found


@contextmanager
def real_rig(
    folder: Path,
    recording: Path,
    *,
    window_s: float = 2.0,
    settle_s: float = 0.1,
    stage: bool = False,
    quick: bool = True,
    repeats: int = 1,
    start_c: float = 33.0,
    limits: str = "",
    check_touches: int = 0,
    profile: str = "julabo-presto",
    pump: bool = False,
    pty: bool = False,
) -> Iterator[RealRig]:
    """Emulators in real time, and the files that make them a real rig; the bath starts at the
    script's set point.

    With a stage, each trial is a move of some seconds, and its homing takes as long, or where it
    isn't ``quick`` half a minute; with ``check_touches`` the arm is checked
    before and after the trials, with ``pump`` a relay of its own turns the bath's. With ``pty``
    whatever has a serial port is on a pseudo-terminal.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(folder)
    with (
        closing(RealClock()) as clock,
        EmulatedRig(
            at_set_point(folder, start_c, profile, pump=pump, quick=quick), clock, 3, pty=pty
        ) as twin,
    ):
        rig, script = folder / "lab.toml", folder / "short.toml"
        parts = {
            "operator": "console:",
            "cameras_part": PLAYED.format(
                recording=recording.resolve().as_posix(), settle_s=settle_s
            ),
            "stage_part": STAGE.format(**twin.urls, feed=1500.0) if stage else "",
            "pump_part": RELAY.format(twin.urls["pump"]) if pump else "",
            "check_part": CHECK.format(check_touches) if check_touches else "",
        }
        parts |= {"profile": profile, "silence_s": "3.0", "limits": limits}
        text = RIG.format(**twin.urls, **parts)
        rig.write_text(text, encoding="utf-8")
        script.write_text(script_of(window_s, repeats), encoding="utf-8")
        yield RealRig(twin, folder, rig, script)


def script_of(window_s: float = 2.0, repeats: int = 1) -> str:
    """One pose, with a gate of ``window_s``."""
    text = ONE.replace("window_s = 2.0", f"window_s = {window_s}").replace("0.5", "0.15")
    text = text.replace("[bath]", f"repeats = {repeats}\n\n[bath]", 1)
    return text.replace('name = "place"', 'name = "one"').replace(
        "poses = [{}]", "pose = { x_mm = 5.0 }"
    )


def at_set_point(
    folder: Path, start_c: float, profile: str, *, pump: bool, quick: bool = True
) -> LoadedRig:
    text, before = find_rig(None).read_text(encoding="utf-8"), 'profile = "julabo-presto"'
    assert before in text
    text = text.replace(
        before, f'profile = "{profile}"\n{RELAY.format("emulator:") if pump else ""}'
    )
    emulation = f"[emulation]\nbath_start_c = {start_c}\n{QUICK_HOMING * quick}"
    (folder / "twin.toml").write_text(f"{text}\n{emulation}", encoding="utf-8")
    return load_rig(folder / "twin.toml")


def record_one(folder: Path, frames: int = 3) -> Path:
    """A recording of the emulated scene, for cameras that play it."""
    writer = RecordingWriter(folder)
    rig = replace(load_rig(find_rig(None)), calibration_path=write_calibration(folder))
    with EmulatedRig(rig, clock := RealClock(), 3) as twin:
        twin.operator.ask(Arrangement("ideal", shipped_phantom("table-5-1"), (), ""))
        for number in range(frames):
            writer.add(f"{number:03d}", twin.cameras.capture())
    clock.close()
    return folder
