"""What others need to check and repeat a report: item, bench, run, checksums, faults, command."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.record.reader import RunRecord
from bench.record.schema import RULES, SCRIPT
from bench.report import tables
from reports.parts import Cell, Code, KeyValues, Notes, Part, Table, columns

CAMERA_FAULTS, RETRIES = "camera faults", "retries"
MOST_EVENTS = 60  # at either end
FILES = (
    (SCRIPT, "the trials and the rules, as used"),
    (RULES, "the rules, as used"),
    ("rig.toml", "the rig, as used"),
    ("calibration.toml", "the calibration, as used"),
)
BESIDE = (
    ("../run.sqlite", "every reading, touch, detection, score and event; its digest stands above"),
    ("trials.csv", "a line a trial and detector"),
    ("run.json", "facts, verdicts and scores"),
    ("junit.xml", "a test case a requirement"),
)


def provenance_parts(run: RunRecord) -> Iterator[Part]:
    """Who was tested, with what, when, and by which data."""
    facts = run.facts
    for name, item in facts["items"].items():
        yield tables.key_values(f"Item under test: {name}", [*item.items()])
    yield tables.key_values(
        "Bench and run",
        [
            ("folder", run.folder.name),
            ("ending", run.ending),
            ("started", facts["wall_started"]),
            ("ended", facts.get("wall_ended")),
            ("seed", facts.get("seed")),
            ("rig", facts.get("rig")),
            ("script", facts.get("script")),
            *((f"version, {name}", version) for name, version in facts["versions"].items()),
            ("bench's commit", facts.get("commit")),
            *_chain_rows(run),
        ],
    )
    for name, identity in facts.get("identities", {}).items():
        yield tables.key_values(f"Instrument: {name}", list(identity.items()))
    yield _files(run)
    yield _beside(run)
    yield Code("The command that repeats it", str(facts["command"]))
    yield _events(run)


def fault_parts(run: RunRecord) -> Iterator[Part]:
    """Frames taken again and requests repeated; nothing where there were none."""
    faults, retries = run.facts.get(CAMERA_FAULTS), run.facts.get(RETRIES)
    if faults:
        yield Notes(
            "Frames that were refused and taken again",
            tuple(f"{name}: {count} times" for name, count in sorted(faults.items())),
        )
    if retries:
        yield Notes(
            "Asks that were repeated",
            tuple(f"{name}: {count} times" for name, count in sorted(retries.items())),
        )


def _chain_rows(run: RunRecord) -> list[tuple[str, str]]:
    """The record's chain, by which `teatbench store check` tells whether it was changed."""
    if run.head is None or not run.head.number:
        return [("record's digest", "none: the bench that wrote the record made no chain")]
    return [
        ("record's chain", f"{run.head.number} links"),
        ("record's digest", run.head.wall_digest),
        ("record's digest without real time (repeats with the seed)", run.head.digest),
    ]


def _files(run: RunRecord) -> Table:
    """Each file that the run used, with its checksum now; frames are in the record's chain."""
    rows = [
        (Cell(name, href=f"../{name}"), what, Cell(_sha256(run.folder / name), mono=True))
        for name, what in FILES
        if (run.folder / name).is_file()
    ]
    at_start = run.facts["calibration_sha256"]
    frames = sum(len(trial.frames) for trial in run.trials)
    note = (
        f"The calibration's at the start was {at_start}. {frames} pictures of frames and stages:"
        " each one's SHA-256 is in the record."
    )
    return Table("Files as used", columns("file | what | SHA-256"), tuple(rows), note)


def _beside(run: RunRecord) -> KeyValues:
    there = [
        (path, what)
        for path, what in BESIDE
        if not path.startswith("..") or (run.folder / path.removeprefix("../")).is_file()
    ]
    return KeyValues(
        "Raw data and exports",
        tuple((what, Cell(path.removeprefix("../"), href=path)) for path, what in there),
    )


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _events(run: RunRecord) -> Notes:
    """All of them, or of many the first and the last."""
    told = [_event(event) for event in run.events]
    if len(told) > 2 * MOST_EVENTS:
        told[MOST_EVENTS:-MOST_EVENTS] = [f"… {len(told) - 2 * MOST_EVENTS} more, in run.sqlite …"]
    return Notes("Events", tuple(told))


def _event(event: Mapping[str, Any]) -> str:
    time = "" if event["t_s"] is None else f"{event['t_s']:.0f} s: "
    return f"{time}{event['kind']}: {event['text']}"
