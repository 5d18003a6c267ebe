"""A run for other programs: ``trials.csv``, ``run.json``, ``junit.xml`` (a case a requirement)."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.files import write_synced
from bench.record.check import NOT_AS_WRITTEN, printed_chain
from bench.record.reader import RunRecord
from bench.results.verdicts import Judgement, run_verdict
from bench.scoring.decisions import Decision, Verdict
from reports.sanitize import csv_text, sanitized

COLUMNS = (
    "trial",
    "situation",
    "repeat",
    "detector",
    "teats",
    "visible",
    "found",
    "missed",
    "false",
    "hidden_claimed",
    "hidden",
    "max_error_mm",
    "mean_error_mm",
    "gospa_mm",
    "success",
    "seconds",
    "cold",
    "outcome",
    "reason",
    "bath_c",
    "truth",
    "invalid",
)


def write_exports(run: RunRecord, judgements: Sequence[Judgement], folder: Path) -> None:
    """Write the three files into ``folder``."""
    write_synced(folder / "trials.csv", trials_csv(run).encode())
    write_synced(folder / "run.json", run_json(run, judgements).encode())
    write_synced(folder / "junit.xml", junit_xml(run, judgements).encode())


def trials_csv(run: RunRecord) -> str:
    """One line a trial and detector. What was not measured is an empty field."""
    rows: list[Sequence[object]] = [COLUMNS]
    for trial in run.trials:
        for detection in trial.detections:
            score = trial.scores.get(detection["detector"])
            radial = score.radial_mm if score else ()
            head = [
                trial.id,
                trial.head["situation"],
                trial.head["repeat"],
                detection["detector"],
                len(trial.truth),
            ]
            counts = (
                [
                    score.counts.visible,
                    score.counts.matched,
                    score.counts.missed,
                    score.counts.false,
                ]
                if score
                else ["", "", "", ""]
            )
            hidden = [detection["hidden"], score.match.hidden if score else ""]
            errors = [max(radial), sum(radial) / len(radial)] if radial else ["", ""]
            tail = [score.gospa_mm if score else "", int(score.success) if score else ""]
            rows.append(
                [
                    *head,
                    *counts,
                    *hidden,
                    *errors,
                    *tail,
                    detection["wall_seconds"],
                    detection["cold"],
                    detection["outcome"],
                    detection["reason"] or "",
                    trial.head["bath_c"],
                    trial.how or "",
                    NOT_AS_WRITTEN if run.damage else trial.invalid or "",
                ]
            )
    return csv_text(rows)


def run_json(run: RunRecord, judgements: Sequence[Judgement]) -> str:
    """Facts, verdicts and all scores of the run."""
    table = {
        "facts": dict(run.facts),
        "ending": run.ending,
        "chain": _chain(run),
        **({"damage": list(run.damage)} if run.damage else {}),
        "verdict": run_verdict(judgements).value,
        "judgements": [
            {
                "detector": j.detector,
                "verdict": j.verdict.value,
                "requirements": [d.as_dict() for d in j.decisions],
            }
            for j in judgements
        ],
        "trials": [
            {
                **trial.head,
                "truth": [dict(row) for row in trial.truth],
                "detections": [
                    {key: value for key, value in row.items() if key != "trace"}
                    for row in trial.detections
                ],
                "found": [dict(row) for row in trial.found],
                "scores": {name: score.as_dict() for name, score in trial.scores.items()},
            }
            for trial in run.trials
        ],
    }
    return json.dumps(table, indent=1, ensure_ascii=False) + "\n"


def _chain(run: RunRecord) -> Any:
    """The record's last link; "" for a damaged record, so that its damage is found again."""
    if run.damage:
        with suppress(OSError, ValueError, AttributeError, RecursionError):
            return printed_chain(run.folder)
        return None
    return (
        {"links": run.head.number, "digest": run.head.digest, "wall_digest": run.head.wall_digest}
        if run.head
        else None
    )


def junit_xml(run: RunRecord, judgements: Sequence[Judgement]) -> str:
    """A test case a requirement: not met is a failure, undecided is skipped with its reason."""
    root = ET.Element("testsuites", name=str(run.facts.get("title", run.folder.name)))
    for judgement in judgements:
        decisions = judgement.decisions
        failures = sum(d.verdict is Verdict.NOT_MET for d in decisions)
        undecided = sum(
            d.verdict in (Verdict.INCONCLUSIVE, Verdict.NOT_MEASURED) for d in decisions
        )
        numbers = {
            "tests": str(len(decisions)),
            "failures": str(failures),
            "skipped": str(undecided),
            "errors": "0",
        }
        suite = ET.SubElement(root, "testsuite", {"name": judgement.detector, **numbers})
        for decision in decisions:
            _case(suite, judgement.detector, decision)
    ET.indent(root)
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        + sanitized(ET.tostring(root, encoding="unicode"))
        + "\n"
    )


def _case(suite: ET.Element, detector: str, decision: Decision) -> None:
    case = ET.SubElement(suite, "testcase", classname=detector, name=decision.name)
    if decision.verdict is Verdict.NOT_MET:
        ET.SubElement(case, "failure", message=decision.sentence).text = decision.rule
    elif decision.verdict is not Verdict.MET:
        ET.SubElement(case, "skipped", message=f"{decision.verdict.value}: {decision.sentence}")
