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
from contextlib import closing
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
from instruments.bath.profile import load_profile
from instruments.bath.sequence import heater_off
from tests.bench.safety.guards import HotBath

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


@pytest.fixture
def bath(hot: HotBath) -> Iterator[Bath]:
    with closing(Bath(hot.url, load_profile("julabo-presto"), hot.clock)) as opened:
        opened.start(33.0)
        yield opened


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
    event: int, word: str, hot: HotBath, bath: Bath
) -> None:
    system = System()
    with installed(system.register) as exits:
        exits.at_close = lambda: heater_off(bath)
        dealt_with, seconds = system.send(event)  # the main thread does nothing for it
        assert dealt_with
        assert seconds < CLOSE_S < GRANTED_S
        assert not hot.plant.running
        assert exits.asked == [word]


def test_ctrl_c_and_ctrl_break_are_left_to_python() -> None:
    told: list[str] = []
    for event in (CTRL_C_EVENT, CTRL_BREAK_EVENT):
        assert handler_for(told.append)(event) is False
    assert told == []


@pytest.mark.slow
def test_a_bath_that_does_not_answer_takes_no_longer_than_windows_grants(
    hot: HotBath, bath: Bath
) -> None:
    hot.emulator.fault("silence")
    system = System()
    with installed(system.register) as exits:
        exits.at_close = lambda: heater_off(bath)
        dealt_with, seconds = system.send(CTRL_CLOSE_EVENT)
        cut_short = any(thread.name == "console closed" for thread in threading.enumerate())
    assert dealt_with
    assert cut_short or seconds < GRANTED_S
    assert CLOSE_S < GRANTED_S
    hot.emulator.fault("silence", on=False)
    for thread in threading.enumerate():
        if thread.name == "console closed":
            thread.join(60.0)


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
