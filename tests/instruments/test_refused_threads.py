"""A system that starts no more threads, or opens no more files: what was opened can still be
closed and made safe.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from contextlib import closing
from typing import ClassVar

import pytest

from bench.safety.signals import in_own_thread
from instruments.clock import RealClock, VirtualClock
from instruments.drivers.bath import PluggedBath
from instruments.drivers.entry_points import Plugin
from instruments.drivers.plugin import BathState
from instruments.listener import Listener
from instruments.stage.emulator.board import StageEmulator
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S


def refused(_: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_an_emulator_whose_thread_was_refused_can_be_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = VirtualClock()
    listener = Listener(StageEmulator(clock), clock, lock=threading.RLock(), name="stage")
    with closing(listener), monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refused)
        with pytest.raises(RuntimeError, match="can't start"):
            listener._start(lambda: None)


class Heater:
    """A bath in memory."""

    identity: ClassVar = {"serial_number": "1"}
    range_c, step_k, pump, comms_loss = (15.0, 60.0), 0.1, "none", "hold"
    running = True

    def __init__(self, _: object) -> None: ...

    def read(self) -> BathState:
        return BathState(20.0, Heater.running, 30.0)

    def start(self, _: float) -> None: ...

    def standby(self) -> None:
        Heater.running = False

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("stack", "start", "why"),
    [(0, refused, RuntimeError), (0, None, TypeError), (1 << 40, None, RuntimeError)],
    ids=["refused", "another's", "of a stack that is too large"],
)
def test_a_bath_is_made_safe_where_no_thread_starts(
    monkeypatch: pytest.MonkeyPatch, stack: int, start: object, why: type[Exception]
) -> None:
    """By calls in real time, and by the end of a run in whose thread another raises."""
    monkeypatch.setattr(Heater, "running", True)
    with closing(RealClock()) as clock, monkeypatch.context() as patch:
        bath = PluggedBath(Plugin("heater", "here", Heater), clock)
        before = threading.stack_size(stack)
        if not stack:
            patch.setattr(threading.Thread, "start", start)
        try:
            with pytest.raises(why):
                threading.Thread(target=bath.read).start()
            bath.safe()
            assert in_own_thread(lambda: Heater.running) is False
            bath.close()
        finally:
            threading.stack_size(before)


FULL = """
import faulthandler, resource, sys, threading, time
from instruments.clock import VirtualClock
from instruments.listener import Listener
from instruments.stage.emulator.board import StageEmulator

clock = VirtualClock()
listener = Listener(StageEmulator(clock), clock, lock=threading.RLock(), name="stage")
[accepts] = listener._threads
while sys._current_frames()[accepts.ident].f_code.co_name != "accept":
    pass
time.sleep(0.3)  # until the system waits, too: before that it ends by itself
faulthandler.dump_traceback_later(float(sys.argv[1]), exit=True)
resource.setrlimit(resource.RLIMIT_NOFILE, (4, 4))
listener.close()
print("closed")
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it is woken by a connection alone")
def test_an_emulator_can_be_closed_where_no_more_files_are_opened() -> None:
    command = [sys.executable, "-c", FULL, str(PATIENCE_S)]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert ended.stdout == "closed\n", ended.stderr
