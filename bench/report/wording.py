"""How values become text, tables and ids, and a run's verdict a headline: once for page, terminal
and exports.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bench.record.reader import RunRecord
from bench.record.state import State
from bench.results.doubts import AGAIN, DOUBTS_FACT
from bench.results.exports import why_without_verdict
from bench.results.verdicts import Judgement, calls_of, run_verdict
from bench.rig.by_hand import BY_HAND
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.rates import percent_apart
from detector.protocol import Outcome
from reports.page import Align, Cell, Column, KeyValues, Table
from reports.page import Verdict as PageVerdict

LONGEST = 60  # with what stands before it an id has room
NOT_MEASURED = "not measured"
LONGEST_WORDS = 200
DIGITS = {"s": 3, "%": 1, "": 0}  # of a decision's figures by unit; 2 of the others


def id_of(name: str) -> str:
    """A name as a part of an id; where it can't be one, its letters with a few of its hash."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if plain == name and len(name) <= LONGEST:
        return name
    return f"{plain[: LONGEST - 7]}-{hashlib.sha256(name.encode()).hexdigest()[:6]}".lstrip("-")


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """``1.23 mm``; ``not measured`` for None. Whole numbers (counts) without decimals."""
    if value is None:
        return NOT_MEASURED
    text = f"{value:.0f}" if not unit and float(value).is_integer() else f"{value:.{digits}f}"
    return f"{text} {unit}".rstrip()


def listed(values: Iterable[float], form: str = ".2f") -> str:
    """``1.00, 2.00, 3.00``."""
    return ", ".join(f"{value:{form}}" for value in values)


def p_text(p: float | None) -> str:
    """A p-value to three digits; empty for None."""
    return "" if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"


def xyz(row: Mapping[str, Any], prefix: str = "") -> str:
    """The point of a record's row, mm."""
    return listed((row[f"{prefix}{axis}_mm"] for axis in "xyz"), ".1f")


def spanned(values: Any, form: str = ".2f", unit: str = "") -> str:
    """``1.00 to 2.00 mm``, the least and the greatest; ``not measured`` where there is none."""
    if not len(values):
        return NOT_MEASURED
    return f"{min(values):{form}} to {max(values):{form}} {unit}".rstrip()


def shown(value: Any, form: str = "") -> str | Cell:
    """A table's value as text, by the format ``form`` or as `number`; several are listed. None is
    ``not measured``, or empty where ``form`` ends with ``?``.
    """
    if isinstance(value, str | Cell):
        return value
    if value is None:
        return "" if form.endswith("?") else NOT_MEASURED
    form = form.removesuffix("?")
    if np.ndim(value):
        return listed(value, form)
    return f"{value:{form}}" if form else number(value)


def table(
    caption: str,
    heads: str | Sequence[str | Column],
    rows: Iterable[Sequence[Any]],
    note: str = "",
    *,
    searchable: bool = False,
) -> Table:
    """A table. ``heads`` are ``title | >title [unit] ~form # hint``: ``>`` aligns right, ``form``
    formats the values as `shown` does. A title from a user comes as a `Column`.
    """
    made: list[tuple[Column, str]] = []
    for head in [heads] if isinstance(heads, str) else heads:
        made += [(head, "")] if isinstance(head, Column) else map(_column, head.split(" | "))
    columns, forms = zip(*made, strict=True)
    cells = (tuple(shown(*pair) for pair in zip(row, forms, strict=True)) for row in rows)
    return Table(caption, columns, tuple(cells), note, searchable)


def _column(text: str) -> tuple[Column, str]:
    rest, _, hint = text.partition(" # ")
    rest, _, form = rest.partition(" ~")
    title, _, unit = rest.partition(" [")
    align: Align = "right" if title.startswith(">") else "left"
    return Column(title.removeprefix(">"), align, unit.removesuffix("]"), hint), form


