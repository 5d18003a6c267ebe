"""Runs afterwards: listed, compared, checked, exported and packed; and one under way, asked to
pause or to end. ``damage`` is what `checked_first` found of the records; without it each record is
checked first, and one that isn't as it was written is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.config import ConfigError, check_within, several, writing, wrong_use
from bench.files import write_synced
from bench.record.check import NOT_AS_WRITTEN, Damage, known_damage
from bench.results.comparison import Comparison, PooledRuns, compare_folders, judge_folders
from bench.results.status import read_status
from bench.run.interruptions import leave_request, was_taken
from instruments.clock import RealClock
from textfiles.bounds import MARGIN, SHARE

DAMAGED = "NOT-AS-WRITTEN.txt"  # beside what was exported of a damaged record
TAKEN_S = 10.0  # a run looks once a second; a capture or a detection may take longer


def compare_runs(
    runs: Sequence[Path | str],
    detectors: Sequence[str] = (),
    *,
    margin_mm: float | None = None,
    confidence: float = 0.95,
    damage: Damage = None,
) -> tuple[Comparison, ...]:
    """Compare each later run with the first, or the detectors of one run with its first, on the
    trials that both have: `teatbench compare`. ``margin_mm``: how much larger an error may be (5 %
    of the limit for None). The look is written into the records. Raises ConfigError where nothing
    can be compared.
    """
    folders, detectors = [*map(Path, several("runs", runs, 1))], several("detectors", detectors)
    check_within(SHARE, confidence=confidence)
    check_within(MARGIN, margin_mm=margin_mm)
    with known_damage(folders, damage) as there:
        return compare_folders(
            folders, detectors, margin_mm=margin_mm, confidence=confidence, damage=there
        )


def judge_together(
    runs: Sequence[Path | str],
    detectors: Sequence[str] = (),
    *,
    across_scripts: bool = False,
    damage: Damage = None,
) -> tuple[PooledRuns, ...]:
    """Judge each detector on all runs as one, by the first run's requirements: `teatbench compare
    --together`. The look is written into the records. Raises ConfigError, also for runs of several
    scripts without ``across_scripts``.
    """
    folders, detectors = [*map(Path, several("runs", runs, 1))], several("detectors", detectors)
    with known_damage(folders, damage) as there:
        return judge_folders(folders, detectors, there, across_scripts=across_scripts)


def export_record(
    run: Path | str, out: Path | str, kind: str = "csv", *, damage: Damage = None
) -> tuple[Path, ...]:
    """Write a run's tables (``csv``, ``parquet``) or its course (``mcap``) into the folder ``out``:
    `teatbench store export`; the files. Raises ConfigError, also for a package that isn't there.
    """
    from bench.record.tables import export_csv, export_parquet, needed

    source, to = Path(run), Path(out)
    with writing(to), known_damage([source], damage) as there:
        (to / DAMAGED).unlink(missing_ok=True)
        write = {"csv": export_csv, "parquet": export_parquet}.get(kind)
        if kind == "mcap":
            write = needed("bench.record.mcap", "MCAP").export_mcap
        if write is None:
            raise ConfigError.plain(f"no export {kind!r} (there are: csv, parquet, mcap)")
        if there:  # first: what an export that fails has written is marked too
            head = f"{NOT_AS_WRITTEN}: the files beside this one are made of what is left of it."
            write_synced(to / DAMAGED, "\n".join((head, *there, "")).encode())
        try:
            return tuple(write(source, to))
        finally:
            if there and [*to.iterdir()] == [to / DAMAGED]:  # beside nothing
                (to / DAMAGED).unlink()


def pack_run(
    run: Path | str, out: Path | str, *, title: str = "", licence: str = "", damage: Damage = None
) -> Path:
    """Write a run as a recording to publish, whole or not at all: `teatbench recording pack`.
    ``licence`` is an SPDX identifier, or several in an expression. Raises ConfigError,
    RecordingError.
    """
    from packaging.licenses import canonicalize_license_expression

    from bench.run.packing import pack_run as packed

    with wrong_use():
        licence = licence and canonicalize_license_expression(licence)
    with writing(Path(out)), known_damage([Path(run)], damage):
        return packed(Path(run), Path(out), title, licence)


def control_run(run: Path | str, words: str, *, within_s: float = TAKEN_S) -> bool:
    """Ask a run that is under way to ``pause``, ``go on``, ``skip REASON``, ``repeat REASON`` or
    ``abort``: `teatbench control`; whether it took that within so many seconds. Raises ConfigError
    for other words, and where the run has ended.
    """
    if not (status := read_status(Path(run))).under_way:
        raise ConfigError.plain(f"{run} has ended ({status.state}): it takes no requests any more.")
    leave_request(Path(run), words)
    return was_taken(Path(run), RealClock(), within_s)
