"""The tables of measured figures in docs, each from a CSV file of docs/figures: one place that
renders them.

python -m tests.doc_figures                         write the pages' tables from the CSV files
python -m tests.doc_figures families SET RUN        write the rows of SET in families.csv from a run of `teatbench score`
python -m tests.doc_figures campaign DIR            write campaign.csv from a campaign's folder
python -m tests.doc_figures perturbed FOLDER        run the campaigns of perturbed.csv there, and write it
python -m tests.doc_figures coverage RUNS           simulate coverage.csv again; 4000 take ten minutes
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from bench import run_campaign
from bench.campaign.numbers import family_rates
from bench.campaign.perturbations import KINDS
from bench.campaign.plan import CampaignPlan, read_plan
from bench.campaign.run import PLAN
from bench.campaign.shards import Shards
from bench.record.reader import read_run
from bench.report.tables import ALL, situations
from bench.results.verdicts import scored
from instruments.world.situations import SITUATIONS
from tests.bench.scoring.coverage import DRAWS, coverage
from tests.conftest import ROOT

FOLDER = ROOT / "docs" / "figures"
MEASURED = "docs/figures/measured.md"
PATH_TRACED = "path-traced"
Row = Mapping[str, str]
CAPTION = re.compile(r"^.* on [\d,]+ scenes of \d+ families, seed .*:$", re.MULTILINE)
FIRST, ELEVEN = "the first eleven", tuple(SITUATIONS)[:11]
DETECTORS = "SELECT DISTINCT detector FROM scenes"
ERRORS = """
SELECT avg(mm), quantile_cont(mm, 0.95), max(mm), 100 * avg((nees > 11.345)::INT) FROM (
  SELECT sqrt(x_mm * x_mm + y_mm * y_mm + z_mm * z_mm) AS mm, nees FROM teats
  WHERE status = 'found' AND list_contains(?, family)
)
"""
SUMS = (
    *("scenes", "failures", "visible", "found", "false_teats", "sure_wrong", "stated", "inside"),
)
PERTURBED = {  # members that earlier versions were looked at with, too
    "families": ELEVEN,
    "scenes": 10,
    "first": 3000,
    "seed": 101,
    "detectors": ("fused",),
    "calibration": str(ROOT / "bench" / "rigs" / "calibration.toml"),  # which states nothing
}
PERTURBATIONS: tuple[tuple[str, float] | None, ...] = (
    None,
    *(("vergence", 0.1), ("out-of-step", 3), ("column", 0.5), ("row", 1), ("focal", 0.2)),
    *(("thermal-pose", 0.3), ("blur-across", 9), ("blur-down", 9), ("defocus", 2), ("defocus", 3)),
    *(("exposure", 2.5), ("gamma", 0.45), ("jpeg", 40)),
)
OF_ALL = """
SELECT count(*), sum(visible), sum(found), sum(false_teats), sum(sure_wrong),
  count(*) FILTER (found + false_teats = 0) FROM scenes
