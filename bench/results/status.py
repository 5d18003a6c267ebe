"""How a run stands at one moment: the one object that terminal, console, list of runs, JUnit,
report, notifications and JSON show. They take it from nowhere else.

A run under way writes it into `console/live.json` in its folder (`RunStatus.as_dict`); a run that
has ended has it in its record. `read_status` gives either, in any process.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from textwrap import shorten
from typing import Any

from pydantic import TypeAdapter

from bench.record.check import damage_of
from bench.record.reader import RunRecord, read_run
from bench.record.schema import DATABASE
from bench.record.state import NO_ENDING, TRIP, State, holder_of, state_of
from bench.results.doubts import DOUBTS_FACT
from bench.results.headline import (
    AFTER_SILENCE,
    DAMAGED_NEXT,
    damaged_why,
    judged,
    stopped_next,
    stopped_why,
)
from bench.results.verdicts import Judgement, judge, run_verdict, stored_rules
from bench.rig.by_hand import BY_HAND, silent
from bench.rig.devices import Evidence
from bench.safety.bath_monitor import NO_GUARDIAN
from instruments.clock import wall_time as now
from instruments.operators.mailbox import FOLDER, read_prompt
from instruments.operators.operator import time_left
from textfiles.text import in_command, plural, sentence, time_text

VERSION = 1  # of `RunStatus.as_dict`
LIVE, RUN_JSON = "live.json", "report/run.json"
SILENT_S = 5.0  # a bench that has said nothing for longer hangs, or its computer is busy
STARTING, OPENING = "starting", "its files are read and its instruments opened"
LONGEST_ERROR = 60  # in a line of the terminal
LOOK = {"bath": "the bath is in standby", "stage": "the stage stands", "pump": "the pump stands"}
INSTRUMENTS_FACT = "instruments at the end"
GOING_TO_SAFE = "going to safe"
ALL_SAFE = "all instruments are safe"


class LinkState(StrEnum):
    """What is known of the way to an instrument."""

    ANSWERS = "answers"
    SILENT = "silent"  # it is asked, and gives nothing usable
    AWAY = "away"  # the run is paused until it is back
    CLOSED = "closed"  # the run has ended
    UNKNOWN = "not known"  # the bench that had it open has died


class Safe(StrEnum):
    """What an instrument's safe state stands on."""

    IN_USE = "in use"  # it heats, moves or turns by an order of this run
    AT_REST = "at rest"  # it was given no such order, or was read back at rest since
    READ_BACK = Evidence.READ_BACK.value
    SENT = Evidence.SENT.value
    FAILED = Evidence.FAILED.value
    UNKNOWN = "not known"


@dataclass(frozen=True, slots=True)
class InstrumentStatus:
    """One instrument. ``last``: its last value, with unit; ``age_s``: how long ago it last
    answered, None where it never did; ``how``: in what way it is silent, or why it isn't safe;
    ``by_hand``: what a person has to do at it, "" where nothing.
    """

    name: str
    link: LinkState
    safe: Safe
    _: KW_ONLY
    last: str = ""
    age_s: float | None = None
    how: str = ""
    by_hand: str = ""

    @property
    def trouble(self) -> bool:
        """Whether a person has to see it at once."""
        return bool(self.by_hand) or self.link in (LinkState.SILENT, LinkState.AWAY)

    @property
    def text(self) -> str:
        """``bath: no answer for 12 s (last 20.04 degC)``; ``bath 20.04 degC, heating``; ``arm:
        answered 36 s ago``, where it was not asked for so long.
        """
        if self.by_hand:
            return ": ".join(filter(None, (self.by_hand, silent(self.how, self.age_s))))
        if self.link is LinkState.ANSWERS:
            age_s = self.age_s or 0.0
            ago = f"{time_text(age_s)} ago" if age_s >= SILENT_S else ""
            if self.last:
                return f"{self.name} {self.last}" + (f" ({ago})" if ago else "")
            known = "connected" if self.age_s is None else "answers"
            return f"{self.name}: {f'answered {ago}' if ago else known}"
        last = f" (last {self.last})" if self.last else ""
        if self.link in (LinkState.SILENT, LinkState.AWAY):
            # a bath is asked every second, the others when they are needed
            since = " for {}" if self.name == "bath" else ", last answer {} ago"
            since = "" if self.age_s is None else since.format(time_text(self.age_s))
            return f"{self.name}: {self.how or 'no answer'}{since}{last}"
        return f"{self.name}: {SAFE_WORDS[self.safe]}{last}"

    def later(self, seconds: float) -> InstrumentStatus:
        """The same, as it reads so many seconds later."""
        return replace(self, age_s=None if self.age_s is None else self.age_s + seconds)


