"""What the tests of the guardian share: patience, its record, and a bath that it may have to
stop.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from instruments.bath.emulator import BathEmulator
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.conftest import ROOT
from tests.instruments.bath.devices import load_register_profile
from tests.waiting import PATIENCE_S, within

# what docs/safety.md promises; standby takes milliseconds
STANDBY_S, STOPPED_S, HANG_S = 3.0, 2.0, 10.0

Measured = Callable[[str, float], None]


@dataclass
class HotBath:
    """A bath that heats, on a wire of its own."""

    plant: Plant
    emulator: BathEmulator
    clock: RealClock
    url: str
    folder: Path

    def record(self) -> dict[str, Any]:
        return guardian_record(self.folder)


@contextmanager
def hot_bath(folder: Path) -> Iterator[HotBath]:
    """It heats, and guardians write in ``folder``."""
    clock, plant = RealClock(), Plant(1, start_c=33.0)
    plant.run(33.0)
    emulator = BathEmulator(plant, load_register_profile("julabo-presto"), clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    try:
        url = listener.url.replace("socket://", "tcp://")
        yield HotBath(plant, emulator, clock, url, folder)
        for thread in threading.enumerate():
            if thread.name == "guardian":  # it goes once it has read back that the bath is safe
                thread.join(PATIENCE_S)
    finally:
        listener.close()
        clock.close()


def guardians_of(pid: int) -> list[psutil.Process]:
    """Those that a process has started."""
    found = []
    for child in psutil.Process(pid).children():
        with suppress(psutil.NoSuchProcess):
            found += [child] if "bench.rig.guardian" in child.cmdline() else []
    return found


@contextmanager
def guardian(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """A guardian in a process of its own that is ready."""
    command = [sys.executable, "-m", "bench.rig.guardian", *map(str, arguments)]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, cwd=ROOT, stdin=pipe, stdout=pipe, start_new_session=True
    ) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline().split()[:1] == [b"ready"]
            yield process
        finally:
            process.kill()


@contextmanager
def abandoned(*arguments: object) -> Iterator[None]:
    """A guardian whose bench has just died, and which ends by itself."""
    with guardian("--bench", 1, *arguments) as process:
        assert process.stdin is not None
        process.stdin.close()
        yield
        assert process.wait(PATIENCE_S) == 0


def standby_after(plant: Plant) -> float:
    """How long the bath still heats."""
    return within(lambda: not plant.running, "standby")


def guardian_record(
    folder: Path, done: Callable[[dict[str, Any]], bool] = lambda _: True
) -> dict[str, Any]:
    """What the last guardian has written in ``folder``, once it is ``done``."""
    text: dict[str, Any] = {}

    def there() -> bool:
        for path in sorted(folder.glob("guardian*.json"))[-1:]:
            text.clear()
            text.update(json.loads(path.read_text(encoding="utf-8")))
        return bool(text) and done(text)

    within(there, "the guardian's record")
    return text
