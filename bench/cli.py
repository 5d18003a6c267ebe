"""The commands. Reads arguments, calls the jobs, prints; the only place that prints, and that knows exit codes.

Everything heavy is imported by the command that needs it, so that ``teatbench --help`` answers at once.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sqlite3
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from bench import __version__

MET, NOT_MET, WRONG_USE, FAULT, INCONCLUSIVE = 0, 1, 2, 3, 4
EXIT_CODES = """exit codes: 0 all requirements met, 1 a requirement not met, 2 wrong use or file,
3 aborted or instrument fault, 4 inconclusive"""
OUT = Path("runs")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; gives back its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(encoding="utf-8", errors="replace")  # a Windows console may be set to less
    if hasattr(signal, "SIGTERM"):
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C: through safe
    given = _parser().parse_args(arguments)
    from bench.config import ConfigError
    from instruments.camera.recording import RecordingError
    from instruments.errors import InstrumentError

    try:
        code: int = given.command(given)
        sys.stdout.flush()
        return code
    except (ConfigError, RecordingError) as error:
        return _complain(str(error), WRONG_USE)
    except InstrumentError as error:
        return _complain(str(error), FAULT)
    except KeyboardInterrupt:
        return _complain("interrupted", FAULT)
    except sqlite3.Error as error:
        return _complain(f"the run's record can't be written or read: {error}. Is the disk full, or the folder read-only?", FAULT)
    except BrokenPipeError:  # the reader of our output has gone (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return MET


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="teatbench", description="A hardware-in-the-loop test bench for teat detectors.", epilog=EXIT_CODES
    )
    parser.add_argument("--version", action="version", version=f"teatbench {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, what: str, command: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=what, description=what, epilog=EXIT_CODES)
        sub.set_defaults(command=command)
        return sub

    run = add("run", "run a trial script on a rig and write the scored report", _run)
    run.add_argument("script", nargs="?", help="a shipped script by name, or a .toml file (default: six-situations)")
    run.add_argument("--rig", help="a shipped rig by name, or a .toml file (default: emulated)")
    run.add_argument("--seed", type=_seed, help="seed of all chance (default: the rig file's)")
    run.add_argument("--record", type=Path, metavar="DIR", help="also write a recording that 'teatbench score' reads")
    run.add_argument("--realtime", action="store_true", help="emulated rig only: let time pass as it does")
    _add_common(run)
    report = add("report", "(re)write the report of a run", _report)
    report.add_argument("run", type=Path, help="the run's folder")
    score = add("score", "score detectors on recorded frames", _score)
    score.add_argument("recording", type=Path, help="a recording's folder")
    _add_common(score)
    detect = add("detect", "detect only: what each detector finds in recorded frames", _detect)
    detect.add_argument("recording", type=Path, help="a recording's folder")
    detect.add_argument("--detector", action="append", default=[], metavar="NAME", help="may be given several times (default: thesis)")
    detect.add_argument("--json", action="store_true", help="one JSON line a frame")
    check = add("check", "connect to every instrument, print who it is and one reading", _check)
    check.add_argument("rig", nargs="?", help="a shipped rig by name, or a .toml file (default: emulated)")
    emulate = add("emulate", "only the emulators of a rig, in real time, until Ctrl-C", _emulate)
    emulate.add_argument("rig", nargs="?", help="a shipped rig by name, or a .toml file (default: emulated)")
    emulate.add_argument("--listen", default="127.0.0.1", metavar="HOST", help="address to listen on (default: 127.0.0.1)")
    add("rigs", "the rig files that ship", _rigs)
    add("trials", "the trial scripts that ship", _trials)
    add("detectors", "the detectors that ship", _detectors)
    return parser


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=OUT, metavar="DIR", help="where run folders go (default: runs)")
    parser.add_argument("--detector", action="append", default=[], metavar="NAME", help="may be given several times")


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


def _run(given: argparse.Namespace) -> int:
    from rich.console import Console

    from bench.jobs import run_script
    from bench.progress import TerminalProgress
    from bench.rig import find_rig, load_rig
    from bench.script import find_script, load_script

    rig = load_rig(find_rig(given.rig))
    script = load_script(find_script(given.script), rig.rig.limits.set_point_c)
    console = Console()
    with TerminalProgress(console) as progress:
        folder, _ = run_script(
            rig, script, given.out, progress, seed=given.seed, detectors=given.detector, record=given.record, realtime=given.realtime
        )
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    return code


def _score(given: argparse.Namespace) -> int:
    from rich.console import Console

    from bench.jobs import score_recording
    from bench.progress import TerminalProgress

    console = Console()
    with TerminalProgress(console) as progress:
        folder = score_recording(given.recording, given.out, progress, given.detector or ["thesis"])
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    return code


def _report(given: argparse.Namespace) -> int:
    from rich.console import Console

    code, show = _reported(given.run)
    show(Console())
    return code


def _reported(folder: Path) -> tuple[int, Callable[..., None]]:
    """Write the report of a run; gives back the exit code that it deserves, and what shows it on a console."""
    from bench.progress import show_result
    from bench.summary import write_run_report
    from bench.verdicts import run_verdict

    path, run, judgements = write_run_report(folder)
    codes = {"met": MET, "not met": NOT_MET}
    code = FAULT if run.ending != "finished" else codes.get(run_verdict(judgements).value, INCONCLUSIVE)
    return code, lambda console: show_result(console, run, judgements, path)


def _detect(given: argparse.Namespace) -> int:
    from bench.detections import detect_lines

    for line, text in detect_lines(given.recording, given.detector or ["thesis"]):
        print(json.dumps(line) if given.json else text, flush=True)
    return MET


def _check(given: argparse.Namespace) -> int:
    from bench.checks import check_rig
    from bench.rig import find_rig, load_rig

    failed = False
    for name, fault, lines in check_rig(load_rig(find_rig(given.rig))):
        failed |= fault
        print(f"{name}: {'FAULT' if fault else 'ok'}")
        for line in lines:
            print(f"  {line}")
    return FAULT if failed else MET


def _emulate(given: argparse.Namespace) -> int:
    from bench.emulation import EmulatedRig
    from bench.rig import find_rig, load_rig
    from instruments.clock import RealClock

    rig = load_rig(find_rig(given.rig))
    clock = RealClock()
    try:
        with EmulatedRig(rig, clock, rig.rig.seed, host=given.listen) as twin:
            for name, url in twin.urls.items():
                print(f"{name} {url}", flush=True)
            while True:
                clock.sleep(0.5)
    except KeyboardInterrupt:
        return MET
    except OSError as error:
        return _complain(f"can't listen on {given.listen}: {error}", WRONG_USE)
    finally:
        clock.close()


def _rigs(_: argparse.Namespace) -> int:
    from bench.rig import RIGS, shipped

    return _list({name: "" for name in shipped(RIGS) if name != "calibration"})


def _trials(_: argparse.Namespace) -> int:
    from bench.rig import shipped
    from bench.script import TRIALS, load_script

    return _list({name: load_script(TRIALS / f"{name}.toml").script.about for name in shipped(TRIALS)})


def _detectors(_: argparse.Namespace) -> int:
    from detector.registry import available

    return _list(available())


def _list(rows: dict[str, str]) -> int:
    for name, what in rows.items():
        print(f"{name}: {what}" if what else name)
    return MET


def _complain(text: str, code: int) -> int:
    print(f"teatbench: {text}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