SAFE_WORDS: Mapping[Safe, str] = {
    Safe.IN_USE: "in use",
    Safe.AT_REST: "at rest",
    Safe.READ_BACK: "safe, read back",
    Safe.SENT: "stop sent, not acknowledged",
    Safe.FAILED: "not safe",
    Safe.UNKNOWN: "not known since the bench died",
}


@dataclass(frozen=True, slots=True)
class OpenPrompt:
    """What a person is asked: its kind (`operator.Kind`), and the prompt's words where a browser
    answers too, with its number; for how long it has been asked.
    """

    kind: str
    text: str = ""
    number: int | None = None
    waited_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RunStatus:
    """A run at ``wall_time``. ``step``: a state of the run (docs/runs.md) or "going to safe", and
    ``state`` once it has ended; ``doing`` says more. ``verdicts``: by detector, ``state`` where
    there is none. ``why`` and ``next`` are sentences, most urgent first. ``emulated``: which of its
    instruments, where others are real. ``rig``: its name. ``age_s``: how old this word of it is.
    """

    run: str
    title: str
    state: State
    step: str
    _: KW_ONLY
    verdicts: Mapping[str, str] = field(default_factory=dict)
    doing: str = ""
    pose: str = ""
    done: int = 0
    skipped: int = 0
    planned: int | None = None
    left_s: float | None = None
    paused: bool = False
    asked: OpenPrompt | None = None
    instruments: tuple[InstrumentStatus, ...] = ()
    tripped: str = ""
    last_error: str = ""
    why: str = ""
    next: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    emulated: tuple[str, ...] = ()
    rig: str = ""
    wall_time: str = ""
    age_s: float = 0.0

    @property
    def mark(self) -> str:
        """What has to stand beside the figures of a rig that is partly emulated; else empty."""
        said = f"SOME INSTRUMENTS EMULATED: {', '.join(self.emulated)}."
        return f"{said} The figures are no measurement." if self.emulated else ""

    @property
    def under_way(self) -> bool:
        return self.state is State.RUNNING

    @property
    def decided(self) -> bool:
        """Whether its verdicts hold: it is whole, and has finished."""
        return self.state is State.FINISHED and not self.damage

    @property
    def unsafe(self) -> tuple[str, ...]:
        """A line an instrument that a person has to make safe, the action first, heat first."""
        order = [*BY_HAND]
        found = [one for one in self.instruments if one.by_hand]
        found.sort(key=lambda one: order.index(one.name) if one.name in order else len(order))
        return tuple(one.text for one in found)

    @property
    def then(self) -> tuple[str, ...]:
        """What to do next beside making safe what is not."""
        return self.next[len(self.unsafe) :]

    @property
    def at_end(self) -> tuple[InstrumentStatus, ...]:
        """The instruments as they stand at the end, their links closed."""
        return tuple(replace(one, link=LinkState.CLOSED) for one in self.instruments)

    @property
    def trials(self) -> str:
        """``trial 3 of 18`` of a run under way, else ``16 of 18 trials, 2 skipped``."""
        of = plural(self.planned, "trial") if self.planned else "? trials"
        if not self.under_way:
            return f"{self.done} of {of}" + (f", {self.skipped} skipped" if self.skipped else "")
        through = self.done + self.skipped
        if through == self.planned:
            return f"all {of} done"
        return f"trial {through + 1} of {self.planned or '?'}"

    @property
    def word(self) -> str:
        """Its one word or two, before all else: a verdict, the state, or "no verdict"."""
        if self.damage:
            return "no verdict"
        if not self.decided:
            return self.state.value
        words = set(self.verdicts.values())
        order = ("not met", "inconclusive", "not measured", "met")
        return next((word for word in order if word in words), "no verdict")

    @property
    def headline(self) -> str:
        """``running: trial 3 of 18``; ``not met: 18 of 18 trials``."""
        safing = self.under_way and self.step == GOING_TO_SAFE
        return f"{self.word}: {GOING_TO_SAFE if safing else self.trials}"

    @property
    def parts(self) -> dict[str, str]:
        """What stands beside what is done: the bath, instruments with a fault, time and error."""
        there = (one for one in self.instruments if one.trouble or one.name == "bath")
        shown = {one.name: one.text for one in there}
        shown |= {} if self.left_s is None else {"left": time_left(self.left_s)}
        return shown | ({"last error": self.last_error} if self.last_error else {})

    @property
    def waiting(self) -> str:
        """``waiting for an answer for 3 min: touch``; empty where nothing is asked."""
        if self.asked is None or self.age_s >= SILENT_S:
            return ""
        where = " at its terminal" if self.asked.number is None else ""
        minutes = int(self.asked.waited_s / 60.0)
        since = f" for {minutes} min" if minutes else ""
        return f"waiting for an answer{where}{since}: {self.asked.kind}"

    @property
    def line(self) -> str:
        """All that a terminal's one line has room for."""
        safing = self.step == GOING_TO_SAFE
        doing = ("" if safing else self.waiting) or self.doing or self.step
        parts = self.parts
        if error := parts.pop("last error", ""):
            parts["error"] = f"last error: {shorten(error, LONGEST_ERROR, placeholder=' …')}"
        return "; ".join(part for part in (self.pose, doing, *parts.values()) if part)

    def later(self, folder: Path | None = None) -> RunStatus:
        """As it reads now, where the bench wrote it at ``wall_time``; ``folder``: the run's, for
        what to do next.
        """
        said_s = (now() - datetime.fromisoformat(self.wall_time)).total_seconds()
        age_s = float(max(0, int(said_s)))  # a computer's clock may have been set back
        instruments = tuple(one.later(age_s) for one in self.instruments)
        asked = self.asked and replace(self.asked, waited_s=self.asked.waited_s + age_s)
        older = replace(self, age_s=age_s, instruments=instruments, asked=asked)
        if age_s < SILENT_S:
            return older
        last = self.doing or self.step
        doing = f"the bench has said nothing for {time_text(age_s)}; last: {last}"
        then = AFTER_SILENCE.format(run=in_command(folder or self.run))
        return replace(older, doing=doing, left_s=None, next=(*older.unsafe, then))

    def as_dict(self) -> dict[str, Any]:
        """As JSON, with its version; units in the keys."""
        shown = asdict(self)
        for of, one in zip(shown["instruments"], self.instruments, strict=True):
            of |= {"text": one.text, "trouble": one.trouble}
        keys = ("word", "headline", "trials", "waiting", "mark")
        said = {key: getattr(self, key) for key in keys}
        return {"schema_version": VERSION, **shown, **said, "unsafe": [*self.unsafe]}


