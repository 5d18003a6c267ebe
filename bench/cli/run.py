"""`run`, `score` and `report`: what ends in a run folder with a verdict."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, Commands, add_detectors, add_out
from bench.cli.record import add_despite_damage, undamaged

if TYPE_CHECKING:
    from bench.report.page import Extras
    from bench.rig.loading import LoadedRig
    from bench.script.model import LoadedScript

TOLD_S = 10.0  # a run looks once a second; a capture or a detection may take longer


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    run = commands.add("run", "run a trial script on a rig and write the scored report", _run)
    run.add_argument(
        "script",
        nargs="?",
        help="a shipped script by name, or a .toml file (default: six-situations)",
    )
    run.add_argument("--rig", help="a shipped rig by name, or a .toml file (default: emulated)")
    run.add_argument("--seed", type=_seed, help="seed of all chance (default: the rig file's)")
    run.add_argument(
        "--record",
        type=Path,
        metavar="DIR",
        help="also write a recording that 'teatbench score' reads",
    )
    run.add_argument(
        "--realtime", action="store_true", help="emulated rig only: let time pass as it does"
    )
    run.add_argument(
        "--dry-run",
        action="store_true",
        help="move nothing: look at each pose, then go through all trials on emulators",
    )
    add_out(run)
    add_detectors(run)
    add_events(run)
    resume = commands.add(
        "resume", "go on with a run that stopped, at its first trial without a result", _resume
    )
    resume.add_argument("run", type=Path, help="the run's folder")
    add_events(resume)
    add_despite_damage(resume)
    control = commands.add(
        "control",
        "ask a run that goes on to pause, go on, skip REASON, repeat REASON or abort",
        _control,
        once=("tell",),
        opens_links=False,
    )
    control.add_argument("run", type=Path, help="the run's folder")
    control.add_argument(
        "words", nargs="+", help="pause, go on, skip REASON, repeat REASON or abort"
    )
    report = commands.add("report", "(re)write the report of a run", _report, opens_links=False)
    report.add_argument("run", type=Path, help="the run's folder")
    report.add_argument(
        "--baseline",
        type=Path,
        metavar="RUN",
        help="also hold it against this older run of the same scenes",
    )
    report.add_argument(
        "--single-file",
        action="store_true",
        help="also write single-file.html for mail: pictures in it, at most 20 MB",
    )
    add_despite_damage(report)
    printed = report.add_mutually_exclusive_group()
    printed.add_argument(
        "--pdf",
        action="store_true",
        help="fail where report.pdf can't be printed (by a Chromium, Chrome or Edge)",
    )
    printed.add_argument(
        "--no-pdf", action="store_true", help="print no report.pdf, though a browser is installed"
    )
    score = commands.add(
        "score",
        "score detectors on recorded frames: a table, and a run folder with a report",
        _score,
        opens_links=False,
    )
    score.add_argument("recording", type=Path, help="a recording's folder")
    add_out(score)
    add_detectors(score)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


def _run(given: argparse.Namespace) -> int:
    from bench.cli.dry_run import look_ahead
    from bench.cli.terminal import Terminal, TerminalProgress
    from bench.rig.loading import find_rig, load_rig
    from bench.run.events import Events, event_lines
    from bench.script.model import find_script, load_script
    from bench.script.pixel_offsets import is_offset_script

    rig = load_rig(find_rig(given.rig))
    path = find_script(given.script)
    if is_offset_script(path):
        return _run_offsets(rig, path, given.out, dry=given.dry_run)
    script = load_script(path, rig.rig.limits.set_point_c)
    if given.dry_run:
        return look_ahead(rig, script, given.out, given.detector, given.seed)
    from bench.run.start import RunOptions, run_script

    console = Terminal()
    with event_lines(given.events) as lines, TerminalProgress(console) as shown:
        progress = Events(shown, lines)
        how = RunOptions(
            typed=typed_lines(rig.rig.operator.url),
            seed=given.seed,
            detectors=given.detector,
            record=given.record,
            realtime=given.realtime,
            capture=given.capture,
            begun=shown.say,
        )
        folder, _ = run_script(rig, script, given.out, progress, how)
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    _compare_times(folder, given.out, rig, script)
    return code


def _compare_times(folder: Path, out: Path, rig: LoadedRig, script: LoadedScript) -> None:
    """Print what the run took beside what was expected, and learn from it; one that didn't get
    through teaches nothing.
    """
    from bench.record.reader import read_run
    from bench.run.estimate import figures, needs, read_learnt, told, took, write_learnt

    run = read_run(folder)
    spent = took(run)
    if run.ending == "finished" and "total_s" in spent:
        expected = needs(rig, script, read_learnt(out, rig)).time
        write_learnt(folder, rig, expected, spent, figures(run, rig, script, spent))
        print(told(expected, spent))


def _resume(given: argparse.Namespace) -> int:
    from bench.cli.terminal import Terminal, TerminalProgress
    from bench.record.reader import read_run
    from bench.run.events import Events, event_lines
    from bench.run.resume import files_of
    from bench.run.start import RunOptions, resume_run

    console = Terminal()
    with undamaged([given.run], given) as damage:
        operator = files_of(read_run(given.run))[0].rig.operator.url
        with event_lines(given.events) as lines, TerminalProgress(console) as shown:
            progress = Events(shown, lines)
            resume_run(
                given.run,
                progress,
                RunOptions(capture=given.capture, typed=typed_lines(operator), begun=shown.say),
            )
            progress.state("writing the report")
            code, show = _reported(given.run, damage=damage)
        show(console)
    return code


def _control(given: argparse.Namespace) -> int:
    from bench.record.reader import read_run
    from bench.run.requests import leave_wish, was_taken
    from instruments.clock import RealClock

    run = read_run(given.run)
    if run.ending != "interrupted":
        print(f"{given.run} has ended ({run.ending}): nobody is there to hear it.")
        return CODES.wrong_use
    leave_wish(given.run, " ".join(given.words))
    if was_taken(given.run, RealClock(), TOLD_S):
        print("taken; what comes of it is shown at the run's terminal.")
    else:
        print(
            f"left for the run, which has not looked for {TOLD_S:g} s: it is busy, or its bench has"
            " died and takes nothing any more."
        )
    return CODES.met


def add_events(parser: argparse.ArgumentParser) -> None:
    """Where what goes on is told as JSON lines."""
    parser.add_argument(
        "--events",
        type=Path,
        metavar="FILE",
        help="also tell what goes on as JSON lines, for others to watch",
    )


def typed_lines(operator_url: str) -> Callable[[], str | None]:
    """Lines typed at this terminal, where it is one and no operator is asked there."""
    from bench.rig.urls import CONSOLE
    from instruments.operators.console import keyboard_of

    if operator_url == CONSOLE or sys.stdin is None or not sys.stdin.isatty():
        return lambda: None
    keyboard, terminal = keyboard_of(sys.stdin, lambda _: None), sys.stdin.fileno()
    return lambda: keyboard.line() if _is_ours(terminal) else None


def _is_ours(terminal: int) -> bool:
    """Whether what is typed there is for us: who reads a terminal from the background (`teatbench
    run &`) is stopped by the system.
    """
    if sys.platform == "win32":
        return True
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # no terminal of ours: nothing stops us there
        return True


def _score(given: argparse.Namespace) -> int:
    from bench.cli.terminal import Terminal, TerminalProgress
    from bench.record.reader import read_run
    from bench.report.tables import score_table
    from bench.run.events import SafeProgress
    from bench.run.start import score_recording

    console = Terminal()
    with TerminalProgress(console) as shown:
        progress = SafeProgress(shown)
        folder = score_recording(given.recording, given.out, progress, given.detector or ["thesis"])
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    print(f"\n{score_table(read_run(folder))}")
    return code


def _run_offsets(rig: LoadedRig, path: Path, out: Path, *, dry: bool) -> int:
    """A sensitivity script: no instrument takes part."""
    from bench.report.pixel_offsets import run_offsets
    from bench.script.pixel_offsets import load_offsets, outcomes

    if dry:
        outcomes(load_offsets(path), rig.calibration)
        print("nothing wrong. This script opens no instrument.")
        return CODES.met
    return _offsets_reported(run_offsets(rig, path, out))


def _offsets_reported(folder: Path) -> int:
    from bench.report.pixel_offsets import offset_told, report_offsets

    page, loaded, found, verdict = report_offsets(folder)
    for one in found:
        figures = (
            f"up to {one.worst_mm:.2f} mm in the worst of {len(one.errors_mm)} directions, median"
            f" {one.median_mm:.2f} mm"
        )
        print(f"teat {one.offset.teat}, {offset_told(one.offset)}: {figures}")
    print(f"Verdict: {verdict} (limit {loaded.script.limit_mm:g} mm)\nReport: {page}")
    return CODES.met if verdict == "met" else CODES.not_met


def _report(given: argparse.Namespace) -> int:
    from bench.cli.terminal import Terminal
    from bench.config import ConfigError
    from bench.report.pixel_offsets import is_offset_run
    from reports.pdf import find_browser

    browser = None if given.no_pdf else find_browser()
    if given.pdf and browser is None:
        raise ConfigError.plain(
            "no Chromium, Chrome or Edge was found to print a PDF with. Install one, or print"
            " index.html by hand."
        )
    if is_offset_run(given.run):
        code = _offsets_reported(given.run)
    else:
        with undamaged([given.run, *filter(None, [given.baseline])], given) as damage:
            code, show = _reported(given.run, _extras(given, damage), damage)
            show(Terminal())
    if browser:
        _print(given.run, browser, needed=given.pdf)
    return code


def _print(folder: Path, browser: str, *, needed: bool) -> None:
    """The report as PDF, when all else is written and told. Raises ConfigError where it is needed
    and can't be printed.
    """
    from bench.config import ConfigError
    from bench.report.page import PDF, REPORT
    from reports.pdf import print_pdf
    from reports.trust import PageError

    try:
        print(f"PDF: {print_pdf(folder / REPORT / 'index.html', folder / REPORT / PDF, browser)}")
    except (PageError, OSError) as error:
        if needed:
            raise ConfigError.plain(str(error)) from error
        print(f"no PDF: {error}", file=sys.stderr)


def _extras(given: argparse.Namespace, damage: tuple[str, ...]) -> Extras:
    """What was asked for besides the page. Raises ConfigError before anything is written."""
    from bench.report.comparison import baseline_section
    from bench.report.page import Extras

    chapters = (baseline_section(given.baseline, given.run, damage),) if given.baseline else ()
    return Extras(chapters, given.single_file)


def _reported(
    folder: Path, extras: Extras | None = None, damage: tuple[str, ...] = ()
) -> tuple[int, Callable[..., None]]:
    """Write the report of a run; gives back the exit code that it deserves, and what shows it on a
    console.
    """
    from bench.cli.terminal import show_result
    from bench.report.page import PLAIN, write_run_report
    from bench.results.verdicts import run_verdict

    path, run, judgements = write_run_report(folder, extras or PLAIN, damage)
    codes = {"met": CODES.met, "not met": CODES.not_met}
    code = (
        CODES.fault
        if run.ending != "finished"
        else codes.get(run_verdict(judgements).value, CODES.inconclusive)
    )
    return code, lambda console: show_result(console, run, judgements, path)
