"""Why a run's status is what it is, and what to do next, as sentences for `status`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.files import FULL, UNWRITTEN
from bench.record.check import NOT_AS_WRITTEN, shortened
from bench.record.reader import RunRecord
from bench.record.state import State
from bench.results.doubts import AGAIN, DOUBTS_FACT
from bench.results.verdicts import BUSY, TESTS_FACT, Judgement, calls_of, run_verdict
from bench.rig.by_hand import BY_HAND
from bench.safety.latch import latch_beside
from bench.scoring.decisions import Decision, Verdict
from detector.protocol import Outcome
from textfiles.text import capital, full_stop, in_command, plural

LONGEST_WORDS = 200
AFTER_FAULT = (
    "See the events, remove the cause, check the instruments with 'teatbench check {rig}', then"
    " {go_on}."
)
AFTER_LATCH = (
    "See the events, remove the cause, check the instruments with 'teatbench check {rig}',"
    " acknowledge it with 'teatbench bath acknowledge {rig}', then {go_on}."
)
DAMAGED_NEXT = (
    "Put back the run's folder from a copy; 'teatbench store check' lists all that is damaged."
)
AFTER_MISTAKE = "Report it, with the run's folder; its events name it. Then {go_on}."
GO_ON = "go on with 'teatbench resume {run}'"
ANEW = "give its command again, as it can't be resumed"
AFTER_END = "It is unfinished. Go on with 'teatbench resume {run}'."
BEGIN_ANEW = "It is unfinished and can't be resumed. Give its command again."
AFTER_RUN = "Wait for its end, which writes the report."
AFTER_SILENCE = (
    "Look at its terminal. Where it stays silent, end it there, then go on with"
    " 'teatbench resume {run}'."
)
MISTAKE = "a mistake of the bench"
THEN: Mapping[State, str] = {
    State.RUNNING: AFTER_RUN,
    State.FAULTED: AFTER_FAULT,
    State.TRIPPED: AFTER_FAULT,
    State.ABORTED: AFTER_END,
    State.INTERRUPTED: AFTER_END,
}


def damaged_why(damage: Sequence[str]) -> str:
    """Why a record with this damage decides nothing."""
    return f"{NOT_AS_WRITTEN}, so that nothing is decided by it. {shortened(damage)}"


def stopped_why(run: RunRecord, state: State, trials: str) -> str:
    """Why ``run``, which came as far as ``trials``, decides nothing; empty where it may."""
    if run.damage:
        return damaged_why(run.damage)
    if state is State.FINISHED:
        return ""
    if state is State.RUNNING:
        return f"The run goes on: {trials}. Nothing is decided before its end."
    guardian = f" {_in_short(run.guardian)}" if run.guardian else ""
    if state is State.INTERRUPTED:
        return f"The bench died before the run was over; {trials} are kept.{guardian}"
    reason = _last_reason(run) or "no reason was recorded"
    return f"The run was {state} after {trials}: {full_stop(reason)}{guardian}"


def _last_reason(run: RunRecord) -> str:
    texts = (one["text"] for one in reversed(run.events) if one["kind"] in ("fault", "aborted"))
    return str(next(texts, ""))


def stopped_next(run: RunRecord, state: State) -> str:
    """What to do with it then."""
    if run.damage:
        return DAMAGED_NEXT
    asked, reason, then = run.facts.get("asked") or {}, _last_reason(run), THEN[state]
    ends = not asked or bool(asked.get("recorded"))
    if ends and (not asked or then is AFTER_END):
        return AFTER_RUN if state is State.RUNNING else BEGIN_ANEW
    if state is State.FAULTED and not ends and (cure := cure_of(reason, run.folder)):
        return cure
    rig = Path(asked.get("rig") or run.folder)
    if then is AFTER_FAULT:
        then = AFTER_LATCH if latch_beside(rig).exists() else then
        then = AFTER_MISTAKE if reason.startswith(MISTAKE) else then
    go_on = ANEW if ends else GO_ON.format(run=in_command(run.folder))
    return then.format(rig=in_command(rig), run=in_command(run.folder), go_on=go_on)


def cure_of(reason: str, folder: Path) -> str:
    """What to do where the ``reason`` is that the record could not be written; else empty."""
    if not reason.startswith(UNWRITTEN):
        return ""
    cure = f"Make room in {folder}" if FULL in reason else f"Make {folder} writable"
    return f"{cure}, then resume: teatbench resume {in_command(folder)}"


def judged(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[str, str]:
    """Why and what next of a whole and finished run; where several detectors are judged, a line
    for each. A detector without answers comes first.
    """
    if doubts := run.facts.get(DOUBTS_FACT):
        why = "; ".join(doubts)
        wrong = "The calibration can't be that of these pictures"
        return f"{wrong}, so nothing is charged to any detector: {why}.", AGAIN
    if len(judgements) > 1:
        return _each(run, judgements)
    verdict, why, then = _one(run, judgements)
    silent = [message for name in run.detectors for message in _silence(run, name)]
    return "\n".join([*silent, why]), _first_of_silence(silent, verdict, then)


def _first_of_silence(silent: Sequence[str], verdict: Verdict, then: str) -> str:
    """What to do next, where a detector may have been without answers."""
    if not silent:
        return then
    first = "First find out why the detector did not answer: its reasons stand with its trials."
    return f"{first} {then if verdict is Verdict.NOT_MET else 'Then run it again.'}"


def _each(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[str, str]:
    why: list[str] = []
    then: dict[str, list[str]] = {}
    for one in judgements:
        verdict, _, action = _one(run, (one,))
        same = {verdict} | ({Verdict.NOT_MEASURED} if verdict is Verdict.INCONCLUSIVE else set())
        short = [d for d in one.decisions if d.verdict in same]
        full = next((d for d in short if d.missing is not None), None)
        which = "; ".join(missing_text(d, brief=d is not full) for d in short)
        silent = [*_silence(run, one.detector)]
        why += silent
        if verdict is not Verdict.MET:
            why.append(f"{one.detector}: {verdict}: {which}.")
        action = _first_of_silence(silent, verdict, action)
        then.setdefault(action, []).append(one.detector)
    why = why or ["Each detector meets all requirements."]
    return "\n".join(why), "\n".join(f"{', '.join(who)}: {what}" for what, who in then.items())


def missing_text(decision: Decision, *, brief: bool = False) -> str:
    """``p95 (33 more poses without a failure would show it)``; ``brief``: ``p95 (33 more)``."""
    if decision.missing is None:
        return decision.name
    if brief:
        return f"{decision.name} ({decision.missing} more)"
    more = plural(decision.missing, "more pose")
    return f"{decision.name} ({more} without a failure would show it)"


def _silence(run: RunRecord, detector: str) -> Iterator[str]:
    """How often it gave no answer, why mostly, and the last line that it wrote then."""
    rows = [row for _, row in calls_of(run, detector)]
    silent = [row for row in rows if row["outcome"] != Outcome.ANSWERED.value]
    if not silent:
        return
    kinds: dict[str, list[Mapping[str, Any]]] = {}  # by the reason, whatever its numbers
    for row in silent:
        if row["reason"] and row["outcome"] != Outcome.OFF.value:
            kinds.setdefault(re.sub(r"[\d.]+", "", row["reason"].partition(". ")[0]), []).append(
                row
            )
    most = max(kinds.values(), key=len, default=[])
    why = f": {most[-1]['reason']}" if most else ""
    if len(kinds) > 1:
        why = f", for {len(kinds)} reasons, most often ({plural(len(most), 'time')}){why}"
    written = "\n".join(row["wall_stderr"] or "" for row in most or silent).splitlines()
    words = next((line.strip() for line in reversed(written) if line.strip()), "")
    last = f' Its last words: "{words[:LONGEST_WORDS]}".' if words else ""
    yield f"{detector} did not answer on {len(silent)} of {len(rows)} frame sets{why}.{last}"


def _one(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[Verdict, str, str]:
    if not judgements and run.skipped:
        n = len(run.skipped)
        which = "The one trial was" if n == 1 else f"All {n} trials were"
        then = "Remove the reasons, which are listed under the deviations, then run the script"
        return Verdict.NOT_MEASURED, f"{which} left out, so nothing was scored.", f"{then} again."
    if not judgements:
        nothing = "The recording has no truth, so nothing was scored."
        return Verdict.NOT_MEASURED, nothing, "Add truth.csv to the recording, then score it again."
    verdict = run_verdict(judgements)
    same = {verdict} | ({Verdict.NOT_MEASURED} if verdict is Verdict.INCONCLUSIVE else set())
    worst = [(j.detector, d) for j in judgements for d in j.decisions if d.verdict in same]
    why = "\n".join(
        f"{f'{name}: ' if len(judgements) > 1 else ''}{capital(d.name)}: {d.sentence}"
        for name, d in worst
    )
    truth = [row for trial in run.trials for row in trial.truth]
    if truth and verdict is not Verdict.NOT_MET and not any(row["visible"] for row in truth):
        return verdict, why, "No teat end can be seen in any trial: score some in which one can."
    if not run.facts.get(TESTS_FACT, {}).keys().isdisjoint(d.name for _, d in worst):
        return verdict, why, "See why the named tests did not pass, then run them again."
    return verdict, why, _next_action(verdict, [d for _, d in worst], judgements[0].of_bench)


def _in_short(record: Mapping[str, Any]) -> str:
    """The same without what stands in its own line, where the bench itself said NOT SAFE."""
    if record["cause"] == "gave up" and not (record["standby"] or "handed_over" in record):
        return f"The guardian did not reach the bath either, in {plural(record['tries'], 'try')}."
    return guardian_text(record)


def guardian_text(record: Mapping[str, Any]) -> str:
    """What happened to the bench and when, and whether the guardian reached standby."""
    when, why = record["wall_noticed"], record["why"]
    what = {
        "died": f"The bench died at {when}",
        "hung": f"The bench hung ({why}); its last sign of life was at {record['wall_last_sign']}",
        "gave up": f"At {when} the bench gave up: {why}",
    }[record["cause"]]
    more = ""
    if stage := record.get("stage"):
        more = " The stage stands, by its own report."
        if not stage["stands"]:
            more = f" {BY_HAND['stage']}: IT COULD NOT BE STOPPED ({stage['error']})."
    if not record["standby"] and "handed_over" in record:
        return (
            f"{what}; the guardian had not reached the bath in {plural(record['tries'], 'try')}"
            f" ({record['error']}) when it handed it over to a later session at"
            f" {record['handed_over']}.{more}"
        )
    if not record["standby"]:
        return (
            f"{what}. {BY_HAND['bath']}: THE GUARDIAN COULD NOT REACH THE BATH in"
            f" {plural(record['tries'], 'try')} ({str(record['error']).rstrip('.')}).{more}"
        )
    more += " The hung bench kept the port and was ended." if record.get("killed") else ""
    more += f" The pump {record['pump']}." if "pump" in record else ""
    if "handed_over" in record:
        more += f" It handed the bath over to a later session at {record['handed_over']}."
    return (
        f"{what}; the guardian had the bath in standby at {record['wall_safe']},"
        f" {record['seconds']:.1f} s after it took notice.{more}"
    )


def _next_action(verdict: Verdict, which: Sequence[Decision], of_bench: frozenset[str]) -> str:
    if verdict is Verdict.MET:
        return "Keep the run's folder as evidence."
    bench = "; ".join(dict.fromkeys(one.name for one in which if one.name in of_bench))
    own = [one for one in which if one.name not in of_bench]
    empty = [one.name for one in own if one.verdict is Verdict.NOT_MEASURED]
    busy = [one.name for one in own if one.missing is None and BUSY in one.sentence]
    names = "; ".join(dict.fromkeys(o.name for o in own if o.name not in (*empty, *busy)))
    if verdict is Verdict.NOT_MET:
        first = f"Put the bench right before all else: {bench}; what it measured may be wrong."
        then = "The detector has to become better." if names else "Then run the script again."
    else:
        first = f"Complete what is missing of: {bench}."
        most = max((one.missing for one in own if one.missing is not None), default=None)
        many = "Run more poses" if most is None else f"Run {plural(most, 'more pose')}"
        then = f"{many} to decide: {names}." if names else ""
        idle = "Run it again on an idle machine to decide"
        then += f" {idle}: {'; '.join(dict.fromkeys(busy))}." if busy else ""
        look = "Look at the trials: poses such as these measure nothing of"
        then += f" {look}: {'; '.join(dict.fromkeys(empty))}." if empty else ""
    return f"{first} {then.strip()}".strip() if bench else then.strip()
