"""`store check` and `store export`: whether a run is still as it was written, and its record for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.commands import CODES, Commands

FORMATS = ("csv", "parquet", "mcap")


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    store = commands.group("store", "a run's record: whether it is as it was written, and for other programs (docs/record.md)")
    check = store.add("check", "verify database, hash chain, frames and files; 0 whole, 1 not as it was written", _check, opens_links=False)
    check.add_argument("run", type=Path, help="the run's folder")
    check.add_argument("--digest", metavar="HEX", help="a digest that a report names: the record has to have passed through it")
    export = store.add("export", "write the record's tables, or all of it on one time line", _export, opens_links=False)
    export.add_argument("run", type=Path, help="the run's folder")
    export.add_argument(
        "--format", required=True, choices=FORMATS, help="csv and parquet: a file a table; mcap: one file for Foxglove and its kin"
    )
    export.add_argument("--out", required=True, type=Path, metavar="DIR", help="where to; files of the same names are replaced")


def _check(given: argparse.Namespace) -> int:
    from bench.store.check import check_run

    done = check_run(given.run, given.digest)
    for finding in done.findings:
        print(f"{finding.weight.value}: {finding.text}")
    print("looked at " + ", ".join(f"{count} {name}" for name, count in done.counts.items()))
    if done.head.number:
        print(f"digest: {done.head.wall_digest}\ndigest without real time: {done.head.digest}")
    print("The record is as it was written." if done.whole else "The record is NOT as it was written.")
    return CODES.met if done.whole else CODES.not_met


def _export(given: argparse.Namespace) -> int:
    from bench.config import ConfigError
    from bench.exporting.mcap_file import export_mcap
    from bench.exporting.tables import export_csv, export_parquet

    write = {"csv": export_csv, "parquet": export_parquet, "mcap": export_mcap}[given.format]
    try:
        for path in write(given.run, given.out):
            print(path)
    except OSError as error:
        raise ConfigError.plain(f"the export can't be written to {given.out}: {error.strerror or error}") from error
    return CODES.met