def key_values(title: str, entries: Mapping[str, object]) -> KeyValues:
    """A list of names and values as text."""
    said = (
        value if isinstance(value, Cell) else NOT_MEASURED if value is None else str(value)
        for value in entries.values()
    )
    return KeyValues(title, tuple(zip(entries, said, strict=True)))


def measured(decision: Decision) -> str:
    """The decided figure and the one-sided bound decided on: ``100.0 % (at least 60.7 %)``."""
    value, unit, digits = decision.measured, decision.unit, DIGITS.get(decision.unit, 2)
    text = number(value, unit, digits)
    if value is None or not decision.uncertainty:
        return text
    above = (decision.verdict is Verdict.NOT_MET) == (unit == "%")
    bound = value + decision.uncertainty if above else value - decision.uncertainty
    said = number(bound, unit, digits)
    if unit == "%":
        said = percent_apart(bound / 100, decision.limit / 100)
    return f"{text} ({'at most' if above else 'at least'} {said})"


def limit(decision: Decision) -> str:
    """The limit with its unit."""
    return number(decision.limit, decision.unit, DIGITS.get(decision.unit, 2))


def margin(decision: Decision) -> str:
    """What is left to the limit; negative beyond it."""
    if decision.margin is None:
        return ""
    return f"{decision.margin:+.{DIGITS.get(decision.unit, 2)}f} {decision.unit}".rstrip()


