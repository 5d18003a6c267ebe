"""A run for other programs: ``trials.csv``, ``run.json``, ``junit.xml`` (a case a requirement)."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.config import writing
from bench.files import write_together
from bench.record.check import NOT_AS_WRITTEN, DamagedError, damage_text, printed_chain
from bench.record.looks import id_of
from bench.record.reader import RunRecord
from bench.results.doubts import DOUBTS_FACT
from bench.results.queue import QueueStatus
from bench.results.status import RunStatus, undecided
from bench.results.verdicts import Judgement, run_verdict
from bench.scoring.decisions import Decision, Verdict
from reports.sanitize import csv_text, sanitized
from textfiles.text import full_stop

VERSION = 1  # of `run.json`
PAGE, JUNIT, RUN_JSON, HAS_VERDICT = "index.html", "junit.xml", "run.json", "the run has a verdict"
# the suite, the case, the kind of its element or "", the message and the text of that
Case = tuple[str, str, str, str, str]
BENCH = "bench"  # the suite of its own requirements, where several detectors were judged
COLUMNS = (
    "trial situation repeat detector teats visible found missed false hidden_claimed hidden"
    " max_error_mm mean_error_mm gospa_mm success seconds cold outcome reason bath_c truth invalid"
)


def write_exports(
    run: RunRecord, status: RunStatus, judgements: Sequence[Judgement], folder: Path
) -> None:
    """Write the three files into ``folder``, or none."""
    text, junit = _run_json(run, status, judgements), _junit_xml(run, status, judgements)
    texts = {"trials.csv": _trials_csv(run), RUN_JSON: text, JUNIT: junit}
    write_together(folder, ((name, text.encode()) for name, text in texts.items()))


def has_report(folder: Path, damage: Sequence[str]) -> bool:
    """Whether there is a report, and one of before the ``damage`` to its record doesn't count."""
    report = folder / "report"
    with suppress(OSError, ValueError, LookupError, TypeError):
        said = bool(damage and not json.loads((report / RUN_JSON).read_bytes())["damage"])
        return (report / PAGE).is_file() and not said
    return False


def drop_report(folder: Path) -> None:
    """Remove what a report says of the run in ``folder``: it goes on."""
    for name in (PAGE, "whole.html", RUN_JSON, JUNIT, "trials.csv", "report.pdf"):
        (folder / "report" / name).unlink(missing_ok=True)


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


def _run_json(run: RunRecord, status: RunStatus, judgements: Sequence[Judgement]) -> str:
    """Facts, verdicts and all scores of the run."""
    table = {
        "schema_version": VERSION,
        "facts": dict(run.facts),
        "ending": run.ending,
        "state": status.state.value,
        "status": status.as_dict(),
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
    }
    # a line a trial: indented, JSON is written in Python and takes ten times as long
    trials = (
        {
            **trial.head,
            "truth": trial.truth,
            "detections": [
                {key: value for key, value in row.items() if key != "trace"}
                for row in trial.detections
            ],
            "found": trial.found,
            "scores": {name: score.as_dict() for name, score in trial.scores.items()},
        }
        for trial in run.trials
    )
    lines = ",\n".join(json.dumps(trial, ensure_ascii=False) for trial in trials)
    head = json.dumps(table, indent=1, ensure_ascii=False).removesuffix("\n}")
    return f'{head},\n "trials": [\n{lines}\n ]\n}}\n'


def _chain(run: RunRecord) -> Any:
    """The record's last link; "" for a damaged record, so that its damage is found again."""
    if run.damage:
        with suppress(OSError, ValueError, AttributeError, RecursionError):
            return printed_chain(run.folder)
        return None
    if (head := run.head) is None:
        return None
    return {"links": head.number, "digest": head.digest, "wall_digest": head.wall_digest}


def _junit_xml(run: RunRecord, status: RunStatus, judgements: Sequence[Judgement]) -> str:
    """A test case a requirement: not met is a failure, undecided is skipped with its reason. A run
    without a verdict has a case of its own that is an error, for readers of this file alone. Of
    two suites with one name, id and time stamp Jenkins drops one: the id is the run's.
    """
    several = len(judgements) > 1  # else its requirements stand with the one detector's
    cases = list(
        dict.fromkeys(
            (
                BENCH if several and decision.name in judgement.of_bench else judgement.detector,
                decision.name,
                *_outcome(decision),
            )
            for judgement in judgements
            for decision in judgement.decisions
        )
    )
    if not status.decided or DOUBTS_FACT in run.facts:
        why = "\n".join((status.why, *status.unsafe))
        cases = [(who, name, "skipped", why, "") for who, name, *_ in cases]
        then = "\n".join(status.next)
        cases = [*((who, HAS_VERDICT, "error", why, then) for who in run.detectors), *cases]
    elif not cases:
        nothing = "nothing was scored, so no requirement was decided"
        cases = [(who, "requirements", "skipped", nothing, "") for who in run.detectors]
    known_as = f"{run.folder.resolve().name} {id_of(run)}"
    title = str(run.facts.get("title", run.folder.name))
    return _junit(title, known_as, cases, *_span(run), status.mark)