@dataclass(frozen=True, slots=True, eq=False)
class Reported:
    """A run with its report/index.html; ``took``: how long it took, and was expected to."""

    folder: Path
    page: Path
    record: RunRecord
    judgements: tuple[Judgement, ...]
    status: RunStatus
    took: str = ""

    @property
    def verdict(self) -> str:
        """``met``, ``not met``, ``inconclusive`` or ``not measured``, of its worst detector."""
        return run_verdict(self.judgements).value

    @property
    def unchecked(self) -> str:
        """Why it is not known whether a recording's cameras agree; empty where it was checked."""
        from bench.results.cameras_agree import UNCHECKED_FACT

        return str(self.record.facts.get(UNCHECKED_FACT, ""))


def state_in(run: RunRecord) -> State:
    """The one word for how it stood as it was read."""
    return state_of(run.ending, tripped=run.tripped, held=bool(run.holder))


def status_of(run: RunRecord, judgements: Sequence[Judgement] = ()) -> RunStatus:
    """Of a record as it was read, with what was judged of it."""
    state = state_in(run)
    live = _live(run.folder) if run.ending == NO_ENDING else None
    status = RunStatus(
        run=run.folder.name,
        title=str(run.facts.get("title", run.folder.name)),
        state=state,
        step=STARTING if state is State.RUNNING else state.value,
        doing=OPENING if state is State.RUNNING else "",
        verdicts=dict.fromkeys(run.detectors, state.value),
        done=run.done,
        skipped=len(run.skipped),
        planned=run.facts.get("planned"),
        damage=run.damage,
        emulated=tuple(run.facts.get("emulated", ())),
        rig=str(run.facts.get("rig", "")),
        wall_time=str(run.facts.get("wall_ended") or run.facts.get("wall_started", "")),
    )
    if state is State.RUNNING and live:
        status = replace(_as_asked(live.later(run.folder), run.folder), damage=run.damage)
    elif state is not State.FINISHED or run.damage:
        trips = [event["text"] for event in run.events if event["kind"] == TRIP]
        tripped = trips[-1] if trips and run.tripped else ""
        status = replace(status, instruments=_left(run, state, live), tripped=tripped)
    else:
        word = "inconclusive" if run.facts.get(DOUBTS_FACT) else "no verdict"
        made = {one.detector: one.verdict.value for one in judgements}
        verdicts = dict.fromkeys(run.detectors, word) | made
        status = replace(status, verdicts=verdicts, instruments=_left(run, state, live))
    if run.damage:
        status = replace(status, verdicts=dict.fromkeys(run.detectors, "no verdict"))
    if status.decided:
        why, then = judged(run, judgements)
        return replace(status, why=why, next=(*status.unsafe, then))
    why, then = stopped_why(run, state, status.trials), stopped_next(run, state)
    if state is State.RUNNING and not run.damage:
        return replace(status, why=why, next=status.next or (then,))
    if not run.damage and (said := _safety(run, status)):
        return replace(status, why=f"{why} {sentence(said)}", next=(then,))
    look = () if run.damage or run.facts.get("kind") == "recorded" else _look(status)
    return replace(status, why=why, next=(*status.unsafe, *look, then))


