"""A run for other programs: ``trials.csv``, ``run.json``, ``junit.xml`` (a case a requirement)."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.files import write_synced
from bench.record.check import NOT_AS_WRITTEN, printed_chain
from bench.record.reader import RunRecord
from bench.results.verdicts import Judgement, run_verdict
from bench.scoring.decisions import Verdict
from reports.sanitize import csv_text, sanitized

COLUMNS = (
    "trial situation repeat detector teats visible found missed false hidden_claimed hidden"
    " max_error_mm mean_error_mm gospa_mm success seconds cold outcome reason bath_c truth invalid"
)


def write_exports(run: RunRecord, judgements: Sequence[Judgement], folder: Path) -> None:
    """Write the three files into ``folder``."""
    write_synced(folder / "trials.csv", _trials_csv(run).encode())
    write_synced(folder / "run.json", _run_json(run, judgements).encode())
    write_synced(folder / "junit.xml", _junit_xml(run, judgements).encode())


def _trials_csv(run: RunRecord) -> str:
    """One line a trial and detector. What was not measured is an empty field."""
    columns = COLUMNS.split()
    rows: list[Sequence[object]] = [columns]
    for trial in run.trials:
        of_trial = {
            "trial": trial.id,
            "teats": len(trial.truth),
            "truth": trial.how or "",
            "invalid": NOT_AS_WRITTEN if run.damage else trial.invalid or "",
            **{key: trial.head[key] for key in ("situation", "repeat", "bath_c")},
        }
        for detection in trial.detections:
            known = {
                **of_trial,
                **{key: detection[key] for key in ("detector", "cold", "outcome")},
                "hidden_claimed": detection["hidden"],
                "seconds": detection["wall_seconds"],
                "reason": detection["reason"] or "",
            }
            if score := trial.scores.get(detection["detector"]):
                counts, radial = score.counts, score.radial_mm
                known |= asdict(counts) | {
                    "found": counts.matched,
                    "gospa_mm": score.gospa_mm,
                    "success": int(score.success),
                    "max_error_mm": max(radial, default=""),
                    "mean_error_mm": sum(radial) / len(radial) if radial else "",
                }
            rows.append([known.get(column, "") for column in columns])
    return csv_text(rows)


def _run_json(run: RunRecord, judgements: Sequence[Judgement]) -> str:
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
                "requirements": [asdict(d) for d in j.decisions],
            }
            for j in judgements
        ],
        "trials": [
            {
                **trial.head,
                "truth": list(map(dict, trial.truth)),
                "detections": [
                    {key: value for key, value in row.items() if key != "trace"}
                    for row in trial.detections
                ],
                "found": list(map(dict, trial.found)),
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
    if (head := run.head) is None:
        return None
    return {"links": head.number, "digest": head.digest, "wall_digest": head.wall_digest}


def _junit_xml(run: RunRecord, judgements: Sequence[Judgement]) -> str:
    """A test case a requirement: not met is a failure, undecided is skipped with its reason."""
    root = ET.Element("testsuites", name=str(run.facts.get("title", run.folder.name)))
    for judgement in judgements:
        suite = ET.SubElement(root, "testsuite", name=judgement.detector)
        for decision in judgement.decisions:
            named = {"classname": judgement.detector, "name": decision.name}
            case = ET.SubElement(suite, "testcase", named)
            if decision.verdict is Verdict.NOT_MET:
                ET.SubElement(case, "failure", message=decision.sentence).text = decision.rule
            elif decision.verdict is not Verdict.MET:
                why = f"{decision.verdict.value}: {decision.sentence}"
                ET.SubElement(case, "skipped", message=why)
        failures, skipped = (len(suite.findall(f".//{kind}")) for kind in ("failure", "skipped"))
        numbers = {"tests": len(suite), "failures": failures, "skipped": skipped, "errors": 0}
        suite.attrib |= {name: str(number) for name, number in numbers.items()}
    ET.indent(root)
    text = sanitized(ET.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n'
