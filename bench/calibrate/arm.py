"""One arm alone, for the commands: connected by its URL, signed on, homing confirmed by the person
who stands beside it.

`emulator:` means an emulated arm of this process that goes where the dialogue asks. Time is real: a
person takes part.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from bench.calibrate.arm_dialogues import Plan, Step, touch_frame, verify
from bench.calibrate.simulated_arm import TryingArm
from bench.config import ConfigError
from bench.rig.arm_frame import TableFrame, Triple
from bench.rig.arm_verification import Limits, Verification
from bench.rig.opening import pedal_watch
from bench.rig.urls import EMULATED, serial_url
from bench.script.model import ArmRequirement, find_script, load_script
from instruments.captures.capture import Captures
from instruments.clock import RealClock, wall_time
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.operators.console import Console
from instruments.operators.operator import Task

PEG = "Put the arm's stylus on its peg"
HOMED = (
    "Was the stylus on its peg when the arm was last switched on, or the arm homed since"
    " ('teatbench arm home')?"
)
NO_TERMINAL = (
    "no positions before homing is confirmed, and nobody is at a terminal to confirm it. Give"
    " --homed where the stylus was on its peg when the arm was last switched on, or the arm was"
    " homed since: otherwise positions are wrong, with no sign of it."
)


@dataclass(frozen=True, slots=True)
class ArmSession:
    """A signed-on arm and the person beside it."""

    arm: MicroScribe
    clock: RealClock
    console: Console
    trying: TryingArm | None

    def confirm_homing(self, *, homed: bool) -> None:
        """Confirm homing: ``homed`` says so, else the person is asked. Raises ConfigError where
        nobody is there, OperatorAbort.
        """
        if not homed:
            if not sys.stdin.isatty():
                raise ConfigError.plain(NO_TERMINAL)
            self.console.ask(Task(HOMED))
        self.arm.confirm_homed()

    # The person of `guided`

    def ask(self, text: str) -> None:
        """Something to be done."""
        self.console.ask(Task(text))

    def touch(self, step: Step) -> None:
        """Something to be touched; the emulated hand goes there first."""
        if self.trying:
            self.trying.go(step)
        self.console.ask(Task(step.text, pedal=True))

    def say(self, text: str) -> None:
        """Something to be shown."""
        self.console.say(text)

    def frame(self, checks: list[Triple | None]) -> TableFrame:
        """The dialogue of `arm frame`."""
        return touch_frame(self.arm, self, checks, today())

    def verification(self, plan: Plan) -> Verification:
        """The dialogue of `arm verify`."""
        return verify(self.arm, self, plan, today())


@contextmanager
def open_arm(
    port: str, baud: int, answer_s: float, capture: Captures, *, length_mm: float | None = None
) -> Iterator[ArmSession]:
    """The arm at ``port``, signed on; ``length_mm`` is that of an emulated arm's bar. Raises
    ConfigError and as the driver does.
    """
    try:
        serial_url(port)
    except ValueError as error:
        raise ConfigError.plain(f"--port {port}: {error}") from error
    clock = RealClock()
    trying = TryingArm(clock, length_mm=length_mm or 300.0) if port == EMULATED else None
    try:
        link = Link(
            trying.url if trying else port,
            clock,
            who="arm",
            baud=baud,
            tap=capture.tap("arm", clock),
        )
        arm = MicroScribe(link, clock, answer_s=answer_s)
        try:
            arm.sign_on()
            console = Console(sys.stdin, sys.stdout, clock, watch=lambda: pedal_watch(arm, clock))
            yield ArmSession(arm, clock, console, trying)
        finally:
            arm.close()
    finally:
        if trying:
            trying.close()
        clock.close()


def today() -> datetime:
    """For the files: to the second, in UTC."""
    return wall_time().replace(microsecond=0).astimezone(UTC)


def limits_of(script: str | None) -> Limits:
    """What a script asks of an arm. Raises ConfigError where it asks for nothing."""
    loaded = load_script(find_script(script))
    for rule in loaded.script.requirements:
        if isinstance(rule, ArmRequirement):
            return Limits(rule.location_limit_mm, rule.length_limit_mm)
    raise ConfigError.plain(
        f"{loaded.path} has no requirement of the kind arm_verified, so it has no limits for an"
        " arm. Name another one."
    )


def refuse_existing(out: Path, *, replace: bool, option: str = "--out") -> None:
    """Raises ConfigError before anybody has worked for a file that can't be written."""
    if out.is_dir() or not out.resolve().parent.is_dir():
        why = f"there is no folder {out.parent}" if not out.is_dir() else "this is a folder"
        raise ConfigError.plain(f"{option} {out}: {why}; name a file in a folder that is there.")
    if out.exists() and not replace:
        raise ConfigError.plain(
            f"{option} {out} is there already. Name another file, or give --replace."
        )