def read_status(folder: Path) -> RunStatus:
    """The status of the run in ``folder``, read quickly: verdicts are those of its report, where
    that is of the record as it is; a record that was written to since is checked. Raises
    ConfigError.
    """
    run = read_run(folder, whole=False)
    ended, finished = state_in(run) is not State.RUNNING, run.ending == State.FINISHED
    written = _reported(run) if finished else None
    damage = damage_of(folder) if ended and not _is_reported_since(folder) else ()
    if damage or (written is None and finished and run.done):
        run = read_run(folder, damage)
        judged_too = run.trials and not damage
        return status_of(run, judge(run, stored_rules(folder)) if judged_too else ())
    return replace(status_of(run), **written) if written else status_of(run)


def undecided(said: Mapping[str, Any], damage: Sequence[str]) -> RunStatus:
    """What a report ``said`` of its run, as JSON, once its record is found to be damaged. Raises
    ValueError.
    """
    status: RunStatus = _reader(RunStatus).validate_python(said)
    verdicts = dict.fromkeys(status.verdicts, "no verdict")
    why = damaged_why(damage)
    return replace(status, damage=(*damage,), verdicts=verdicts, why=why, next=(DAMAGED_NEXT,))


def under_way(folder: Path) -> bool:
    """Whether a bench runs in ``folder``."""
    return bool(holder_of(folder))


def live_status(folder: Path) -> RunStatus | None:
    """The last status that a run under way has written; None before the first."""
    return _as_asked(live.later(folder), folder) if (live := _live(folder)) else None


def _reported(run: RunRecord) -> dict[str, Any] | None:
    """What the report says that only the whole record shows, where it is of this very record."""
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        written = json.loads((run.folder / RUN_JSON).read_text(encoding="utf-8"))
        if run.head is None or written["chain"]["wall_digest"] != run.head.wall_digest:
            return None
        said = _reader(RunStatus).validate_python(written["status"])
        return {key: getattr(said, key) for key in ("verdicts", "why", "next", "damage")}
    return None


def _is_reported_since(folder: Path) -> bool:
    """Whether the report was written after all that the record has."""
    with suppress(OSError):
        written_ns = (folder / RUN_JSON).stat().st_mtime_ns
        files = [folder / f"{DATABASE}{end}" for end in ("", "-wal")]
        return written_ns >= max(one.stat().st_mtime_ns for one in files if one.exists())
    return False


@cache
def _reader(kind: Any) -> TypeAdapter[Any]:
    """Takes milliseconds to make."""
    return TypeAdapter(kind)


