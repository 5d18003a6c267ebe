"""A console window that is closed on Windows, played here: what its handler does, on what thread,
and in what time.

That Windows calls the handler, and for how long it waits, is not tested: see docs/safety.md.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from bench.safety.signals import (
    CLOSE_S,
    CTRL_BREAK_EVENT,
    CTRL_C_EVENT,
    CTRL_CLOSE_EVENT,
    CTRL_LOGOFF_EVENT,
    CTRL_SHUTDOWN_EVENT,
    Handler,
    handler_for,
    installed,
    windows_register,
)
from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_profile
from instruments.bath.sequence import heater_off
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant

GRANTED_S = 5.0  # Windows ends the program so long after it has called the handler


@dataclass
class System:
    """Stands in for Windows: keeps the handlers that are registered, and calls them on a thread of
    its own.
    """

    handlers: list[Handler] = field(default_factory=list)

    def register(self, handler: Handler, add: bool) -> None:
        (self.handlers.append if add else self.handlers.remove)(handler)

    def send(self, event: int) -> tuple[bool, float]:
        """Whether the event was dealt with, and how long that took."""
        answers: list[bool] = []
        start = time.monotonic()
        thread = threading.Thread(target=lambda: answers.append(self.handlers[-1](event)))
        thread.start()
        thread.join(60.0)
        return answers[0], time.monotonic() - start


@dataclass
class HotBath:
    plant: Plant
    emulator: BathEmulator
    bath: Bath


@pytest.fixture
def hot() -> Iterator[HotBath]:
    clock, plant = RealClock(), Plant(1, start_c=33.0)
    emulator = BathEmulator(plant, load_profile("julabo-presto"), clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    bath = Bath(listener.url.replace("socket://", "tcp://"), load_profile("julabo-presto"), clock)
    bath.start(33.0)
    try:
        yield HotBath(plant, emulator, bath)
    finally:
        bath.close()
        listener.close()
        clock.close()


def test_the_handler_is_there_while_the_bench_is_and_not_longer() -> None:
    system = System()
    with installed(system.register):
        assert len(system.handlers) == 1
    assert system.handlers == []


@pytest.mark.parametrize(
    ("event", "word"),
    [
        (CTRL_CLOSE_EVENT, "console closed"),
        (CTRL_LOGOFF_EVENT, "log-off"),
        (CTRL_SHUTDOWN_EVENT, "shutdown"),
    ],
)
def test_what_ends_the_program_puts_the_bath_into_standby_while_the_main_thread_waits(
    event: int, word: str, hot: HotBath
) -> None:
    system = System()
    with installed(system.register) as exits:
        exits.at_close = lambda: heater_off(hot.bath)
        dealt_with, seconds = system.send(event)  # the main thread does nothing for it
        assert dealt_with
        assert seconds < CLOSE_S < GRANTED_S
        assert not hot.plant.running
        assert exits.asked == [word]


def test_ctrl_c_and_ctrl_break_are_left_to_python() -> None:
    told: list[str] = []
    assert [handler_for(told.append)(event) for event in (CTRL_C_EVENT, CTRL_BREAK_EVENT)] == [
        False,
        False,
    ]
    assert told == []


def test_a_bath_that_does_not_answer_takes_no_longer_than_windows_grants(hot: HotBath) -> None:
    hot.emulator.fault("silence")
    system = System()
    with installed(system.register) as exits:
        exits.at_close = lambda: heater_off(hot.bath)
        dealt_with, seconds = system.send(CTRL_CLOSE_EVENT)
        cut_short = any(thread.name == "console closed" for thread in threading.enumerate())
    assert dealt_with
    assert cut_short or seconds < GRANTED_S
    assert CLOSE_S < GRANTED_S
    hot.emulator.fault("silence", on=False)
    worker = next(
        (thread for thread in threading.enumerate() if thread.name == "console closed"), None
    )
    if worker:
        worker.join(60.0)


def test_before_the_bench_has_a_bath_there_is_nothing_to_do() -> None:
    system = System()
    with installed(system.register) as exits:
        assert system.send(CTRL_CLOSE_EVENT)[0]
        assert exits.asked == ["console closed"]


@pytest.mark.skipif(sys.platform == "win32", reason="says what other systems do")
def test_elsewhere_a_closed_terminal_is_a_signal() -> None:
    assert windows_register() is None
    with installed():
        assert signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL


@pytest.mark.skipif(sys.platform != "win32", reason="asks Windows itself")
def test_windows_takes_the_handler_and_gives_it_back() -> None:
    register = windows_register()
    assert register is not None
    handler = handler_for(lambda _: None)
    register(handler, True)
    register(handler, False)
