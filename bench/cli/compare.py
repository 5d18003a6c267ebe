"""`compare`: detectors or versions held against each other on the same scenes, and a gate for CI.

`plan`: before a run, how many poses a claim needs, and how small a difference between two detectors
they can show.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, Commands, number
from bench.cli.record import add_despite_damage, undamaged

if TYPE_CHECKING:
    from rich.table import Table

    from bench.results.comparison import Comparison
    from bench.results.sample_size import Plan
    from bench.scoring.decisions import Verdict
    from reports.page import Table as PageTable


def add_to(commands: Commands) -> None:
    """The command with its arguments."""
    compare = commands.add(
        "compare",
        "paired differences between runs, or between the detectors of one run",
        _compare,
        opens_links=False,
    )
    compare.add_argument(
        "run", type=Path, nargs="+", metavar="RUN", help="folders of runs; the first is the old one"
    )
    compare.add_argument(
        "--detector",
        action="append",
        default=[],
        metavar="NAME",
        help="only this one; may be given several times",
    )
    compare.add_argument(
        "--margin-mm",
        type=_length,
        metavar="MM",
        help="how much larger an error may be (default: 5 %% of the limit)",
    )
    compare.add_argument(
        "--confidence",
        type=_confidence,
        default=0.95,
        metavar="P",
        help="of the intervals (default: 0.95)",
    )
    compare.add_argument(
        "--gate",
        action="store_true",
        help="exit code 1 when the new one is worse, 4 when that can't be told",
    )
    compare.add_argument(
        "--together",
        action="store_true",
        help="judge all runs as one, by their counts and errors, instead of comparing",
    )
    compare.add_argument(
        "--out", type=Path, metavar="DIR", help="also write a page and comparison.json there"
    )
    add_despite_damage(compare)
    compare.add_argument("--json", action="store_true", help="print JSON instead of tables")


def _length(text: str) -> float:
    value = number(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a length in mm of 0 or more")
    return value


def _confidence(text: str) -> float:
    value = number(text)
    if not 0.5 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} must lie between 0.5 and 1, for example 0.95")
    return value


def _compare(given: argparse.Namespace) -> int:
    from bench.results.comparison import compare_folders

    with undamaged(given.run, given) as damage:
        if given.together:
            return _together(given, damage)
        found = compare_folders(
            given.run,
            given.detector,
            margin_mm=given.margin_mm,
            confidence=given.confidence,
            damage=damage,
        )
        return _told(given, found)


def _told(given: argparse.Namespace, found: tuple[Comparison, ...]) -> int:
    from bench.report.comparison import as_json, write_comparison

    if given.json:
        print(json.dumps(as_json(found), indent=1, ensure_ascii=False))
    else:
        _show(found)
    if given.out:
        path = write_comparison(found, given.out)
        if not given.json:
            print(f"Report: {path}")
    return _code(found) if given.gate else CODES.met


def _together(given: argparse.Namespace, damage: tuple[str, ...]) -> int:
    from bench.results.comparison import judge_folders, judgement_lines
    from bench.results.verdicts import run_verdict

    judgements = judge_folders(given.run, given.detector, damage)
    if given.json:
        lines = [
            {
                "detector": one.detector,
                "verdict": one.verdict,
                "decisions": [d.as_dict() for d in one.decisions],
            }
            for one in judgements
        ]
        print(json.dumps(lines, indent=1, ensure_ascii=False))
    else:
        print("\n".join(line for one in judgements for line in judgement_lines(one)))
    return _code_of(run_verdict(judgements)) if given.gate else CODES.met


def _show(found: tuple[Comparison, ...]) -> None:
    from bench.cli.terminal import Terminal
    from bench.report.comparison import (
        distance_table,
        heading,
        notes,
        success_table,
        verdict_told,
    )

    console = Terminal()
    for comparison in found:
        console.print(heading(comparison), soft_wrap=True)
        console.print(_table("success", success_table(comparison)))
        console.print(_table("distance to the teat end", distance_table(comparison)))
        for line in (*notes(comparison), verdict_told(comparison)):
            console.print(line)
        for reason in comparison.compared.gate.reasons:
            console.print(f"  {reason}")


def _table(title: str, shown: PageTable) -> Table:
    """A page's table of plain texts, for the terminal."""
    from rich.table import Table

    table = Table(title=title)
    for at, column in enumerate(shown.columns):
        table.add_column(
            f"{column.title}, {column.unit}" if column.unit else column.title,
            justify="right" if at else "left",
            no_wrap=not at,
        )
    for row in shown.rows:
        table.add_row(*(cell if isinstance(cell, str) else cell.text for cell in row))
    return table