@contextmanager
def report_withdrawn(folder: Path) -> Iterator[None]:
    """Where the record in ``folder`` is refused, what its report said before may not stay: there
    are a junit.xml with an error then, and a run.json that decides nothing. Raises ConfigError.
    """
    try:
        yield
    except DamagedError as refused:
        if folder in refused.folders:
            name, why = folder.resolve().name, damage_text(refused.damage)
            text = _junit(name, name, [("record", HAS_VERDICT, "error", why, "")])
            files = {JUNIT: text.encode(), **_undecided(folder, refused.damage)}
            with writing(folder):
                drop_report(folder)
                (folder / "report").mkdir(exist_ok=True)
                write_together(folder / "report", files.items())
        raise


def _undecided(folder: Path, damage: Sequence[str]) -> dict[str, bytes]:
    """The run.json that is there without its verdicts and trials: by its chain the damage is found
    again. Empty where there is none.
    """
    with suppress(OSError):
        data = (folder / "report" / RUN_JSON).read_bytes()
        with suppress(ValueError, TypeError, LookupError):
            table = json.loads(data)
            status = undecided(table["status"], damage).as_dict()
            none: dict[str, Any] = {
                "verdict": run_verdict(()).value,
                "judgements": [],
                "trials": [],
            }
            table |= {**none, "status": status, "damage": [*damage]}
            data = json.dumps(table, indent=1, ensure_ascii=False).encode()
        return {RUN_JSON: data}
    return {}


def write_queue_errors(out: Path, queue: QueueStatus) -> None:
    """A junit.xml in a folder of the queue's own, where one finds those of runs, with an error for
    each script whose run has none; no file where each has one. Raises OSError.
    """
    of_queue = out / queue.name / "report"
    missing = [one for one in queue.scripts if not (out / one.run / "report" / JUNIT).is_file()]
    missing = [one for one in queue.scripts if not one.run or one in missing]
    if not missing:
        (of_queue / JUNIT).unlink(missing_ok=True)
        return
    ended = full_stop(queue.headline)
    cases = [
        (one.script, HAS_VERDICT, "error", f"{one.text}. The queue {ended}", "") for one in missing
    ]
    of_queue.mkdir(parents=True, exist_ok=True)
    text = _junit(f"Queue on {queue.rig}", queue.name, cases, queue.started)
    write_together(of_queue, [(JUNIT, text.encode())])


def _junit(
    title: str,
    known_as: str,
    cases: Sequence[Case],
    started: str = "",
    took_s: float = 0.0,
    mark: str = "",
) -> str:
    """The file of ``cases``, a suite for each that they are of."""
    share_s = f"{took_s / max(1, len(cases)):.3f}"
    root = ET.Element("testsuites", name=title)
    root.set("time", f"{took_s:.3f}")
    for detector in dict.fromkeys(who for who, *_ in cases):
        suite = ET.SubElement(root, "testsuite", name=detector, id=known_as)
        if started:
            suite.set("timestamp", started)
        if mark:
            marks = ET.SubElement(suite, "properties")
            ET.SubElement(marks, "property", name="mark", value=mark)
        those = [one for one in cases if one[0] == detector]
        for _, name, kind, message, rule in those:
            named = {"classname": detector, "name": name, "time": share_s}
            case = ET.SubElement(suite, "testcase", named)
            if kind:
                ET.SubElement(case, kind, message=message).text = rule or None
        kinds = {"failures": "failure", "skipped": "skipped", "errors": "error"}
        numbers = {name: len(suite.findall(f".//{kind}")) for name, kind in kinds.items()}
        suite.attrib |= {name: str(n) for name, n in {"tests": len(those), **numbers}.items()}
        suite.set("time", f"{float(share_s) * len(those):.3f}")
    ET.indent(root)
    text = sanitized(ET.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n'


def _outcome(decision: Decision) -> tuple[str, str, str]:
    """The element of a case, its message and its text; an empty element where it is met."""
    if decision.verdict is Verdict.MET:
        return "", "", ""
    if decision.verdict is Verdict.NOT_MET:
        return "failure", decision.sentence, decision.rule
    return "skipped", f"{decision.verdict.value}: {decision.sentence}", ""


def _span(run: RunRecord) -> tuple[str, float]:
    """When it began, ISO 8601, and the seconds to its last event; 0 where damage hides that."""
    started = str(run.facts["wall_started"])
    with suppress(ValueError, TypeError):
        begun = datetime.fromisoformat(started)
        ended = (datetime.fromisoformat(event["wall_time"]) for event in run.events)
        return started, (max(begun, *ended, begun) - begun).total_seconds()
    return started, 0.0
