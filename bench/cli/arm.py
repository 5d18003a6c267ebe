"""`arm read`, `watch`, `home`, `frame` and `verify`: one MicroScribe alone, no rig file."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.cli.arguments import CODES, Commands, whole

BAUDS = (9600, 14400, 19200, 28800, 38400, 57600, 115200)
PORT = (
    '"/dev/ttyUSB0", "COM5", "socket://host:port", or "emulator:" for an emulated arm to try it on'
)


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    arm = commands.group(
        "arm", "a MicroScribe arm alone: read, watch, home, set the table frame, verify"
    )
    read = _add(arm, "read", "one position", _read, homed=True)
    read.add_argument(
        "--packets",
        type=whole(1, 1000),
        default=8,
        metavar="N",
        help="packets that make one reading (default: 8)",
    )
    read.add_argument(
        "--frame",
        type=Path,
        metavar="FILE",
        help="a table frame: gives the position in the world too",
    )
    read.add_argument("--json", action="store_true", help="one JSON object, units in its keys")
    watch = _add(arm, "watch", "tip, pedals and rate, live, until Ctrl-C", _watch, homed=True)
    watch.add_argument("--seconds", type=_positive, metavar="S", help="stop after this time")
    home = _add(arm, "home", "load the home counts, with the stylus on its peg", _home)
    home.add_argument("--on-peg", action="store_true", help="the stylus is on its peg: don't ask")
    frame = _add(
        arm,
        "frame",
        "set the table frame: three touches and check points (docs/arm.md)",
        _frame,
        homed=True,
    )
    frame.add_argument(
        "--plane-checks",
        type=whole(0, 20),
        default=1,
        metavar="N",
        help="further touches anywhere in the plane (default: 1)",
    )
    frame.add_argument(
        "--check",
        type=_point,
        action="append",
        default=[],
        metavar="X,Y,Z",
        help="touch this known point too, world mm; may be given several times (--check=-60,80,0)",
    )
    frame.add_argument(
        "--residual-limit-mm",
        type=_positive,
        default=1.5,
        metavar="MM",
        help="check points may be off by this (default: 1.5)",
    )
    _add_out(frame)
    verify = _add(
        arm,
        "verify",
        "verify the arm: one divot at up to three distances, a calibrated length (docs/arm.md)",
        _verify,
        homed=True,
    )
    verify.add_argument(
        "--distances",
        type=whole(1, 3),
        default=3,
        metavar="N",
        help="divots: 1 middle, 2 near and far, 3 all (default: 3)",
    )
    verify.add_argument(
        "--touches",
        type=whole(5, 100),
        default=10,
        metavar="N",
        help="touches in each divot (default: 10)",
    )
    verify.add_argument(
        "--length-mm", type=_positive, metavar="L", help="a calibrated length to measure too"
    )
    verify.add_argument(
        "--directions",
        type=whole(1, 7),
        default=7,
        metavar="N",
        help="directions to measure it in (default: 7)",
    )
    verify.add_argument(
        "--script",
        metavar="SCRIPT",
        help="whose limits to hold it against (default: six-situations)",
    )
    _add_out(verify)


def _add(
    group: Commands,
    name: str,
    what: str,
    command: Callable[[argparse.Namespace], int],
    *,
    homed: bool = False,
) -> argparse.ArgumentParser:
    parser = group.add(name, what, _abortable(command))
    parser.add_argument("--port", required=True, metavar="URL", help=PORT)
    parser.add_argument(
        "--baud",
        type=int,
        choices=BAUDS,
        default=115200,
        metavar="RATE",
        help="of a serial port (default: 115200)",
    )
    parser.add_argument(
        "--answer-s",
        type=_positive,
        default=0.12,
        metavar="S",
        help="how long an answer is waited for (default: 0.12)",
    )
    if homed:
        parser.add_argument(
            "--homed",
            action="store_true",
            help="the stylus was on its peg when the arm was last switched on: don't ask",
        )
    return parser


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="where to write it; the rig file names it",
    )
    parser.add_argument("--replace", action="store_true", help="write over a file that is there")


def _abortable(command: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    def run(given: argparse.Namespace) -> int:
        from instruments.operators.operator import OperatorAbort

        try:
            return command(given)
        except OperatorAbort as abort:
            print(f"teatbench: {abort}; nothing was written", file=sys.stderr)
            return CODES.fault

    return run


def _read(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import NO_TERMINAL, open_arm
    from bench.config import ConfigError
    from bench.rig.arm_files import load_frame

    if not given.homed and not sys.stdin.isatty():
        raise ConfigError.plain(NO_TERMINAL)
    frame = load_frame(given.frame) if given.frame else None
    with open_arm(given.port, given.baud, given.answer_s, given.capture) as session:
        serial_number = session.arm.identity.serial_number
        if frame:
            frame = load_frame(given.frame, serial_number=serial_number)
        session.confirm_homing(homed=given.homed)
        reading = session.arm.read(given.packets)
    line: dict[str, Any] = {"serial_number": serial_number, "tip_mm": reading.tip_mm.tolist()}
    if frame:
        line["world_mm"] = frame.world_from_arm.apply(reading.tip_mm).tolist()
    line |= {
        "spread_mm": reading.spread_mm,
        "axis": reading.axis.tolist(),
        "packets": reading.n,
        "counts": list(reading.counts),
    }
    if given.json:
        print(json.dumps(line))
        return CODES.met
    print(f"arm {serial_number}")
    print(
        f"tip {_mm(line['tip_mm'])} in the arm's frame, spread {reading.spread_mm:.2f} mm over"
        f" {reading.n} packets"
    )
    if frame:
        print(f"    {_mm(line['world_mm'])} in the world (frame of {frame.made:%Y-%m-%d})")
    return CODES.met


def _watch(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import NO_TERMINAL, open_arm
    from bench.cli.live_view import watch
    from bench.config import ConfigError

    if not given.homed and not sys.stdin.isatty():
        raise ConfigError.plain(NO_TERMINAL)
    live = sys.stdout.isatty()
    with open_arm(given.port, given.baud, given.answer_s, given.capture) as session:
        session.confirm_homing(homed=given.homed)
        try:
            for line in watch(session.arm, session.clock, given.seconds):
                print("\r" if live else "", line, sep="", end="" if live else "\n", flush=True)
        except KeyboardInterrupt:
            return CODES.met
        finally:
            if live:
                print(flush=True)
    return CODES.met


def _home(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import PEG, open_arm
    from bench.config import ConfigError

    if not given.on_peg and not sys.stdin.isatty():
        raise ConfigError.plain(
            "homing with the stylus off its peg ruins every position. Put it there, and give"
            " --on-peg to say so."
        )
    with open_arm(given.port, given.baud, given.answer_s, given.capture) as session:
        if not given.on_peg:
            session.ask(
                f"{PEG} and let go of it. Anywhere else, homing makes every position wrong."
            )
        session.arm.home()
        reading = session.arm.read()
    print(
        f"Homed. The tip stands at {_mm(reading.tip_mm.tolist())} in the arm's frame. Leave the arm"
        " switched on."
    )
    return CODES.met


def _frame(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import open_arm, refuse_existing
    from bench.rig.arm_files import frame_text, write_file

    refuse_existing(given.out, replace=given.replace)
    with open_arm(given.port, given.baud, given.answer_s, given.capture) as session:
        session.confirm_homing(homed=given.homed)
        frame = session.frame([*given.check, *[None] * given.plane_checks])
    for name, residual in frame.residuals_mm.items():
        print(f"{name}: {residual:.2f} mm off")
    if frame.residual_mm is not None and frame.residual_mm > given.residual_limit_mm:
        print(
            f"teatbench: a check point is {frame.residual_mm:.2f} mm off, limit"
            f" {given.residual_limit_mm:g} mm; nothing was written. Is the arm clamped fast, homed,"
            " and is the plane flat? Touch all points again.",
            file=sys.stderr,
        )
        return CODES.not_met
    write_file(given.out, frame_text(frame))
    if frame.residual_mm is None:
        print("No check point was touched, so nothing is known of how good this frame is.")
    print(f'Written: {given.out}. Name it in the rig file: [arm] frame = "{given.out.name}"')
    return CODES.met


def _verify(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import limits_of, open_arm, refuse_existing
    from bench.calibrate.arm_dialogues import Plan
    from bench.rig.arm_files import verification_text, write_file

    refuse_existing(given.out, replace=given.replace)
    limits = limits_of(given.script)
    if given.length_mm is None and limits.length_mm is not None:
        print("Without --length-mm no length is measured, and the arm can't be verified whole.")
    plan = Plan(given.distances, given.touches, given.length_mm, given.directions)
    with open_arm(
        given.port, given.baud, given.answer_s, given.capture, length_mm=given.length_mm
    ) as session:
        session.confirm_homing(homed=given.homed)
        found = session.verification(plan)
    write_file(given.out, verification_text(found, limits))
    print(f"Articulated location error {found.location_mm:.2f} mm, limit {limits.location_mm:g} mm")
    if found.length_mm is not None:
        print(
            f"Largest error of the calibrated length {found.length_mm:.2f} mm, limit"
            f" {limits.length_mm:g} mm"
        )
    print(f'Written: {given.out}. Name it in the rig file: [arm] verification = "{given.out.name}"')
    faults = found.faults(limits)
    for fault in faults:
        print(f"teatbench: not verified: {fault}", file=sys.stderr)
    return CODES.not_met if faults else CODES.met


def _mm(point: list[float]) -> str:
    return ", ".join(f"{v:.2f}" for v in point) + " mm"


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def _point(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a point; write three numbers as 120,80,0"
        ) from error
    if not all(abs(v) < 1e4 for v in (x, y, z)):
        raise argparse.ArgumentTypeError(f"{text!r} is not within 10 m of the origin")
    return x, y, z
