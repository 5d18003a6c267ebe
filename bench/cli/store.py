"""What is done with runs' folders: `runs` lists them, with a page over them; `store check`, `store
export`, `recording pack`, `compare` of detectors or versions on the same scenes, and `control` of a
run that goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import bench
from bench.cli.arguments import CODES, code_of, complain, print_json, say
from bench.cli.terminal import working
from bench.config import ConfigError
from textfiles.text import plural
from textfiles.whole import refusal

if TYPE_CHECKING:
    from reports.runs import Runs

TAKEN_S = 10.0  # that a capture or a detection may take, before a request is read
WIDE = 110  # columns that a comparison's axes need; page and JSON have them always
MOST_STEPS = 8  # of a detector's runs: the page has more


@contextmanager
def undamaged(runs: Sequence[Path], given: argparse.Namespace) -> Iterator[tuple[str, ...]]:
    """Checks the records first; gives the damage that was allowed, said before and after."""
    with ExitStack() as stack:
        with working("checking the record"):
            allowed = bench.checked_first(runs, despite_damage=given.despite_damage)
            damage = stack.enter_context(allowed)
        line = "!" * 40
        alarm = f"{line}\n{bench.damage_text(damage)}\n{line}\n" if damage else ""
        sys.stderr.write(alarm)
        yield damage
        sys.stdout.flush()
        sys.stderr.write(alarm)


def check(given: argparse.Namespace) -> int:
    with working("checking the record"):
        done = bench.check_record(given.run, given.digest)
    for finding in done.findings:
        say(f"{finding.severity.value}: {finding.text}")
    print("looked at " + ", ".join(f"{count} {name}" for name, count in done.counts.items()))
    if done.head.number:
        print(f"digest: {done.head.wall_digest}\ndigest without real time: {done.head.digest}")
    if looks := done.head.number - done.unlooked.number:
        print(f"digest before {plural(looks, 'look')} of 'compare': {done.unlooked.wall_digest}")
    if done.unchecked:
        return complain(done.unchecked, CODES.inconclusive)
    say(done.sentence)
    return CODES.met if done.whole else CODES.not_met


def export(given: argparse.Namespace) -> None:
    with undamaged([given.run], given) as damage:
        with working(f"writing {given.format}"):
            paths = bench.export_record(given.run, given.out, given.format, damage=damage)
        print(*paths, sep="\n")


def pack(given: argparse.Namespace) -> None:
    named = {"title": given.title or "", "licence": given.licence or ""}
    with undamaged([given.run], given) as damage, working("packing the run"):
        folder = bench.pack_run(given.run, given.out, **named, damage=damage)
    print(folder)
    if not given.licence:
        print(
            "no licence is stated: others may not use it. Pack it again with --licence, CC-BY-4.0"
            " for one.",
            file=sys.stderr,
        )


def compare(given: argparse.Namespace) -> int:
    if given.across_scripts and not given.together:
        raise ConfigError.plain("--across-scripts says which runs may be pooled: use --together")
    asked = given.run, given.detector
    with undamaged(given.run, given) as damage:
        if not given.together:
            with working("comparing the runs"):
                how = {"margin_mm": given.margin_mm, "confidence": given.confidence}
                found = bench.compare_runs(*asked, **how, damage=damage)
            return print_comparisons(given, found)
        with working("judging the runs together"):
            across = given.across_scripts
            judged = bench.judge_together(*asked, across_scripts=across, damage=damage)
        if given.json:
            print_json({"together": [one.as_dict() for one in judged]}, indent=1)
        else:
            print(*(line for one in judged for line in one.lines()), sep="\n")
    return code_of(bench.verdict_of(judged).value) if given.gate else CODES.met


def print_comparisons(given: argparse.Namespace, found: Sequence[bench.Comparison]) -> int:
    """Print comparisons, write their page where it is wanted; gives back the exit code."""
    from bench.report.comparison import as_json

    if given.json:
        print_json(as_json(found), indent=1)
    else:
        _show(found)
    if given.out:
        with working("writing the report"):
            path = bench.write_comparison(found, given.out)
        if not given.json:
            print(f"Report: {path}")
    if given.summary:
        from bench.report import summary

        summary.append(given.summary, summary.of_comparisons(found))
    return code_of(bench.verdict_of(found).value) if given.gate else CODES.met


def _show(found: Sequence[bench.Comparison]) -> None:
    from rich import box
    from rich.table import Table

    from bench.cli.terminal import Terminal, print_table, print_wrapped
    from bench.report.comparison import printed

    console = Terminal()
    wide = console.width >= WIDE
    for comparison in found:
        heading, tables, said, reasons = printed(comparison)
        console.print(heading, soft_wrap=True)
        for title, page in tables.items():
            table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
            columns = [one for one in page.columns if wide or not one.title.startswith("|")]
            for at, column in enumerate(columns):
                name = f"{column.title}, {column.unit}" if column.unit else column.title
                table.add_column(name, justify="right" if at else "left")
            for row in page.rows:
                cells = row[: len(columns)]
                table.add_row(*(cell if isinstance(cell, str) else cell.text for cell in cells))
            print_table(console, table)
        for line in (*said, *(f"  {reason}" for reason in reasons)):
            print_wrapped(console, line)


def control(given: argparse.Namespace) -> None:
    if bench.control_run(given.run, " ".join(given.words), within_s=TAKEN_S):
        print("request accepted; see the run's terminal")
        return
    why = f"the run has not read it for {TAKEN_S:g} s: it is busy, or its process has ended."
    say(f"request left; {why}")


def runs(given: argparse.Namespace) -> None:
    with working("reading the runs"):
        found = bench.list_runs(given.folder)
    page, why = None, "not written: no runs are there"
    try:
        page = str(bench.write_runs_page(found)) if found.runs else None
    except OSError as error:  # a folder to look at, and no more
        why = f"not written: {refusal(error)}"
    if given.json:
        text = {
            "runs": [run.as_dict() for run in found.runs],
            "history": [
                {"detector": detector, "script": script, "runs": [str(run.folder) for run, _ in of]}
                for (detector, script), of in found.histories().items()
            ],
            "others": [
                {"folder": str(found.folder / name), "why": why} for name, why in found.others
            ],
            "health": found.warnings,
            "page": page,
        }
        print_json(text, indent=1)
        return
    _show_runs(found)
    print(f"Page: {page or why}")


def _show_runs(found: Runs) -> None:
    from rich.table import Table

    from bench.cli.terminal import Terminal, print_table, print_wrapped
    from bench.report.runs import counted
    from bench.report.wording import NOT_MEASURED, number

    console = Terminal()
    table = Table()
    for column in ("run", "detector", "verdict", "found", "false", "largest error"):
        table.add_column(column, justify="right" if column[0] in "fl" else "left")
    for run in found.runs:
        for at, one in enumerate(run.results):
            share = f"{one.found} of {one.visible}" if one.share else NOT_MEASURED
            false = NOT_MEASURED if one.false is None else str(one.false)
            name, largest = "" if at else run.folder.name, number(one.max_error_mm, "mm")
            table.add_row(name, one.detector, one.verdict, share, false, largest)
        table.add_section()
    console.print(f"{found.folder}: {counted(found)}", highlight=False, soft_wrap=True)
    if found.runs:
        print_table(console, table)
    for (detector, script), of in found.histories().items():
        earlier = [f"{len(of) - MOST_STEPS} earlier"] if len(of) > MOST_STEPS else []
        steps = " → ".join([*earlier, *(one.brief for _, one in of[-MOST_STEPS:])])
        print_wrapped(console, f"{detector}, {script}: {steps}")
    for run in found.runs:
        for said in filter(None, (run.status["mark"], run.note)):
            console.print(f"{run.folder.name}: {said}", highlight=False, soft_wrap=True)
    for text in found.warnings:
        console.print(f"Bench health: {text}", style="yellow", highlight=False, soft_wrap=True)
    for name, why in found.others:
        console.print(f"not a run: {name}: {why}", highlight=False, soft_wrap=True)
