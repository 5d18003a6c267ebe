"""Requests to end, at every moment and in every number: the work between is cut short, going to
safe never is. A console window that is closed on Windows is played; that Windows calls the handler
is not tested (docs/safety.md).
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from bench.safety.signals import (
    CLOSE_S,
    CTRL_BREAK_EVENT,
    CTRL_C_EVENT,
    CTRL_CLOSE_EVENT,
    CTRL_LOGOFF_EVENT,
    CTRL_SHUTDOWN_EVENT,
    Exits,
    Handler,
    Interrupted,
    current,
    installed,
    no_lock_is_kept,
    undisturbed,
    windows_register,
)
from instruments.bath.driver import OwnBath
from instruments.bath.profile import load_profile
from instruments.bath.sequence import heater_off
from instruments.clock import VirtualClock
from instruments.listener import Connection
from tests.bench.safety.guards import HotBath
from tests.conftest import ROOT
from tests.instruments.interrupts import interrupts
from tests.instruments.listening_in import Echo, linked
from tests.waiting import PATIENCE_S

posix = pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")

# A program shaped like the engine's run: it works, then goes to safe in half a second, and says
# what it did.
CHILD = """
import sys, time
from bench.safety.signals import current, installed, undisturbed
from bench.safety.signals import Interrupted
def say(text):
    with open(sys.argv[1], "a", encoding="utf-8") as file:
        file.write(text + chr(10))
with installed():
    exits, why = current(), "finished"
    try:
        say("working")
        print("working", flush=True)
        time.sleep(float(sys.argv[2]))
    except BaseException as error:
        exits.hold()
        why = str(error) or type(error).__name__
    else:
        exits.hold()
    finally:
        with undisturbed():
            say("going to safe")
            print("going to safe", flush=True)
            time.sleep(0.5)
            say("safe")
        exits.let_go()
    say(why)
"""

STORMS = 40  # of signals
SAFE = ["working", "going to safe", "safe"]


@posix
def test_the_first_request_is_raised_and_the_second_is_noted() -> None:
    with installed() as exits:
        with pytest.raises(Interrupted, match=r"Ctrl-C"):
            os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        assert exits.asked == ["SIGINT", "SIGINT", "SIGTERM"]


class Dropped:
    """Asked to end while Python calls back, where it drops what is raised."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        len(())  # where the handler runs at the latest


def wait_after(work: Callable[[], None]) -> None:
    work()
    for _ in range(6000):  # a pause may begin just after the signal has come
        time.sleep(0.01)


@posix
def test_a_request_that_python_drops_in_a_callback_comes_again() -> None:
    with installed() as exits:
        kept = [Dropped()]
        with pytest.raises(Interrupted, match=r"Ctrl-C"):
            wait_after(kept.clear)
        assert exits.asked == ["SIGINT"]


@posix
def test_so_does_ctrl_c_of_a_program_that_handles_no_signals() -> None:
    kept = [Dropped()]
    with no_lock_is_kept(), pytest.raises(KeyboardInterrupt):
        wait_after(kept.clear)


@posix
def test_nothing_is_raised_while_undisturbed_and_again_after() -> None:
    with installed() as exits:
        with undisturbed(), undisturbed():
            os.kill(os.getpid(), signal.SIGTERM)
        assert exits.asked == ["SIGTERM"]
        with pytest.raises(Interrupted):
            os.kill(os.getpid(), signal.SIGINT)


@posix
def test_what_came_while_nothing_was_raised_can_be_heeded_afterwards() -> None:
    with installed() as exits:
        exits.check_interrupts()
        with undisturbed():
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Interrupted, match="SIGTERM"):
            exits.check_interrupts()
        exits.check_interrupts()


@posix
def test_an_emulator_on_this_thread_answers_to_the_end() -> None:
    class Asking(Echo):
        def receive(self, connection: Connection, data: bytes) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            super().receive(connection, data)

    with linked(Asking(), VirtualClock()) as (link, _), installed():
        with pytest.raises(Interrupted):  # noqa: PT012 - a moment after the answer
            link.write(b"a")
            time.sleep(10.0)
        assert link.receive(0.0) == b"hello\nA"


@posix
def test_what_was_there_before_is_there_again() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [*map(signal.getsignal, numbers)]
    with installed() as exits:
        assert current() is exits
    assert [*map(signal.getsignal, numbers)] == before
    assert current() is not exits


@posix
def test_what_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with installed() as exits:
            os.kill(os.getpid(), signal.SIGHUP)
            assert exits.asked == []
    finally:
        signal.signal(signal.SIGHUP, before)


def test_on_another_thread_nothing_is_installed() -> None:
    seen: list[object] = []

    def work() -> None:
        with installed() as exits:
            seen.append(exits.asked)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [[]]


