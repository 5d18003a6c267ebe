"""How figures, verdicts and names become words and ids: the same for terminal, page and exports."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from bench.record.check import NOT_AS_WRITTEN, shortened
from bench.record.reader import RunRecord
from bench.results.verdicts import Judgement, run_verdict
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.rates import percent_apart
from detector.protocol import Outcome
from reports.parts import Verdict as PageVerdict

LONGEST = 60  # with what stands before it an id has room


def id_of(name: str) -> str:
    """A name as a part of an id; where it can't be one, its letters with a few of its hash."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if plain == name and len(name) <= LONGEST:
        return name
    return f"{plain[: LONGEST - 7]}-{hashlib.sha256(name.encode()).hexdigest()[:6]}".lstrip("-")


NOT_MEASURED = "not measured"
LONGEST_WORDS = 200


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """``1.23 mm``; ``not measured`` for None. Whole numbers (counts) without decimals."""
    if value is None:
        return NOT_MEASURED
    text = f"{value:.0f}" if not unit and float(value).is_integer() else f"{value:.{digits}f}"
    return f"{text} {unit}".rstrip()


def measured(decision: Decision) -> str:
    """The decided figure and the one-sided bound decided on: ``100.0 % (at least 60.7 %)``."""
    value, digits = decision.measured, _digits(decision)
    text = number(value, decision.unit, digits)
    if value is None or not decision.uncertainty:
        return text
    if (decision.verdict is Verdict.NOT_MET) == (decision.unit == "%"):
        side, bound = "at most", value + decision.uncertainty
    else:
        side, bound = "at least", value - decision.uncertainty
    told = (
        percent_apart(bound / 100, decision.limit / 100)
        if decision.unit == "%"
        else number(bound, decision.unit, digits)
    )
    return f"{text} ({side} {told})"


def limit(decision: Decision) -> str:
    """The limit with its unit."""
    return number(decision.limit, decision.unit, _digits(decision))


def margin(decision: Decision) -> str:
    """What is left to the limit; negative beyond it."""
    return (
        ""
        if decision.margin is None
        else f"{decision.margin:+.{_digits(decision)}f} {decision.unit}".rstrip()
    )


def _digits(decision: Decision) -> int:
    return {"s": 3, "%": 1, "": 0}.get(decision.unit, 2)


