"""The console at a pseudo-terminal: a person who presses wrong keys, has a pedal, takes long, or
walks away.
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from instruments.clock import RealClock
from instruments.operators import operator as op
from instruments.operators.console import Console, Pedal

if sys.platform == "win32":
    pytest.skip("needs a pseudo-terminal, which Windows has not", allow_module_level=True)
import pty

from tests.waiting import PATIENCE_S

TOUCH = op.Touch(2, 4)
KEYS = "(s REASON = skip the trial, r = repeat it, ? = explain, a = abort the run): "


class SteeredClock:
    """Time that the test moves; waiting takes hardly any."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def now(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        RealClock().sleep(min(seconds, 0.002))

    def call_at(self, when_s: float, action: Callable[[], None]) -> None:
        raise NotImplementedError(f"nothing is planned here: {when_s}, {action}")


class Desk:
    """A terminal with a console on it, and the person before it. ``asked`` runs beside, as a prompt
    of the bench does.
    """

    def __init__(
        self, near: int, console: Console, clock: SteeredClock, pool: ThreadPoolExecutor
    ) -> None:
        self.near = near
        self.clock = clock
        self.who = console
        self._pool = pool
        self.text = ""

    def asked(
        self, request: op.Request, check: Callable[[], None] = op.no_check
    ) -> Future[op.Answer]:
        return self._pool.submit(self.who.ask, request, check)

    def prompted(self, check: Callable[[], None] = op.no_check) -> Future[op.Answer]:
        """A touch is asked for, and the question stands there."""
        done = self.asked(TOUCH, check)
        self.expect(KEYS)
        return done

    def type(self, text: str) -> None:
        os.write(self.near, text.encode())

    def expect(self, words: str) -> str:
        """Read until the screen says ``words``; gives back all since the last time."""
        deadline = time.monotonic() + PATIENCE_S
        seen = ""
        while words not in seen:
            assert time.monotonic() < deadline, f"never said {words!r}: {seen}"
            if select.select([self.near], [], [], 0.1)[0]:
                seen += os.read(self.near, 4096).decode().replace("\r\n", "\n")
        return seen


@contextmanager
def desk(*, remind_s: float = 60.0, watch: Callable[[], Pedal] | None = None) -> Iterator[Desk]:
    near, far = pty.openpty()
    clock = SteeredClock()
    with (
        os.fdopen(far, encoding="utf-8", closefd=False) as keys,
        os.fdopen(far, "w", encoding="utf-8") as screen,
        ThreadPoolExecutor() as pool,
    ):
        here = Desk(near, Console(keys, screen, clock, watch=watch, remind_s=remind_s), clock, pool)
        try:
            yield here
        finally:
            if here.near >= 0:
                here.type("a\n" * 3)  # whatever still waits ends
    if here.near >= 0:
        os.close(near)


def test_enter_pressed_twice_answers_one_question() -> None:
    with desk() as here:
        done = here.prompted()
        here.type("\n\n")
        done.result(PATIENCE_S)
        done = here.prompted()
        time.sleep(0.1)
        assert not done.done()
        here.type("\n")
        done.result(PATIENCE_S)


def test_an_abort_between_two_questions_is_not_lost() -> None:
    with desk() as here:
        here.type("\na\n")
        with pytest.raises(op.OperatorAbort, match="aborted"):
            here.asked(TOUCH).result(PATIENCE_S)


def test_who_takes_long_is_reminded_and_nothing_else_happens() -> None:
    with desk(remind_s=30.0) as here:
        done = here.prompted()
        for since_s in (30.0, 60.0, 90.0):
            here.clock.now_s = since_s
            reminder = here.expect(KEYS)
            assert f"Still waiting for you, {since_s:.0f} s so far" in reminder
            assert "a = abort the run" in reminder
        assert not done.done()
        here.type("\n")
        assert done.result(PATIENCE_S) == op.DONE


def test_a_trip_ends_the_prompt_before_enter() -> None:
    trips: list[Exception] = []

    def check() -> None:
        if trips:
            raise trips[0]

    with desk() as here:
        done = here.prompted(check)
        here.type("half a li")
        trips.append(RuntimeError("interlock over-temperature: 39.0 degC"))
        here.expect("No answer is needed any more: interlock over-temperature: 39.0 degC\n")
        with pytest.raises(RuntimeError):
            done.result(PATIENCE_S)


class Foot:
    """A pedal at the arm: pressed when the test says so."""

    def __init__(self) -> None:
        self.prompts = 0
        self.down = False

    def watch(self) -> Pedal:
        self.prompts += 1

        def pressed(seconds: float) -> bool:
            RealClock().sleep(min(seconds, 0.002))
            return self.down

        return pressed


def test_a_pedal_goes_on_and_the_keyboard_still_works() -> None:
    foot = Foot()
    with desk(watch=foot.watch) as here:
        done = here.asked(TOUCH)
        here.expect("Enter or a pedal to go on\n(")
        foot.down = True
        assert done.result(PATIENCE_S) == op.DONE
        foot.down = False
        done = here.prompted()
        here.type("r\n")
        with pytest.raises(op.OperatorRepeat):
            done.result(PATIENCE_S)
        assert foot.prompts == 2


def test_no_pedal_confirms_what_is_no_touch() -> None:
    foot = Foot()
    foot.down = True
    with desk(watch=foot.watch) as here:
        done = here.asked(op.Homing("On its peg."))
        assert "pedal" not in here.expect("(? = explain, a = abort the run): ")
        time.sleep(0.1)
        assert not done.done()
        assert foot.prompts == 0
        here.type("\n")
        done.result(PATIENCE_S)


@pytest.mark.parametrize("how", ["closed", "ctrl-d"])
def test_a_terminal_that_closes_or_ends_is_an_abort(how: str) -> None:
    with desk() as here:
        done = here.prompted()
        if how == "closed":
            os.close(here.near)
            here.near = -1
        else:
            here.type("\x04")
        with pytest.raises(op.OperatorAbort, match="the terminal gives no more input"):
            done.result(PATIENCE_S)
