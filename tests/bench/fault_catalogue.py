"""Every fault of every emulator in every state of a short run: what the bench does about it, as a
table.

`python -m tests.bench.fault_catalogue` runs all of it and writes docs/faults.md;
`test_fault_catalogue` runs some of it, and holds each row against the page. A fault is put into the
emulator at the moment when the run comes into the state, and lasts FOR_S.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

from bench.record.reader import RunRecord, read_run
from bench.rig.devices import Devices
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.model import EmulatedFault, emulated_faults
from bench.run.events import EVENT, Events
from bench.run.start import RunOptions
from tests.bench.killed_runs import Person, start
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "faults.md"
STATES = ("preparing", "settling", "running", "paused", "safing")
FOR_S = 15.0
INSTRUMENTS = ("arm", "bath", "cameras", "stage")
# over Modbus TCP, as on the emulated rig, there is no check sum; the others are of lines of ASCII
NO_SUCH = {("bath", "bad CRC"), ("bath", "cut answer"), ("bath", "doubled answer")}
FAULTS = tuple(
    (instrument, str(name))
    for instrument in INSTRUMENTS
    for name in emulated_faults(instrument)[0]
    if (instrument, str(name)) not in NO_SUCH
)
HEAD = """# Faults and what the bench does

Each fault of each emulated instrument, put in for {for_s:g} s at the moment when a short run (three trials, one touch an end, stage and arm
check) comes into a state; paused is a pause that somebody asked for before the second trial. In a state that isn't named, and where
"-" stands, nothing was noticed and all three trials were done. In all {count} of them the bench ended by itself, the bath was in standby, no
trial was in the record by halves, and no fault was taken for a mistake of the bench.