@pytest.mark.slow
@posix
@pytest.mark.parametrize("gap_s", [0.15, 0.0], ids=["one after the other", "at once"])
def test_requests_that_follow_a_first_one_cut_nothing_off(gap_s: float, tmp_path: Path) -> None:
    log = tmp_path / "log"
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(log), "30"], cwd=ROOT, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGINT):
            child.send_signal(number)
            time.sleep(gap_s)
        child.wait(PATIENCE_S)
    *lines, why = log.read_text(encoding="utf-8").strip().split("\n")
    assert lines == SAFE
    assert "SIGHUP" in why or not gap_s


@pytest.mark.slow
@posix
def test_a_storm_of_signals_from_the_end_of_the_work_on_cuts_nothing_off(tmp_path: Path) -> None:
    """The moment between work and safe is the one that a plain `finally` loses."""
    for number in range(4):
        log = tmp_path / str(number)
        with subprocess.Popen(
            [sys.executable, "-c", CHILD, str(log), "0.05"], cwd=ROOT, stdout=subprocess.PIPE
        ) as child:
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep(0.04)
            deadline = time.monotonic() + 0.3
            while time.monotonic() < deadline and child.poll() is None:
                child.send_signal(signal.SIGINT)
                time.sleep(0.0005)
            child.wait(PATIENCE_S)
        assert log.read_text(encoding="utf-8").split("\n")[:3] == SAFE


@pytest.mark.slow
@posix
def test_a_request_never_leaves_a_lock_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Raised while Python's own code takes a lock, it would be held for ever, and whoever wants it
    would wait for ever.
    """
    monkeypatch.setattr("bench.safety.signals.ON_THE_WAY_S", 0.0)
    condition, rng, raised = threading.Condition(), random.Random(1), 0

    def is_free() -> None:
        free.append(condition.acquire(timeout=2.0))
        condition.release()

    main_thread = threading.get_ident()
    for _ in range(STORMS):
        storm = threading.Timer(
            rng.uniform(0.001, 0.003), lambda: signal.pthread_kill(main_thread, signal.SIGINT)
        )
        with installed():
            try:
                storm.start()
                while True:
                    with condition:
                        condition.notify_all()
            except Interrupted:
                raised += 1
        storm.join()
        free: list[bool] = []
        other = threading.Thread(target=is_free)
        other.start()
        other.join()
        assert free == [True]
    assert raised == STORMS


@pytest.mark.slow
@posix
def test_a_lock_that_a_block_has_entered_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.safety.signals.ON_THE_WAY_S", 0.0)
    lock, raised = threading.Lock(), 0
    with installed(), interrupts() as interrupt_in:
        for number in range(STORMS):
            with contextlib.suppress(Interrupted):
                interrupt_in(0.0002 + number % 37 * 0.00001)
                while True:
                    with lock:
                        raised += 0
            raised += 1
            assert not lock.locked()
    assert raised == STORMS


GRANTED_S = 5.0  # Windows ends the program so long after it has called the handler


@dataclass
class System:
    """Stands in for Windows: keeps the handlers, and calls them on a thread of its own."""

    handlers: list[Handler] = field(default_factory=list)

    def register(self, handler: Handler, add: bool) -> None:
        (self.handlers.append if add else self.handlers.remove)(handler)

    def send(self, event: int) -> tuple[bool, float]:
        """Whether the event was dealt with, and how long that took."""
        answers: list[bool] = []
        start = time.monotonic()
        thread = threading.Thread(target=lambda: answers.append(self.handlers[-1](event)))
        thread.start()
        thread.join(PATIENCE_S)
        return answers[0], time.monotonic() - start


@pytest.fixture
def bath(hot: HotBath) -> Iterator[OwnBath]:
    with closing(OwnBath(hot.url, load_profile("julabo-presto"), hot.clock)) as opened:
        opened.start(33.0)
        yield opened


def test_the_handler_is_there_while_the_bench_is_and_needs_no_bath() -> None:
    system = System()
    with installed(system.register) as exits:
        assert len(system.handlers) == 1
        assert system.send(CTRL_CLOSE_EVENT)[0]
        assert exits.asked == ["console closed"]
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
    event: int, word: str, hot: HotBath, bath: OwnBath
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
    exits = Exits()
    assert [exits.console_event(event) for event in (CTRL_C_EVENT, CTRL_BREAK_EVENT)] == [False] * 2
    assert exits.asked == []


@pytest.mark.slow
def test_a_bath_that_does_not_answer_takes_no_longer_than_windows_grants(
    hot: HotBath, bath: OwnBath
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
            thread.join(PATIENCE_S)


@pytest.mark.skipif(sys.platform == "win32", reason="says what other systems do")
def test_elsewhere_a_closed_terminal_is_a_signal() -> None:
    assert windows_register() is None
    with installed():
        assert signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL


@pytest.mark.skipif(sys.platform != "win32", reason="asks Windows itself")
def test_windows_takes_the_handler_and_gives_it_back() -> None:
    register = windows_register()
    assert register is not None
    handler = Exits().console_event
    register(handler, True)
    register(handler, False)