def _code(found: tuple[Comparison, ...]) -> int:
    from bench.scoring.decisions import overall

    return _code_of(overall(comparison.compared.gate.verdict for comparison in found))


def _code_of(verdict: Verdict) -> int:
    from bench.scoring.decisions import Verdict

    return {Verdict.MET: CODES.met, Verdict.NOT_MET: CODES.not_met}.get(verdict, CODES.inconclusive)


RATES = (0.95, 0.99, 0.999)


def add_plan_to(commands: Commands) -> None:
    """The command with its arguments."""
    plan = commands.add(
        "plan",
        "how many poses a claim needs, and what so many poses can show",
        _plan,
        opens_links=False,
    )
    plan.add_argument(
        "--rate",
        type=_share,
        action="append",
        default=[],
        metavar="R",
        help="to be shown (default: 0.95, 0.99 and 0.999)",
    )
    plan.add_argument(
        "--confidence", type=_share, default=0.95, metavar="P", help="of the claim (default: 0.95)"
    )
    plan.add_argument(
        "--failures",
        type=_whole,
        default=3,
        metavar="N",
        help="plan for up to so many failures (default: 3)",
    )
    plan.add_argument(
        "--trials", type=_whole, metavar="N", help="poses there are: what do they show?"
    )
    plan.add_argument(
        "--script",
        metavar="SCRIPT",
        help="take the poses of a script, shipped by name or a .toml file",
    )
    plan.add_argument(
        "--true-rate",
        type=_share,
        metavar="R",
        help="what the detector is hoped to do: its chance to show the rate",
    )
    plan.add_argument(
        "--sd-mm",
        type=_positive_length,
        metavar="SD",
        help="of the difference of two detectors' errors from pose to pose",
    )
    plan.add_argument(
        "--shift-mm",
        type=_positive_length,
        metavar="MM",
        help="difference of two detectors to be shown: how many poses?",
    )
    plan.add_argument(
        "--power",
        type=_share,
        default=0.8,
        metavar="P",
        help="chance to show a difference that is there (default: 0.8)",
    )
    plan.add_argument(
        "--limit-mm",
        type=_positive_length,
        metavar="T",
        help="of the error: how near to it may the largest lie? With --u-mm",
    )
    plan.add_argument(
        "--u-mm",
        type=_positive_length,
        metavar="U",
        help="standard uncertainty of the truth along an axis; a report says it",
    )
    plan.add_argument("--json", action="store_true", help="print JSON")


def _share(text: str) -> float:
    value = number(text)
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(
            f"{text!r} must lie between 0 and 1, for example 0.95: no number of poses shows 100 %"
        )
    return value


def _positive_length(text: str) -> float:
    value = number(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a length in mm above 0")
    return value


def _whole(text: str) -> int:
    if not text.isdecimal() or int(text) > 1_000_000:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to a million")
    return int(text)


def _plan(given: argparse.Namespace) -> int:
    from dataclasses import asdict

    from bench.config import ConfigError
    from bench.results.sample_size import make_plan, plan_lines

    if given.script and given.trials is not None:
        raise ConfigError.plain(
            "--script and --trials both say how many poses there are; give one of them"
        )
    if given.shift_mm is not None and given.sd_mm is None:
        raise ConfigError.plain(
            "--shift-mm needs --sd-mm: how much the difference varies from pose to pose ('teatbench"
            " compare' shows it)"
        )
    if (given.limit_mm is None) != (given.u_mm is None):
        raise ConfigError.plain(
            "--limit-mm and --u-mm belong together: the limit of the error, and the uncertainty of"
            " the truth"
        )
    plan: Plan = make_plan(
        tuple(given.rate) or RATES,
        given.confidence,
        failures=given.failures,
        poses=_poses(given.script) if given.script else given.trials,
        true_rate=given.true_rate,
        sd_mm=given.sd_mm,
        shift_mm=given.shift_mm,
        power=given.power,
        limit_mm=given.limit_mm,
        u_mm=given.u_mm,
    )
    if given.json:
        print(json.dumps(asdict(plan), indent=1))
    else:
        for line in plan_lines(plan):
            print(line)
    return CODES.met


def _poses(script: str) -> int:
    """Independent poses of a script: repeats of one pose count once."""
    from bench.script.model import find_script, load_script

    return len({trial.name for trial in load_script(find_script(script)).planned})