What takes longer to do harm (a frozen sensor, a stuck or dead heater, a pump that stopped) is over before it does; what then stops it
stands in [safety](safety.md#interlocks). Made by `python -m tests.bench.fault_catalogue`; the tests run some, and hold them against this page.

"""


class Bringer(Person):
    """Puts the fault in when the run comes into ``state``; asks for a pause where that is it."""

    def __init__(self, state: str, fault: EmulatedFault) -> None:
        super().__init__("place-2", ["pause", *[""] * 40, "go on"] if state == "paused" else [])
        self._state, self._fault = state, fault
        self.twin: EmulatedRig | None = None

    def event(self, kind: str, text: str) -> None:
        if (kind, text) == (EVENT, self._state):
            self.bring()

    def bring(self) -> None:
        if self.twin is not None:
            self.twin._plan(self._fault)
            self.twin = None


def what_happens(instrument: str, name: str, state: str, folder: Path) -> RunRecord:
    """The run with that fault in that state."""
    script = SCRIPT.replace("window_s = 2.0", "window_s = 20.0")
    files(folder, stage=STAGE, check_point=CHECK_POINT, emulation="prompt_s = 2.0", script=script)
    bringer = Bringer(state, EmulatedFault(instrument=instrument, name=name, for_s=FOR_S))
    with known_to(bringer):
        progress = Events(bringer)
        with patch.object(progress, "event", bringer.event):
            run, _ = start(folder, progress=progress, how=RunOptions(typed=bringer.typed))
    return read_run(run)


@contextmanager
def known_to(bringer: Bringer) -> Iterator[None]:
    """The bringer gets the emulators, and hears when the bench sets about going to safe."""
    made, safe = EmulatedRig.__init__, Devices.make_safe

    def make(twin: EmulatedRig, *arguments: Any, **more: Any) -> None:
        made(twin, *arguments, **more)
        bringer.twin = twin

    def make_safe(devices: Devices, *arguments: Any) -> Mapping[str, str]:
        bringer.event(EVENT, "safing")
        return safe(devices, *arguments)

    with patch.object(EmulatedRig, "__init__", make), patch.object(Devices, "make_safe", make_safe):
        yield


def check_sound(run: RunRecord) -> None:
    """What holds whatever went wrong. Raises AssertionError."""
    texts = [event["text"] for event in run.events]
    assert run.ending in ("finished", "faulted"), run.ending
    assert not any("a mistake of the bench" in text for text in texts), texts
    assert "bath is safe" in texts or any(
        "bath could not be made safe" in text for text in texts
    ), texts
    assert all(
        len({row["teat"] for row in trial.truth}) == 4 and trial.detections and trial.frames
        for trial in run.trials
    )
    assert run.ending == "faulted" or len(run.trials) + len(run.skipped) == 3


def reaction(run: RunRecord) -> str:
    """In a few words."""
    kinds = [event["kind"] for event in run.events]
    note = []
    if "trip" in run.facts:
        note.append(f"interlock {run.facts['trip']['rule']}")
    back = [event["text"].split()[1] for event in run.events if event["kind"] == "back"]
    note += [
        f"paused for the {name}{f' {back.count(name)} times' if back.count(name) > 1 else ''}"
        for name in dict.fromkeys(back)
    ]
    note += ["waited in vain"] if "given up" in kinds else []
    note += ["frames taken again"] if "camera" in kinds else []
    note += ["suspended until stable"] if "suspended" in kinds else []
    note += (
        [f"{len(run.skipped)} trial{'s' if len(run.skipped) > 1 else ''} left out"]
        if run.skipped
        else []
    )
    if run.ending == "faulted":
        unsafe = any("could not be made safe" in event["text"] for event in run.events)
        note.append("ended, reported as NOT SAFE" if unsafe else "ended, safe")
    return ", ".join(note) or "-"


def row(instrument: str, name: str) -> list[str]:
    """The reactions to one fault, state by state."""
    reactions = []
    for state in STATES:
        with TemporaryDirectory() as folder:
            run = what_happens(instrument, name, state, Path(folder))
            try:
                check_sound(run)
            except AssertionError as error:
                raise AssertionError(f"{instrument}, {name}, {state}: {error}") from error
            reactions.append(reaction(run))
    return reactions


Reactions = dict[tuple[str, str], list[str]]  # state by state, by instrument and fault


def table(reactions: Reactions) -> str:
    """Faults of an instrument that the bench answers alike are one row."""
    alike: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for (instrument, name), cells in reactions.items():
        alike.setdefault((instrument, tuple(cells)), []).append(name)
    lines = ["| instrument | faults | what the bench does |", "|---|---|---|"]
    for (instrument, by_state), names in alike.items():
        when: dict[str, list[str]] = {}
        for state, what in zip(STATES, by_state, strict=True):
            when.setdefault(what, []).append(state)
        told = "; ".join(f"{', '.join(at)}: {what}" for what, at in when.items() if what != "-")
        lines.append(f"| {instrument} | {', '.join(names)} | {told or '-'} |")
    return "\n".join(lines) + "\n"


def reactions_of(page: str) -> Reactions:
    """What the table of a page says."""
    lines = [line.strip("|").split("|") for line in page.splitlines() if line.startswith("|")]
    reactions = {}
    for instrument, names, told in ([cell.strip() for cell in line] for line in lines[2:]):
        parts = () if told == "-" else (part.partition(": ") for part in told.split("; "))
        by_state = {state: what for at, _, what in parts for state in at.split(", ")}
        for name in names.split(", "):
            reactions[instrument, name] = [by_state.get(state, "-") for state in STATES]
    return reactions


def main() -> int:
    reactions: Reactions = {}
    wrong = 0
    for instrument, name in FAULTS:
        try:
            reactions[instrument, name] = row(instrument, name)
            sys.stdout.write(f"{instrument}, {name}: {reactions[instrument, name]}\n")
        except Exception as error:
            wrong += 1
            sys.stdout.write(f"WRONG {type(error).__name__}: {error}\n")
        sys.stdout.flush()
    if not wrong:
        head = HEAD.format(for_s=FOR_S, count=len(FAULTS) * len(STATES))
        PAGE.write_text(head + table(reactions), encoding="utf-8")
    return wrong


if __name__ == "__main__":
    sys.exit(main())
