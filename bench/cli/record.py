"""`store check` and `store export`: whether a run is still as it was written, and its record for
other programs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from bench.cli.arguments import CODES, Commands

DAMAGED = "NOT-AS-WRITTEN.txt"  # beside what was exported of a damaged record
FORMATS = ("csv", "parquet", "mcap")


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    store = commands.group(
        "store",
        "a run's record: whether it is as it was written, and for other programs (docs/record.md)",
    )
    check = store.add(
        "check",
        "verify database, hash chain, frames and files; 0 whole, 1 not as it was written",
        _check,
        opens_links=False,
    )
    check.add_argument("run", type=Path, help="the run's folder")
    check.add_argument(
        "--digest",
        metavar="HEX",
        help="a digest that a report names: the record has to have passed through it",
    )
    export = store.add(
        "export",
        "write the record's tables, or all of it on one time line",
        _export,
        opens_links=False,
    )
    export.add_argument("run", type=Path, help="the run's folder")
    export.add_argument(
        "--format",
        required=True,
        choices=FORMATS,
        help="csv and parquet: a file a table; mcap: one file for Foxglove and its kin",
    )
    add_despite_damage(export)
    export.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="DIR",
        help="where to; files of the same names are replaced",
    )


def add_despite_damage(parser: argparse.ArgumentParser) -> None:
    """For a command that reads the records of runs."""
    what = "go on though the record is not as it was written: nothing is decided by it then"
    parser.add_argument("--despite-damage", action="store_true", help=what)


@contextmanager
def undamaged(runs: Sequence[Path], given: argparse.Namespace) -> Iterator[tuple[str, ...]]:
    """Checks the runs' records first; gives what is damaged, where that was allowed, and says it
    before and after all else.
    """
    from bench.record.check import NOT_AS_WRITTEN, checked_first, shortened

    with checked_first(runs, despite_damage=given.despite_damage) as damage:
        alarm = f"{'!' * 40}\n{NOT_AS_WRITTEN}. {shortened(damage)}\n{'!' * 40}\n" if damage else ""
        sys.stderr.write(alarm)
        yield damage
        sys.stdout.flush()
        sys.stderr.write(alarm)


def _check(given: argparse.Namespace) -> int:
    from bench.record.check import NOT_AS_WRITTEN, check_run

    done = check_run(given.run, given.digest)
    for finding in done.findings:
        print(f"{finding.weight.value}: {finding.text}")
    print("looked at " + ", ".join(f"{count} {name}" for name, count in done.counts.items()))
    if done.head.number:
        print(f"digest: {done.head.wall_digest}\ndigest without real time: {done.head.digest}")
    print("The record is as it was written." if done.whole else f"{NOT_AS_WRITTEN}.")
    return CODES.met if done.whole else CODES.not_met


def _export(given: argparse.Namespace) -> int:
    from bench.config import ConfigError
    from bench.files import write_synced
    from bench.record.check import NOT_AS_WRITTEN
    from bench.record.tables import export_csv, export_parquet, needed

    if given.format == "mcap":
        write = needed("bench.record.mcap", "MCAP").export_mcap
    else:
        write = {"csv": export_csv, "parquet": export_parquet}[given.format]
    try:
        with undamaged([given.run], given) as damage:
            (given.out / DAMAGED).unlink(missing_ok=True)
            for path in write(given.run, given.out):
                print(path)
            if damage:
                text = "\n".join(
                    (
                        (
                            f"{NOT_AS_WRITTEN}: the files beside this one are made of what is left"
                            " of it."
                        ),
                        *damage,
                        "",
                    )
                )
                write_synced(given.out / DAMAGED, text.encode())
    except OSError as error:
        raise ConfigError.plain(
            f"the export can't be written to {given.out}: {error.strerror or error}"
        ) from error
    return CODES.met
