"""`run`, `resume`, `score` and `report`: what ends in a run folder with a verdict. What runs and
what reports is imported where it is needed: wrong use is to be answered at once.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.store import undamaged
from bench.cli.terminal import Terminal, TerminalProgress, working
from bench.config import ConfigError
from bench.record.reader import read_run
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.rig.urls import PEOPLE
from bench.run.events import Events, SafeProgress, event_lines
from bench.script.model import LoadedScript, find_script, load_script
from instruments.operators.console import keyboard_of

if TYPE_CHECKING:
    from reports.page import Section


def run(given: argparse.Namespace) -> int:
    if given.json and not given.dry_run:
        raise ConfigError.plain(
            "--json is for --dry-run. What a run found is JSON in its report/run.json."
        )
    rig = load_rig(find_rig(given.rig))
    path = find_script(given.script)
    script = load_script(path, rig.rig.limits.set_point_c)
    if given.dry_run:
        from bench.cli.dry_run import look_ahead

        return look_ahead(rig, script, given.out, given.detector, given.seed, as_json=given.json)
    if given.console:
        from bench.cli.console import beside

        with beside(given.out):
            return _run(given, rig, script)
    return _run(given, rig, script)


def _run(given: argparse.Namespace, rig: LoadedRig, script: LoadedScript) -> int:
    from bench.run import estimate
    from bench.run.start import RunOptions, run_script

    console = Terminal()
    with event_lines(given.events) as lines, TerminalProgress(console) as shown:
        progress = Events(shown, lines)
        how = RunOptions(
            typed=typed_lines(rig.rig.operator.url),
            seed=given.seed,
            detectors=given.detector,
            record=given.record,
            realtime=given.realtime or (given.console and bool(rig.rig.emulated)),
            capture=given.capture,
            begun=shown.say,
        )
        folder, _ = run_script(rig, script, given.out, progress, how)
        progress.state("writing the report")
        from bench.cli.verdict import open_report, show_verdict
        from bench.report.page import write_run_report  # late: loads for half a second

        written = write_run_report(folder)
    code = show_verdict(console, *written)
    record = read_run(folder)
    spent = estimate.took(record)
    # the next estimate is better by what this run took; one that stopped shows nothing
    if record.ending == "finished" and "total_s" in spent:
        expected = estimate.needs(rig, script, estimate.read_durations(given.out, rig)).time
        figures = estimate.figures(record, rig, script, spent)
        estimate.write_durations(folder, rig, expected, spent, figures)
        print(estimate.estimate_text(expected, spent))
    if given.open:
        open_report(written[0])
    return code


def resume(given: argparse.Namespace) -> int:
    from bench.run.resume import files_of
    from bench.run.start import RunOptions, resume_run

    console = Terminal()
    with undamaged([given.run], given) as damage:
        record = read_run(given.run)
        if record.ending == "finished" and not _is_reported(given.run):
            from bench.cli.verdict import show_verdict
            from bench.report.page import write_run_report

            print(f"{given.run}: every trial is done, the bench died before it wrote the report")
            return show_verdict(console, *write_run_report(given.run, damage=damage))
        operator = files_of(record)[0].rig.operator.url
        with event_lines(given.events) as lines, TerminalProgress(console) as shown:
            progress = Events(shown, lines)
            typed = typed_lines(operator)
            resume_run(
                given.run, progress, RunOptions(capture=given.capture, typed=typed, begun=shown.say)
            )
            progress.state("writing the report")
            from bench.cli.verdict import show_verdict
            from bench.report.page import write_run_report

            written = write_run_report(given.run, damage=damage)
        return show_verdict(console, *written)


def _is_reported(folder: Path) -> bool:
    """Whether the report is that of the finished run, and not of a session before its end."""
    with suppress(OSError, ValueError, AttributeError):
        text = (folder / "report" / "run.json").read_text(encoding="utf-8")
        return bool(json.loads(text).get("ending") == "finished")
    return False


def typed_lines(operator_url: str) -> Callable[[], str | None]:
    """Lines typed at this terminal, where it is one and no operator is asked there."""
    if operator_url in PEOPLE or sys.stdin is None or not sys.stdin.isatty():
        return lambda: None
    keyboard, terminal = keyboard_of(sys.stdin, lambda _: None), sys.stdin.fileno()

    def line() -> str | None:
        # the system stops a background process (`teatbench run &`) that reads its terminal
        if sys.platform != "win32":
            with suppress(OSError):  # no controlling terminal: nothing stops us
                if os.tcgetpgrp(terminal) != os.getpgrp():
                    return None
        return keyboard.line()

    return line


def score(given: argparse.Namespace) -> int:
    from bench.cli.verdict import show_verdict
    from bench.report.page import write_run_report
    from bench.report.tables import score_table
    from bench.results.cameras_agree import UNCHECKED_FACT
    from bench.run.start import score_recording

    console = Terminal()
    with TerminalProgress(console) as shown:
        progress = SafeProgress(shown)
        folder = score_recording(given.recording, given.out, progress, given.detector or ["thesis"])
        progress.state("writing the report")
        written = write_run_report(folder)
    code = show_verdict(console, *written)
    run = read_run(folder)
    if text := run.facts.get(UNCHECKED_FACT):
        print(f"Cameras {text}.")
    print(f"\n{score_table(run)}")
    return code


def report(given: argparse.Namespace) -> int:
    from bench.cli.verdict import show_verdict
    from bench.report.page import PDF, REPORT, write_run_report
    from reports.pdf import find_browser, print_pdf
    from reports.render import WHOLE
    from reports.trust import PageError

    if given.appendix and given.no_pdf:
        raise ConfigError.plain("--appendix is about the PDF, and --no-pdf prints none. Give one.")
    wanted = given.pdf or given.appendix
    browser = None if given.no_pdf else find_browser()
    if wanted and browser is None:
        raise ConfigError.plain(
            "no Chromium, Chrome or Edge was found to print a PDF with. Install one, or print"
            " index.html by hand."
        )
    with undamaged([given.run, *filter(None, [given.baseline])], given) as damage:
        chapters: tuple[Section, ...] = ()
        if given.baseline:
            from bench.report.comparison import baseline_section

            with working("comparing the runs"):
                chapters = (baseline_section(given.baseline, given.run, damage),)
        with working("writing the report"):
            written = write_run_report(given.run, chapters, damage)
        code = show_verdict(Terminal(), *written)
    if browser:
        folder = given.run / REPORT
        try:
            page = folder / WHOLE if (folder / WHOLE).is_file() else folder / "index.html"
            with working("printing the PDF"):
                printed = print_pdf(page, folder / PDF, browser, appendix=given.appendix)
            print(f"PDF: {printed}")
        except (PageError, OSError) as error:
            if wanted:
                raise ConfigError.plain(str(error)) from error
            print(f"no PDF: {error}", file=sys.stderr)
    return code