def headline(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[PageVerdict, str, str]:
    """The run's verdict, why, and what to do next; a detector without answers comes first."""
    why = why_without_verdict(run)
    if run.damage:
        then = "Put back the run's folder from a copy; 'teatbench store check' lists all that is"
        return "no verdict", why, f"{then} damaged."
    if why:
        state = run.state
        if state is State.INTERRUPTED and run.guardian:
            why += f" {guardian_text(run.guardian)}"
        return STOPPED[state], why, THEN[state]
    if doubts := run.facts.get(DOUBTS_FACT):
        why = "; ".join(doubts)
        said = f"The calibration can't be, so nothing is charged to any detector: {why}."
        return "inconclusive", said, AGAIN
    verdict, why, then = _finished(run, judgements)
    silent = [message for name in run.detectors for message in _silence(run, name)]
    if not silent:
        return verdict, why, then
    first = (
        "First find out why the detector did not answer: its reasons stand with the trials below."
    )
    then = then if verdict == "not met" else "Then run it again."
    return verdict, "\n".join([*silent, why]), f"{first} {then}"


def headlines(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[str, str]:
    """Why and what next where several detectors are judged, a line for each."""
    why: list[str] = []
    then: dict[str, list[str]] = {}
    for one in judgements:
        verdict, _, action = _finished(run, (one,))
        names = [d.name for d in one.decisions if d.verdict.value == verdict]
        if verdict == "inconclusive":
            names += [d.name for d in one.decisions if d.verdict is Verdict.NOT_MEASURED]
        which = "all requirements" if verdict == "met" else ", ".join(names)
        why += [*_silence(run, one.detector), f"{one.detector}: {verdict}: {which}."]
        then.setdefault(action, []).append(one.detector)
    return "\n".join(why), "\n".join(f"{', '.join(who)}: {what}" for what, who in then.items())


def _silence(run: RunRecord, detector: str) -> Iterator[str]:
    """How often it gave no answer, with the last reason and the last line that it wrote."""
    rows = [row for _, row in calls_of(run, detector)]
    silent = [row for row in rows if row["outcome"] != Outcome.ANSWERED.value]
    if not silent:
        return
    reasons = [row["reason"] for row in silent if row["outcome"] != Outcome.OFF.value]
    why = next((f": {reason}" for reason in reversed(reasons) if reason), "")
    written = "\n".join(row["wall_stderr"] or "" for row in silent).splitlines()
    words = next((line.strip() for line in reversed(written) if line.strip()), "")
    last = f' Its last words: "{words[:LONGEST_WORDS]}".' if words else ""
    yield f"{detector} did not answer on {len(silent)} of {len(rows)} frame sets{why}.{last}"


def _finished(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[PageVerdict, str, str]:
    if not judgements and run.skipped:
        n = len(run.skipped)
        which = "The one trial was" if n == 1 else f"All {n} trials were"
        nothing = f"{which} left out, so nothing was scored."
        then = "Remove the reasons, which are listed under the deviations, then run the script"
        return "no verdict", nothing, f"{then} again."
    if not judgements:
        nothing = "The recording has no truth, so nothing was scored."
        return "no verdict", nothing, "Add truth.csv to the recording, then score it again."
    verdict = run_verdict(judgements)
    same = {verdict}
    if verdict is Verdict.INCONCLUSIVE:
        same.add(Verdict.NOT_MEASURED)
    worst = [(j.detector, d) for j in judgements for d in j.decisions if d.verdict in same]
    why = "\n".join(
        f"{f'{name}: ' if len(judgements) > 1 else ''}{d.name[0].upper()}{d.name[1:]}: {d.sentence}"
        for name, d in worst
    )
    names = list(dict.fromkeys(decision.name for _, decision in worst))
    return verdict.value, why, _next_action(verdict, names, judgements[0].of_bench)


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
            f"{what}; the guardian had not reached the bath in {record['tries']} tries"
            f" ({record['error']}) when it handed it over to a later session at"
            f" {record['handed_over']}.{more}"
        )
    if not record["standby"]:
        return (
            f"{what}. {BY_HAND['bath']}: THE GUARDIAN COULD NOT REACH THE BATH in"
            f" {record['tries']} tries ({record['error']}).{more}"
        )
    more += " The hung bench kept the port and was ended." if record.get("killed") else ""
    more += f" The pump {record['pump']}." if "pump" in record else ""
    if "handed_over" in record:
        more += f" It handed the bath over to a later session at {record['handed_over']}."
    return (
        f"{what}; the guardian had the bath in standby at {record['wall_safe']},"
        f" {record['seconds']:.1f} s after it took notice.{more}"
    )


AFTER_FAULT = (
    "See the events below, remove the cause, check the instruments with 'teatbench check', then go"
    " on with 'teatbench resume'."
)
AFTER_END = (
    "Look whether the bath is in standby, then go on with 'teatbench resume'; what is below is"
    " unfinished."
)


AFTER_RUN = (
    "Wait for its end, which writes the report anew; 'teatbench console' shows it meanwhile."
)
THEN: Mapping[State, str] = {
    State.RUNNING: AFTER_RUN,
    State.FAULTED: AFTER_FAULT,
    State.TRIPPED: AFTER_FAULT,
    State.ABORTED: AFTER_END,
    State.INTERRUPTED: AFTER_END,
}
STOPPED: Mapping[State, PageVerdict] = {
    State.RUNNING: "running",
    State.FAULTED: "faulted",
    State.TRIPPED: "tripped",
    State.ABORTED: "aborted",
    State.INTERRUPTED: "interrupted",
}


def _next_action(verdict: Verdict, named: Sequence[str], of_bench: frozenset[str]) -> str:
    if verdict is Verdict.MET:
        return (
            "Keep this run folder as the evidence; it names everything that is needed to repeat it."
        )
    bench, names = (
        ", ".join(name for name in named if (name in of_bench) is of) for of in (True, False)
    )
    if verdict is Verdict.NOT_MET:
        first = f"Put the bench right before all else: {bench}; what it measured may be wrong."
        then = (
            f"The detector has to become better at: {names}. Start with the trials marked below;"
            " each shows where its points went wrong."
            if names
            else "Then run the script again."
        )
    else:
        first = f"Complete what is missing of: {bench}."
        then = f"Run more poses to decide: {names}. Each row says how many are missing."
        then = then if names else ""
    return f"{first} {then}".strip() if bench else then
