"""A rig that is real to the bench: emulators in this process, the bench in another, real time
between them.

What a kill of the bench leaves on the bath is seen from here, by the plant itself and by a second
Modbus client.
"""

from __future__ import annotations

import os
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from bench.record.recording import RecordingWriter
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.script.phantom import shipped_phantom
from instruments.clock import RealClock
from instruments.operators.operator import Arrangement, Touch
from tests.bench.commands import words
from tests.bench.forked import Running, begin
from tests.bench.operated_runs import ONE
from tests.bench.small_cameras import write_calibration
from tests.waiting import within

STANDS, READ = "Enter when it stands", "Readings taken"
ASKED = re.compile(rf"ouch the end of teat (?P<teat>\d)|The arm was lost|{STANDS}")

CHECK = "check_point_mm = [-190.0, 120.0, 15.0]\ncheck_touches = {}"

RELAY = 'pump_url = "{}"\npump_profile = "modbus-relay"'

STAGE = """
[stage]
url = "{stage}"
feed_mm_per_min = {feed}
"""
PLAYED = """
[cameras]
url = "recording:recording"
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
    """``twin`` is what answers at the rig's URLs; ``folder`` holds rig file, script and the runs'
    folder.
    """

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

    With a stage, each trial is a move of some seconds; with ``check_touches`` the arm is checked
    before and after the trials, with ``pump`` a relay of its own turns the bath's. With ``pty``
    whatever has a serial port is on a pseudo-terminal.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(folder)
    (folder / "recording").symlink_to(recording, target_is_directory=True)
    with (
        closing(RealClock()) as clock,
        EmulatedRig(at_set_point(folder, start_c, profile, pump=pump), clock, 3, pty=pty) as twin,
    ):
        rig, script = folder / "lab.toml", folder / "short.toml"
        parts = {
            "operator": "console:",
            "cameras_part": PLAYED.format(settle_s=settle_s),
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


def at_set_point(folder: Path, start_c: float, profile: str, *, pump: bool) -> LoadedRig:
    text, before = find_rig(None).read_text(encoding="utf-8"), 'profile = "julabo-presto"'
    assert before in text
    text = text.replace(
        before, f'profile = "{profile}"\n{RELAY.format("emulator:") if pump else ""}'
    )
    (folder / "twin.toml").write_text(
        f"{text}\n[emulation]\nbath_start_c = {start_c}\n", encoding="utf-8"
    )
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


class Child:
    """A bench in another process, with a person at its terminal: the ends of its two pipes."""

    def __init__(self, stdin: int, stdout: int, code: Callable[[], int | None]) -> None:
        self._stdin, self._stdout, self._code = stdin, stdout, code
        self._pieces: list[bytes] = []
        self.reader = threading.Thread(target=self._listen, daemon=True)
        self.reader.start()

    @property
    def said(self) -> str:
        return b"".join(self._pieces).decode("utf-8", "replace")

    def enter(self, times: int = 1) -> None:
        """Press Enter."""
        os.write(self._stdin, b"\n" * times)

    def wait_for(self, words: str, within_s: float = 240.0) -> None:
        """Until the terminal shows ``words``."""
        self.until(lambda: words in self.said, f"said {words!r}", within_s)

    def until(self, there: Callable[[], bool], what: str, within_s: float = 240.0) -> None:
        within(within_s, there, what, said=lambda: self.said, code=self._code)

    def _listen(self) -> None:
        while piece := os.read(self._stdout, 4096):  # prompts don't end with a line
            self._pieces.append(piece)


class Bench(Child):
    """`teatbench run` as a child."""

    def __init__(self, process: Running) -> None:
        assert process.stdin
        assert process.stdout
        super().__init__(process.stdin.fileno(), process.stdout.fileno(), process.poll)
        self.process = process


def touch_as_asked(
    rig: RealRig, said: Callable[[], str], enter: Callable[[], None], over: Callable[[], bool]
) -> float:
    """Answer whatever is asked after the first set-up, until it is ``over``; gives back when the
    last readings were taken.

    On a busy machine a reading may not be good enough, or the arm be lost for a moment: then more
    is asked than once.
    """
    answered, read, read_s, deadline = 0, 0, time.monotonic(), time.monotonic() + 240.0
    while not over():
        assert time.monotonic() < deadline, f"never over:\n{said()}"
        _, _, text = said().partition(STANDS)
        asked = list(ASKED.finditer(text))
        if len(asked) > answered:
            teat = asked[answered]["teat"]
            if teat:
                rig.twin.operator.ask(Touch(int(teat), 4))
            answered += 1
            enter()
        if text.count(READ) > read:
            read, read_s = text.count(READ), time.monotonic()
        time.sleep(0.002)
    return read_s


@contextmanager
def bench(rig: RealRig, more: Sequence[str] = ()) -> Iterator[Bench]:
    """`teatbench run` on the rig, in another process; killed at the end if it still runs."""
    given = words("run {} --rig {} --out {}", rig.script_path, rig.rig_path, rig.out)
    with begin([*given, *more], stdin=subprocess.PIPE) as process:
        running = Bench(process)
        try:
            yield running
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()
            running.reader.join(60)