def headline(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[PageVerdict, str, str]:
    """The run's verdict, why, and what to do next; a detector without answers comes first."""
    if run.damage:
        why = f"{NOT_AS_WRITTEN}, so that nothing is decided by it. {shortened(run.damage)}"
        return (
            "no verdict",
            why,
            (
                "Put back the run's folder from a copy; 'teatbench store check' lists all that is"
                " damaged."
            ),
        )
    if run.ending != "finished":
        return "aborted", _why_ended(run), _after_ending(run)
    verdict, why, then = _finished(run, judgements)
    silent = [told for name in run.detectors for told in _silence(run, name)]
    if not silent:
        return verdict, why, then
    first = (
        "First find out why the detector did not answer: its reasons stand with the trials below."
    )
    return (
        verdict,
        "\n".join([*silent, why]),
        f"{first} {then}" if verdict == "not met" else f"{first} Then run it again.",
    )


def _silence(run: RunRecord, detector: str) -> Iterator[str]:
    """How often it gave no answer, with the last reason and the last line that it wrote."""
    rows = [row for trial in run.counted for row in trial.detections if row["detector"] == detector]
    silent = [row for row in rows if row["outcome"] != Outcome.ANSWERED.value]
    if silent:
        reasons = [
            row["reason"] for row in silent if row["outcome"] != Outcome.OFF.value and row["reason"]
        ]
        words = [
            line.strip()
            for row in silent
            for line in (row["wall_stderr"] or "").splitlines()
            if line.strip()
        ]
        last = f' Its last words: "{words[-1][:LONGEST_WORDS]}".' if words else ""
        yield (
            f"{detector} did not answer on {len(silent)} of {len(rows)} frame"
            f" sets{': ' if reasons else ''}{''.join(reasons[-1:])}.{last}"
        )


def _finished(run: RunRecord, judgements: Sequence[Judgement]) -> tuple[PageVerdict, str, str]:
    if not judgements and run.skipped:
        nothing = f"All {len(run.skipped)} trials were left out, so nothing was scored."
        return (
            "no verdict",
            nothing,
            "Remove the reasons, which are listed under the deviations, then run the script again.",
        )
    if not judgements:
        return (
            "no verdict",
            "The recording has no truth, so nothing was scored.",
            "Add truth.csv to the recording, then score it again.",
        )
    verdict = run_verdict(judgements)
    worst = _worst(judgements, verdict)
    return (
        verdict.value,
        _why(worst, len(judgements)),
        _next_action(verdict, worst, judgements[0].of_bench),
    )


def _why_ended(run: RunRecord) -> str:
    told = [event["text"] for event in run.events if event["kind"] in ("fault", "aborted")]
    done, planned = len(run.trials), run.facts.get("planned", "?")
    if run.ending == "interrupted":
        died = f"The bench died before the run was over; {done} of {planned} trials are kept."
        return f"{died} {guardian_told(run.guardian)}" if run.guardian else died
    return (
        f"The run was {run.ending} after {done} of {planned} trials:"
        f" {told[-1] if told else 'no reason was recorded'}."
    )


def guardian_told(record: Mapping[str, Any]) -> str:
    """What happened to the bench and when, and whether the guardian reached standby."""
    when, why = record["wall_noticed"], record["why"]
    befell = {
        "died": f"The bench died at {when}",
        "hung": f"The bench hung ({why}); its last sign of life was at {record['wall_last_sign']}",
        "gave up": f"At {when} the bench gave up: {why}",
    }[record["cause"]]
    if record["standby"]:
        more = " The hung bench kept the port and was ended." if record.get("killed") else ""
        more += f" The pump {record['pump']}." if "pump" in record else ""
        safe = (
            f"the guardian had the bath in standby at {record['wall_safe']},"
            f" {record['seconds']:.1f} s after it took notice"
        )
        return f"{befell}; {safe}.{more}"
    return (
        f"{befell}; THE GUARDIAN COULD NOT REACH THE BATH in {record['tries']} tries"
        f" ({record['error']}): switch it off by hand."
    )


def _after_ending(run: RunRecord) -> str:
    if run.ending == "faulted":
        return (
            "See the events below, remove the cause, check the instruments with 'teatbench check',"
            " then go on with 'teatbench resume'."
        )
    return (
        "Look whether the bath is in standby, then go on with 'teatbench resume'; what is below is"
        " unfinished."
    )


def _worst(judgements: Sequence[Judgement], verdict: Verdict) -> list[tuple[str, Decision]]:
    same = (
        (verdict,)
        if verdict is not Verdict.INCONCLUSIVE
        else (Verdict.INCONCLUSIVE, Verdict.NOT_MEASURED)
    )
    return [(j.detector, d) for j in judgements for d in j.decisions if d.verdict in same]


def _why(worst: Sequence[tuple[str, Decision]], detectors: int) -> str:
    return "\n".join(
        f"{f'{name}: ' if detectors > 1 else ''}{d.name[0].upper()}{d.name[1:]}: {d.sentence}"
        for name, d in worst
    )


def _next_action(
    verdict: Verdict, worst: Sequence[tuple[str, Decision]], of_bench: frozenset[str]
) -> str:
    if verdict is Verdict.MET:
        return (
            "Keep this run folder as the evidence; it names everything that is needed to repeat it."
        )
    named = list(dict.fromkeys(decision.name for _, decision in worst))
    bench, names = (
        ", ".join(name for name in named if (name in of_bench) is of) for of in (True, False)
    )
    if verdict is Verdict.NOT_MET:
        first = (
            f"Put the bench right before all else: {bench}; what it measured may be wrong. "
            if bench
            else ""
        )
        then = "Start with the trials marked below; each shows where its points went wrong."
        return (
            first
            + (
                f"The detector has to become better at: {names}. {then}"
                if names
                else "Then run the script again."
            )
        ).strip()
    first = f"Complete what is missing of: {bench}. " if bench else ""
    return (
        first
        + (
            f"Run more poses to decide: {names}. Each row says how many are missing."
            if names
            else ""
        )
    ).strip()