def _live(folder: Path) -> RunStatus | None:
    """The last status that the run in ``folder`` has written."""
    with suppress(OSError, ValueError, LookupError, TypeError):
        found = json.loads((folder / FOLDER / LIVE).read_bytes())
        said: RunStatus = _reader(RunStatus).validate_python(found["status"])
        return said
    return None


def _as_asked(status: RunStatus, folder: Path) -> RunStatus:
    """With the words of the prompt that waits, where a browser answers it too."""
    prompt = read_prompt(folder)
    if not prompt or not prompt["open"] or status.step == GOING_TO_SAFE:
        return status
    waited_s = status.asked.waited_s if status.asked else 0.0
    asked = OpenPrompt(prompt["kind"], prompt["text"], prompt["number"], waited_s)
    return replace(status, asked=asked)


def _left(run: RunRecord, state: State, live: RunStatus | None) -> tuple[InstrumentStatus, ...]:
    """The instruments as the last session left them."""
    if state is not State.INTERRUPTED:
        stored = run.facts.get(INSTRUMENTS_FACT, {})
        if stored.get("session") != run.sessions:
            return ()
        left: tuple[InstrumentStatus, ...] = _reader(tuple[InstrumentStatus, ...]).validate_python(
            stored["instruments"]
        )
        if not left and run.guardian:  # it got the bath, heated by another run, before the end
            left = (InstrumentStatus("bath", LinkState.CLOSED, Safe.UNKNOWN),)
        return tuple(_since(one, run.guardian) for one in left)
    guardian, alone = run.guardian, run.facts.get("guardian") == NO_GUARDIAN
    known = live.instruments if live else ()
    if guardian and not known:
        known = (InstrumentStatus("bath", LinkState.UNKNOWN, Safe.UNKNOWN),)
    return tuple(_orphaned(one, guardian, alone=alone) for one in known)


def _since(one: InstrumentStatus, guardian: Mapping[str, Any] | None) -> InstrumentStatus:
    """An instrument as its run left it, or as the run's guardian has found it since."""
    if not guardian or not (one.by_hand or one.safe is Safe.UNKNOWN):
        return one
    found = _orphaned(one, guardian, alone=False)
    known = found.safe is Safe.READ_BACK or not one.by_hand
    return replace(found, link=one.link) if known else one


def _orphaned(
    one: InstrumentStatus, guardian: Mapping[str, Any] | None, *, alone: bool
) -> InstrumentStatus:
    """An instrument whose bench has died: what the guardian found, if it had to act."""
    last = one.last.partition(",")[0] if one.name == "bath" else one.last  # it heats no more
    one = replace(one, link=LinkState.UNKNOWN, last=last, how="", by_hand="")
    if one.safe in (Safe.AT_REST, Safe.READ_BACK) or alone:  # emulators end with their bench
        return replace(one, safe=Safe.AT_REST if alone else one.safe)
    if not guardian or one.name not in BY_HAND:
        return replace(one, safe=Safe.UNKNOWN)
    if one.name == "stage":
        found = guardian.get("stage") or {"stands": False}
        safe, error = found["stands"], "not stopped" if "error" in found else "not asked"
    else:
        safe, error = guardian["standby"], f"not reached in {plural(guardian['tries'], 'try')}"
    if safe:
        return replace(one, safe=Safe.READ_BACK)
    return replace(one, safe=Safe.FAILED, how=error, by_hand=BY_HAND[one.name])


def _safety(run: RunRecord, status: RunStatus) -> str:
    """That nothing is left to be made safe; empty where something is, or it is not known."""
    known = status.state is not State.INTERRUPTED
    if known and not status.instruments:
        never_on = run.facts.get(INSTRUMENTS_FACT, {}).get("session") == run.sessions
        return "nothing was switched on" if never_on else ""
    at_rest = {one.safe for one in status.instruments} <= {Safe.AT_REST, Safe.READ_BACK}
    return ALL_SAFE if known and at_rest else ""


def _look(status: RunStatus) -> tuple[str, ...]:
    """What a person has to look at, since it is not known."""
    names = [one.name for one in status.instruments if one.safe is Safe.UNKNOWN]
    names = names if status.instruments else ["bath"]  # an older record says nothing of them
    at = [LOOK[name] for name in names if name in LOOK]
    return (f"Look whether {' and '.join(at)}.",) if at else ()
