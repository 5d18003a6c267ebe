"""`compare`: detectors or versions held against each other on the same scenes, and a gate for CI."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands
from bench.commands.arguments import number
from bench.commands.store import add_despite_damage, undamaged

if TYPE_CHECKING:
    from rich.table import Table

    from bench.comparing.runs import Comparison
    from bench.scoring.decisions import Verdict


def add_to(commands: Commands) -> None:
    """The command with its arguments."""
    compare = commands.add("compare", "paired differences between runs, or between the detectors of one run", _compare, opens_links=False)
    compare.add_argument("run", type=Path, nargs="+", metavar="RUN", help="folders of runs; the first is the old one")
    compare.add_argument("--detector", action="append", default=[], metavar="NAME", help="only this one; may be given several times")
    compare.add_argument("--margin-mm", type=_length, metavar="MM", help="how much larger an error may be (default: 5 %% of the limit)")
    compare.add_argument("--confidence", type=_share, default=0.95, metavar="P", help="of the intervals (default: 0.95)")
    compare.add_argument("--gate", action="store_true", help="exit code 1 when the new one is worse, 4 when that can't be told")
    compare.add_argument("--together", action="store_true", help="judge all runs as one, by their counts and errors, instead of comparing")
    compare.add_argument("--out", type=Path, metavar="DIR", help="also write a page and comparison.json there")
    add_despite_damage(compare)
    compare.add_argument("--json", action="store_true", help="print JSON instead of tables")


def _length(text: str) -> float:
    value = number(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a length in mm of 0 or more")
    return value


def _share(text: str) -> float:
    value = number(text)
    if not 0.5 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} must lie between 0.5 and 1, for example 0.95")
    return value


def _compare(given: argparse.Namespace) -> int:
    from bench.comparing.runs import compare_folders

    with undamaged(given.run, given) as damage:
        if given.together:
            return _together(given, damage)
        found = compare_folders(given.run, given.detector, margin_mm=given.margin_mm, confidence=given.confidence, damage=damage)
        return _told(given, found)


def _told(given: argparse.Namespace, found: tuple[Comparison, ...]) -> int:
    from bench.comparing.page import write_comparison
    from bench.comparing.words import as_json

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
    from bench.comparing.together import judge_folders, told
    from bench.verdicts import run_verdict

    judgements = judge_folders(given.run, given.detector, damage)
    if given.json:
        lines = [
            {"detector": one.detector, "verdict": one.verdict, "decisions": [d.as_dict() for d in one.decisions]} for one in judgements
        ]
        print(json.dumps(lines, indent=1, ensure_ascii=False))
    else:
        print("\n".join(line for one in judgements for line in told(one)))
    return _code_of(run_verdict(judgements)) if given.gate else CODES.met


def _show(found: tuple[Comparison, ...]) -> None:
    from bench.comparing.words import DISTANCE, SUCCESS, distance_rows, heading, notes, success_rows, verdict_told
    from bench.terminal import Terminal

    console = Terminal()
    for comparison in found:
        console.print(heading(comparison), soft_wrap=True)
        console.print(_table("success", SUCCESS, success_rows(comparison)))
        console.print(_table("distance to the teat end", DISTANCE, distance_rows(comparison)))
        for line in (*notes(comparison), verdict_told(comparison)):
            console.print(line)
        for reason in comparison.compared.gate.reasons:
            console.print(f"  {reason}")


def _table(title: str, columns: Sequence[tuple[str, str]], rows: Iterable[tuple[str, ...]]) -> Table:
    from rich.table import Table

    table = Table(title=title)
    for at, (column, unit) in enumerate(columns):
        table.add_column(f"{column}, {unit}" if unit else column, justify="right" if at else "left", no_wrap=not at)
    for row in rows:
        table.add_row(*row)
    return table


def _code(found: tuple[Comparison, ...]) -> int:
    from bench.scoring.decisions import overall

    return _code_of(overall(comparison.compared.gate.verdict for comparison in found))


def _code_of(verdict: Verdict) -> int:
    from bench.scoring.decisions import Verdict

    return {Verdict.MET: CODES.met, Verdict.NOT_MET: CODES.not_met}.get(verdict, CODES.inconclusive)
