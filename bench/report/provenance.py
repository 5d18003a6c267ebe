"""What others need to check and repeat a report: item, bench, run, calibration, checksums, faults,
command.
"""

from __future__ import annotations

from collections.abc import Iterator

from bench.files import sha256_of
from bench.record.reader import RunRecord
from bench.record.schema import RULES, SCRIPT
from bench.report.wording import key_values, table
from bench.script.calibration_age import CALIBRATION_FACT
from reports.page import Cell, Code, KeyValues, Notes, Paragraph, Part, Table

FAULTS = {
    "camera faults": "Frames that were refused and taken again",
    "retries": "Asks that were repeated",
}
MOST_EVENTS = 60  # at either end
FILES = {
    SCRIPT: "the trials and the rules, as used",
    RULES: "the rules, as used",
    "rig.toml": "the rig, as used",
    "calibration.toml": "the calibration, as used",
}
BESIDE = {
    "../run.sqlite": "every reading, touch, detection, score and event; its digest stands above",
    "trials.csv": "a line a trial and detector",
    "run.json": "facts, verdicts and scores",
    "junit.xml": "a test case a requirement",
}


def provenance_parts(run: RunRecord) -> Iterator[Part]:
    """Who was tested, with what, when, and by which data."""
    facts = run.facts
    for name, item in facts["items"].items():
        yield key_values(f"Item under test: {name}", item)
    yield key_values(
        "Bench and run",
        {
            "folder": run.folder.name,
            "ending": run.ending,
            "started": facts["wall_started"],
            "ended": facts.get("wall_ended"),
            **{name: facts.get(name) for name in ("seed", "rig", "script")},
            **{f"version, {name}": version for name, version in facts["versions"].items()},
            "bench's commit": facts.get("commit"),
            **_chain(run),
        },
    )
    for name, identity in facts.get("identities", {}).items():
        yield key_values(f"Instrument: {name}", identity)
    yield _files(run)
    there = {
        path: what
        for path, what in BESIDE.items()
        if not path.startswith("..") or (run.folder / path.removeprefix("../")).is_file()
    }
    links = ((what, Cell(path.removeprefix("../"), href=path)) for path, what in there.items())
    yield KeyValues("Raw data and exports", tuple(links))
    yield Code("The command that repeats it", str(facts["command"]))
    yield _events(run)


def fault_parts(run: RunRecord) -> Iterator[Part]:
    """Frames taken again and requests repeated; nothing where there were none."""
    for fact, title in FAULTS.items():
        counts = sorted((run.facts.get(fact) or {}).items())
        if counts:
            yield Notes(title, tuple(f"{name}: {count} times" for name, count in counts))


def record_parts(run: RunRecord) -> Iterator[Part]:
    """Who calibrated the cameras, when and with what; nothing where the run has no record."""
    fact = run.facts.get(CALIBRATION_FACT)
    if fact is None:
        return
    if fact["made"] is None:
        emulated = fact["emulated"]
        yield Paragraph(
            "The calibration has no record of who made it, when and with what."
            f" {'The emulated cameras are made from it.' if emulated else 'Its age is not known.'}",
            tone="plain" if emulated else "warn",
        )
        return
    yield key_values(
        "Calibration",
        {
            "made": fact["made"],
            "age": f"{fact['age_days']} days on the day of the run",
            "by": fact["by"] or None,
            "with": fact["with_what"],
            **{f"{name} camera": who for name, who in fact["cameras"].items()},
        },
    )


def _chain(run: RunRecord) -> dict[str, str]:
    """The record's chain, by which `teatbench store check` tells whether it was changed."""
    if run.head is None or not run.head.number:
        return {"record's digest": "none: the bench that wrote the record made no chain"}
    return {
        "record's chain": f"{run.head.number} links",
        "record's digest": run.head.wall_digest,
        "record's digest without real time (repeats with the seed)": run.head.digest,
    }


def _files(run: RunRecord) -> Table:
    """Each file that the run used, with its checksum now; frames are in the record's chain."""
    rows = [
        (Cell(name, href=f"../{name}"), what, Cell(sha256_of(run.folder / name), mono=True))
        for name, what in FILES.items()
        if (run.folder / name).is_file()
    ]
    frames = sum(len(trial.frames) for trial in run.trials)
    note = (
        f"The calibration's at the start was {run.facts['calibration_sha256']}. {frames} pictures"
        " of frames and stages: each one's SHA-256 is in the record."
    )
    return table("Files as used", "file | what | SHA-256", rows, note)


def _events(run: RunRecord) -> Notes:
    """All of them, or of many the first and the last."""
    told = []
    for event in run.events:
        time = "" if event["t_s"] is None else f"{event['t_s']:.0f} s: "
        told.append(f"{time}{event['kind']}: {event['text']}")
    if len(told) > 2 * MOST_EVENTS:
        told[MOST_EVENTS:-MOST_EVENTS] = [f"… {len(told) - 2 * MOST_EVENTS} more, in run.sqlite …"]
    return Notes("Events", tuple(told))