"""
OF_ENDS = """
SELECT avg(mm), max(mm), avg(nees), 100 * avg((nees > 11.345)::INT) FROM (
  SELECT sqrt(x_mm * x_mm + y_mm * y_mm + z_mm * z_mm) AS mm, nees FROM teats
  WHERE status = 'found'
)
"""


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


def campaign_rows(folder: Path) -> Iterator[dict[str, str]]:
    """The campaign in a folder, of one detector: each family, the first eleven, and all."""
    plan = read_plan(folder / PLAN)
    shards = Shards(folder)
    with shards.connect() as db:
        (detector,) = (name for (name,) in db.execute(DETECTORS).fetchall())
        by_name = {rate.family: rate for rate in family_rates(db)}
        errors = {name: db.execute(ERRORS, [[*names]]).fetchone() for name, names in _sets(plan)}
    version = plan.made_by["detectors"].removeprefix(f"{detector} ").split()[0]
    for name, names in _sets(plan):
        rates = [by_name[one] for one in names]
        sums = {key: sum(getattr(one, key) for one in rates) for key in SUMS}
        low, high = plan.interval(sums["failures"], sums["scenes"]) or (0.0, 1.0)
        nees = sum((one.nees or 0.0) * one.stated for one in rates) / max(sums["stated"], 1)
        cells = (f"{value:.2f}" if value is not None else "" for value in errors[name] or ())
        yield {
            "detector": f"{detector} {version}",
            "seed": str(plan.seed),
            "digest": shards.digest()[:8],
            "family": name,
            **{key: str(value) for key, value in sums.items()},
            "low": f"{low:.5f}",
            "high": f"{high:.5f}",
            **dict(zip(("mean_mm", "p95_mm", "max_mm", "beyond_percent"), cells, strict=True)),
            "nees": f"{nees:.1f}",
        }


def _sets(plan: CampaignPlan) -> list[tuple[str, tuple[str, ...]]]:
    first = tuple(name for name in plan.families if name in ELEVEN)
    return [
        *((name, (name,)) for name in plan.families),
        *([(FIRST, first)] if first not in ((), plan.families) else []),
        (ALL, plan.families),
    ]


def perturbed_rows(folder: Path) -> Iterator[dict[str, str]]:
    """One campaign each, in folders of their own in ``folder``."""
    for done in PERTURBATIONS:
        name, amount = done or ("none", 0.0)
        plan = {**PERTURBED, "perturbations": [{"name": name, "amount": amount}] if done else []}
        campaign = run_campaign(plan, folder / f"{name}-{amount:g}").campaign
        with campaign.shards.connect() as db:
            [of_all], [errors] = (db.execute(sql).fetchall() for sql in (OF_ALL, OF_ENDS))
        scenes, visible, found, false, sure, empty = map(str, of_all)
        cells = ("" if value is None else f"{value:.2f}" for value in errors)
        yield {
            "detector": " ".join(campaign.made_by["detectors"].split()[:2]),
            "perturbation": f"{name} {amount:g} {KINDS[name].unit}".strip() if done else name,
            "scenes": scenes,
            "visible": visible,
            "found": found,
            "false": false,
            "sure_wrong": sure,
            "without_an_end": empty,
            **dict(zip(("mean_mm", "max_mm", "nees", "beyond_percent"), cells, strict=True)),
        }


def campaign_caption() -> str:
    """What the campaign's table is of."""
    all_of = read("campaign.csv")[-1]
    families = sum(row["family"] not in (ALL, FIRST) for row in read("campaign.csv"))
    return (
        f"{all_of['detector']} on {int(all_of['scenes']):,} scenes of {families} families, seed"
        f" {all_of['seed']}, digest {all_of['digest']}:"
    )


def _campaign() -> Iterator[Sequence[str]]:
    for row in read("campaign.csv"):
        scenes, failures = int(row["scenes"]), int(row["failures"])
        low, high = (f"{100 * float(row[key]):.2f}" for key in ("low", "high"))
        inside = (
            f"{100 * int(row['inside']) / int(row['stated']):.1f} %" if int(row["stated"]) else ""
        )
        yield (
            row["family"],
            f"{scenes - failures}/{scenes}",
            f"{low} to {high} %",
            f"{row['found']}/{row['visible']}",
            row["false_teats"],
            row["sure_wrong"],
            ", ".join(row[key] for key in ("mean_mm", "p95_mm", "max_mm")),
            row["nees"],
            inside,
            f"{float(row['beyond_percent']):.1f} %",
        )


def _perturbed() -> Iterator[Sequence[str]]:
    for row in read("perturbed.csv"):
        yield (
            row["perturbation"],
            row["found"],
            row["false"],
            f"{row['without_an_end']} of {row['scenes']}",
            ", ".join(filter(None, (row["mean_mm"], row["max_mm"]))),
            row["nees"],
            f"{float(row['beyond_percent']):.1f} %" if row["beyond_percent"] else "",
            row["sure_wrong"],
        )


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
            "| family | scenes right | failures, 95 % interval | ends found | false | sure and wrong"
            " | mean, p95, max (mm) | squared error | in their 95 % region | beyond their 99 % region |"
        ),
        _campaign,
    ),
    (
        MEASURED,
        (
            "| perturbation | found | false | frames without an end | mean, max (mm) | squared error"
            " | beyond their 99 % region | sure and wrong |"
        ),
        _perturbed,
    ),
    (MEASURED, "| changes | mean (mm) | 8 poses | 20 poses | 60 poses | 150 poses |", _coverage),
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
    elif arguments[:1] == ["campaign"]:
        write("campaign.csv", list(campaign_rows(Path(arguments[1]))))
    elif arguments[:1] == ["perturbed"]:
        write("perturbed.csv", list(perturbed_rows(Path(arguments[1]))))
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
        text = CAPTION.sub(campaign_caption(), text.replace(table, rendered(head, rows())))
        (ROOT / path).write_text(text, encoding="utf-8", newline="\n")


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
