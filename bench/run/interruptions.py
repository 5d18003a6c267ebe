"""What interrupts a run: an instrument that drops out, and a person's request to pause, go on, skip
or repeat the trial in flight, or end (docs/runs.md).

A table (`POLICIES`) says for each kind of fault how often it is tried again and what a person
checks; any other ends the run. The work is done again whole; interlocks and requests may end the
wait.
A request is a file in the run's folder, or a line typed at a terminal where no operator sits. Each
is answered in a line. A trial in flight that is skipped or repeated leaves no trace.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

from bench.config import ConfigError
from bench.files import write_synced
from bench.rig.frame_capture import CAPTURE_S
from bench.rig.reconnecting import (
    GARBLED,
    GONE,
    PICTURES,
    POLICIES,
    REFUSES,
    Policy,
    diagnosis,
    goes_on,
    reach_arm,
    reach_stage,
    to_check,
    wait_for,
)
from bench.run.context import RunContext
from bench.run.events import BACK, RunState
from instruments.camera.cameras import CameraSet
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import InstrumentError
from instruments.operators.operator import (
    KEYS,
    OperatorAbort,
    OperatorRepeat,
    OperatorSkip,
    Release,
)
from textfiles.text import in_command, sentence
from textfiles.whole import refusal

HOW = {GONE: "no answer", GARBLED: "no usable answer", REFUSES: "it refuses", "": "at fault"}
NO_PICTURES = "no usable pictures"
HOMING = "Keep your hands off the stage, it homes. The run then goes on by itself."
# while a run is being prepared: nothing is lost yet, and it may be another device altogether
PREPARING_S = 20.0
SETTLED_S = 1.0


class Recovery:
    """Runs work that instruments may interrupt. ``look`` raises while no frames are usable."""

    def __init__(self, ctx: RunContext, look: Callable[[], None]) -> None:
        self._ctx = ctx
        self._look = look
        self._patience_s = ctx.rig.rig.limits.away_s
        self._missing: tuple[InstrumentError, Policy] | None = None
        self.counts: Counter[str] = Counter()

    def run(self, what: str, work: Callable[[], None]) -> None:
        """Do ``work`` until it is done. Raises a fault without a policy, one that came too often,
        and one whose instrument does not come back.
        """
        tried: Counter[str] = Counter()
        if self._missing:  # the wait was given up, and it may be back, but not where it was
            self._pause(what, *self._missing, "still away")
        while True:
            self._ctx.check()
            try:
                return work()
            except InstrumentError as fault:
                # a stage that a trip has braked is not to be homed again
                self._ctx.watch.check()
                policy = POLICIES.get(diagnosis(fault))
                kind = " ".join(diagnosis(fault))
                tried[kind] += 1
                if policy is None or tried[kind] > policy.times:
                    raise
                self.counts[kind] += 1
                self._pause(what, fault, policy, f"try {tried[kind]} of {policy.times}")

    def _pause(self, what: str, fault: InstrumentError, policy: Policy, count: str) -> None:
        """Until the instrument is back. Raises ``fault`` where it stays away."""
        ctx, (name, kind) = self._ctx, diagnosis(fault)
        are = "are" if name == "cameras" else "is"
        self._missing = (fault, policy)
        ctx.away, ctx.away_how = name, NO_PICTURES if (name, kind) == PICTURES else HOW[kind]
        ctx.check_away = f"{to_check(fault, policy)} {goes_on(fault)}"
        started_s, patience_s = ctx.clock.now(), self._patience_s
        if ctx.states.current is RunState.PREPARING:
            patience_s = min(patience_s, PREPARING_S)
        if name == "arm":
            ctx.ask(Release(lost=True))
        with ctx.states.during(RunState.PAUSED):
            ctx.event("dropped out", f"{what}: {fault} ({count})")
            check = to_check(fault, policy)
            first = "" if check == fault.hint else f"{check} "  # which the fault has said
            ctx.events.warn(f"{fault}\nThe run is paused. {first}{goes_on(fault)}")
            try:
                attempt = partial(self._attempt, name)
                wait_for(attempt, fault, patience_s, ctx.clock.now, ctx.wait, ctx.events.warn)
            except InstrumentError as why:
                if why is fault:
                    gone = f"the {name} did not come back within {patience_s:g} s"
                    ctx.event("given up", gone)
                raise
            ctx.check()
            note = f"the {name} {are} back after {ctx.clock.now() - started_s:.1f} s"
            note += ", homed again" if name in ("arm", "stage") else ""
            ctx.event(BACK, f"{note}; done again from its start: {what}")
            ctx.events.warn(f"{sentence(note)} The run goes on.")
        self._missing, ctx.away = None, ""

    def _attempt(self, name: str) -> None:
        """Make it ready again: arm homed, stage homed, cameras usable. Raises while it is away."""
        ctx, devices = self._ctx, self._ctx.devices
        ctx.events.state(f"waiting for the {name}")
        try:
            if name == "arm":
                ctx.long("looking for the arm", 120.0)
                reach_arm(devices.arm, ctx.ask, self._arm_answers)
            elif name == "stage" and devices.stage:
                ctx.long("homing the stage again", 600.0)
                reach_stage(devices.stage, self._stage_answers)
            elif name == "cameras":
                ctx.wait(SETTLED_S)
                ctx.long("opening the cameras again", CAPTURE_S, silent=True)
                if isinstance(devices.cameras, CameraSet):
                    devices.cameras.reopen()
                ctx.long("looking at the cameras", CAPTURE_S, silent=True)
                self._look()
                devices.answered_s[name] = ctx.clock.now()
            else:
                devices.bath.read()  # its driver connects again by itself
        except InstrumentError:
            ctx.away = name
            raise
        finally:
            ctx.readied = ""

    def _arm_answers(self) -> None:
        self._ctx.away = ""

    def _stage_answers(self) -> None:
        self._ctx.look()  # a stage that a trip has braked meanwhile is not to move
        self._ctx.away, self._ctx.readied = "", HOMING
        self._ctx.events.state("homing the stage again")


FILE, TAKEN = "wish.txt", "wish-taken.txt"
REQUEST_POLL_S = 0.1
PAUSE_POLL_S = 1.0
REAL_S = 0.02  # of real time, for a second of virtual time
PAUSE, GO_ON, SKIP, REPEAT, ABORT = "pause", "go on", "skip", "repeat", "abort"
SHORT = {"p": PAUSE, "g": GO_ON, "go": GO_ON, "go-on": GO_ON, "s": SKIP, "r": REPEAT, "a": ABORT}
HELP = "pause, go on, skip REASON, repeat REASON, abort"


def parse_request(words: str) -> tuple[str, str]:
    """The request and its reason. Raises ValueError for other words and for a missing reason."""
    text = " ".join(words.split())
    if (whole := SHORT.get(text.lower(), text.lower())) in (PAUSE, GO_ON, ABORT):
        return whole, ""
    first, _, reason = text.partition(" ")
    request = SHORT.get(first.lower(), first.lower())
    if request not in (SKIP, REPEAT):
        raise ValueError(f"not understood: {text!r}. There are: {HELP}")
    if reason.lower() in ("", *KEYS):
        needs = f"{request} needs a reason, for the record"
        raise ValueError(f"{needs}: {request} the plate was touched")
    return request, reason


def leave_request(folder: Path, words: str) -> None:
    """Leave a request for the run in ``folder``. Raises ConfigError."""
    try:
        request, reason = parse_request(words)
        write_synced(folder / FILE, f"{request} {reason}\n".encode())
    except ValueError as error:
        raise ConfigError.plain(str(error)) from error
    except OSError as error:
        why = f"{folder / FILE} can't be written: {refusal(error)}"
        raise ConfigError.plain(why) from error


def was_taken(folder: Path, clock: Clock, within_s: float) -> bool:
    """Whether the run in ``folder`` took what was left for it within ``within_s``."""
    until_s = clock.now() + within_s
    while (folder / FILE).exists():
        if clock.now() >= until_s:
            return False
        clock.sleep(REQUEST_POLL_S)
    return True


class Requests:
    """Requests left in ``folder``, and lines from ``typed`` (None: nothing new)."""

    def __init__(
        self, folder: Path, typed: Callable[[], str | None], report: Callable[[str], None]
    ) -> None:
        self._path, self._taken = folder / FILE, folder / TAKEN
        self._typed = typed
        self._report = report
        self.paused = False

    def forget(self) -> None:
        """Drop what was left for an earlier session that ended before it took it."""
        if words := self._left():
            note = "Left in the last session and not taken; it is void now"
            self._report(f"{note}: {words.strip()}")

    def look(self, *, amid: bool = True) -> None:
        """Take requests; raises OperatorAbort, ``amid`` a trial OperatorSkip and OperatorRepeat."""
        for words in (self._left(), self._typed()):
            if words and words.strip():
                self._take(words, amid=amid)

    def look_between(self) -> None:
        """While no trial is in flight: there is none to skip or to repeat."""
        self.look(amid=False)

    def pause_if_asked(self, ctx: RunContext) -> None:
        """Between two trials, while a pause is requested. Raises OperatorAbort, InterlockTrip."""
        self.look_between()
        if not self.paused:
            return
        with ctx.states.during(RunState.PAUSED):
            how = f"teatbench control {in_command(ctx.store.folder)} go on"
            ctx.events.warn(f"Paused, as asked. Type 'go on' here, or in another terminal: {how}")
            while self.paused:
                ctx.events.state("paused, as asked")
                if isinstance(ctx.clock, VirtualClock):
                    # a person takes real time: without this, days of virtual time would pass
                    RealClock().sleep(REAL_S)
                ctx.wait(PAUSE_POLL_S)

    def _take(self, words: str, *, amid: bool) -> None:
        try:
            request, reason = parse_request(words)
        except ValueError as error:
            self._report(str(error))
            return
        if request == ABORT:
            raise OperatorAbort("the end of the run was requested")
        if request in (PAUSE, GO_ON):
            if request == PAUSE and not self.paused:
                self._report("The run pauses before its next trial.")
            self.paused = request == PAUSE
        elif amid:
            self._report(f"Request accepted: {request} {reason}")
            raise OperatorSkip(reason) if request == SKIP else OperatorRepeat(reason)
        else:
            none = "No trial is in flight just now, so nothing is done about"
            self._report(f"{none}: {request} {reason}")

    def _left(self) -> str | None:
        """Taken away first, then read: a request that is left meanwhile is the next look's."""
        try:
            self._path.replace(self._taken)
            words = self._taken.read_text(encoding="utf-8", errors="replace")
            self._taken.unlink()
        except OSError:  # there is none, or a system that locks files is just writing it
            return None
        return words
