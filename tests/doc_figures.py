"""The tables of docs/figures/measured.md, each from a CSV file beside it: one place that renders
them.

python -m tests.doc_figures                         write the pages' tables from the CSV files
python -m tests.doc_figures families SET RUN        write the rows of SET in families.csv from a run of `teatbench score`
python -m tests.doc_figures coverage RUNS           simulate coverage.csv again; 4000 take ten minutes
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from bench.record.reader import read_run
from bench.report.tables import ALL, situations
from bench.results.verdicts import scored
from tests.bench.scoring.coverage import DRAWS, coverage
from tests.conftest import ROOT

FOLDER = ROOT / "docs" / "figures"
MEASURED = "docs/figures/measured.md"
OWN, PATH_TRACED = "members 400 to 599", "path-traced"
Row = Mapping[str, str]


def read(name: str) -> list[dict[str, str]]:
    """The rows of a CSV file of docs/figures."""
    with (FOLDER / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write(name: str, rows: Sequence[Row]) -> None:
    """Rows of one kind as a CSV file of docs/figures."""
    with (FOLDER / name).open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def families(of: str, detector: str) -> dict[str, Row]:
    """What a detector did on a set of frames, by situation."""
    return {
        row["situation"]: row
        for row in read("families.csv")
        if (row["set"], row["detector"]) == (of, detector)
    }


def _families() -> Iterator[Sequence[str]]:
    thesis = families(OWN, "thesis")
    for name, row in families(OWN, "fused").items():
        other = thesis[name]
        errors = (
            ", ".join(one[key] for key in ("mean_mm", "p95_mm", "max_mm")) for one in (row, other)
        )
        yield (
            name,
            f"{row['found']}/{row['visible']}",
            row["false"],
            next(errors),
            other["found"],
            other["false"],
            next(errors),
        )


def _missed() -> Iterator[Sequence[str]]:
    for row in read("missed.csv"):
        other = f"{row['other']}: {row['what']}" if row["what"] else row["other"]
        yield (
            row["situation"],
            *(
                cell if cell != "0" else ""
                for cell in (row["no_fit"], row["end_not_seen"], row["side_not_seen"], other)
            ),
        )


def _covariances() -> Iterator[Sequence[str]]:
    for row in read("covariances.csv"):
        yield row["situation"], row["ours"], f"{row['over_percent']} %", row["path_traced"]


def _coverage() -> Iterator[Sequence[str]]:
    """A row a kind of change, a cell a number of poses: covers, median width (mm), green."""
    rows: dict[str, list[str]] = {}
    for row in read("coverage.csv"):
        covers, green = (f"{100 * float(row[key]):.1f} %" for key in ("covers", "green"))
        mean = f"{round(float(row['mean_mm']), 2) + 0.0:.2f}"
        cells = rows.setdefault(row["changes"], [row["changes"], mean])
        cells.append(f"{covers}, {float(row['width_mm']):.2f}, {green}")
    yield from rows.values()


# page, the table's first line, its rows
TABLES: tuple[tuple[str, str, Callable[[], Iterator[Sequence[str]]]], ...] = (
    (
        MEASURED,
        (
            "| situation | fused found | false | mean, p95, max (mm) | thesis found | false | mean,"
            " p95, max (mm) |"
        ),
        _families,
    ),
    (
        MEASURED,
        (
            "| situation | no fit near it (2) | end not seen | side not seen, or one side and too"
            " little else (3) | other |"
        ),
        _missed,
    ),
    (
        MEASURED,
        "| situation | ours | over 11.3 | path-traced |",
        _covariances,
    ),
    (
        MEASURED,
        "| changes | mean (mm) | 8 poses | 20 poses | 60 poses | 150 poses |",
        _coverage,
    ),
)


def rendered(head: str, rows: Iterator[Sequence[str]]) -> str:
    """A table in Markdown; an empty cell is one space."""
    lines = ["|" + "|".join(f" {cell} " if cell else " " for cell in row) + "|" for row in rows]
    return "\n".join([head, "|" + "---|" * (head.count("|") - 1), *lines]) + "\n"


def standing(page: str, head: str) -> str:
    """The table that stands under this first line in a page; empty where there is none."""
    found = re.search(re.escape(head) + r"\n(?:\|.*\n)*", page)
    return found[0] if found else ""


def main(arguments: Sequence[str]) -> None:
    """What the module's docstring says."""
    if arguments[:1] == ["families"]:
        of, run = arguments[1], Path(arguments[2])
        write(
            "families.csv",
            [*(row for row in read("families.csv") if row["set"] != of), *family_rows(of, run)],
        )
    elif arguments[:1] == ["coverage"]:
        runs = int(arguments[1])
        write(
            "coverage.csv",
            [_coverage_row(name, n, runs) for name in DRAWS for n in (8, 20, 60, 150)],
        )
    for path, head, rows in TABLES:
        text = (ROOT / path).read_text(encoding="utf-8")
        table = standing(text, head)
        if not table:
            raise SystemExit(f"{path}: no table begins with {head!r}")
        (ROOT / path).write_text(
            text.replace(table, rendered(head, rows())), encoding="utf-8", newline="\n"
        )


def family_rows(of: str, folder: Path) -> Iterator[dict[str, str]]:
    """Each detector of a run by situation, then over all."""
    run = read_run(folder)
    for detector in run.detectors:
        for situation in (*situations(run), None):
            pool = scored(run, detector, situation)
            radial, counts = pool.summary().radial, pool.counts
            errors = (
                "" if value is None else f"{value:.2f}"
                for value in (radial.mean_mm, radial.p95_mm, radial.max_mm)
            )
            yield {
                "set": of,
                "detector": detector,
                "situation": situation or ALL,
                "visible": str(counts.visible),
                "found": str(counts.matched),
                "false": str(counts.false),
                **dict(zip(("mean_mm", "p95_mm", "max_mm"), errors, strict=True)),
            }


def _coverage_row(changes: str, poses: int, runs: int) -> dict[str, str]:
    mean, covers, width, green = coverage(changes, poses, runs)
    return {
        "changes": changes,
        "poses": str(poses),
        "runs": str(runs),
        "mean_mm": f"{mean:.4f}",
        "covers": f"{covers:.5f}",
        "width_mm": f"{width:.4f}",
        "green": f"{green:.5f}",
    }


if __name__ == "__main__":
    main(sys.argv[1:])
