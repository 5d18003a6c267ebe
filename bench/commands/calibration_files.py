"""`calibrate board|export|import`, and what every step of a calibration does with its file: record, page, exit code."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands

if TYPE_CHECKING:
    from detector.calibration import Calibration, Part, Record
    from detector.calibration.diagnosis import Finding
    from reports.page import Page


def add_files(group: Commands) -> None:
    """The commands with their arguments."""
    board = group.add("board", "a calibration board as a PDF in true size", _board, opens_links=False)
    board.add_argument("board", metavar="BOARD", help="a shipped board by name, or a .toml file")
    board.add_argument("--pdf", type=Path, required=True, metavar="FILE", help="where to write it")
    board.add_argument("--paper", choices=("A4", "A3", "A2", "A1", "A0"), help="the sheet (default: the smallest that holds it)")
    export = group.add("export", "write a calibration for another tool", _export, opens_links=False)
    export.add_argument("calibration", type=Path, metavar="CAL")
    export.add_argument("--format", choices=("opencv", "bouguet", "ros"), required=True)
    export.add_argument("--camera", choices=("left", "right", "thermal"), default="left", help="for ros, which has one camera a file")
    export.add_argument("--out", type=Path, required=True, metavar="FILE")
    export.add_argument("--replace", action="store_true", help="write over a file that is there")
    taken = group.add("import", "take the cameras of another tool over, as a part for merge", _import, opens_links=False)
    taken.add_argument("file", nargs="+", type=Path, metavar="FILE", help="for ros two: left, right")
    taken.add_argument("--format", choices=("opencv", "bouguet", "ros"), required=True)
    taken.add_argument("--image-size", type=size, metavar="COLUMNSxROWS", help="for opencv, whose files may leave it out")
    add_out_file(taken, "cameras.toml")


def add_out_file(parser: argparse.ArgumentParser, name: str) -> None:
    """Where a step writes its file, and who says so."""
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help=f"where to write it, such as {name}; its page stands beside it"
    )
    parser.add_argument("--replace", action="store_true", help="write over a file that is there")
    parser.add_argument("--by", default="", metavar="NAME", help="who calibrated, for the record")


def size(text: str) -> tuple[int, int]:
    """COLUMNSxROWS as numbers."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is no size such as 640x480")
    return int(found[1]), int(found[2])


def make_record(
    given: argparse.Namespace, inputs: Sequence[Path], cameras: Mapping[str, str], more: Mapping[str, str] | None = None
) -> Record:
    """Who, today, with this program, from these files."""
    from bench import __version__
    from detector.calibration import Record, file_hash
    from instruments.clock import wall_time

    names = _short_names(inputs)
    hashes = {name: file_hash(path) for name, path in zip(names, inputs, strict=True)}
    return Record(wall_time().date().isoformat(), given.by, f"teatbench {__version__}", cameras, {**hashes, **(more or {})})


def _short_names(paths: Sequence[Path]) -> list[str]:
    """As short as keeps them apart: the name, with the folder before it where two files have one name."""
    names = [path.name for path in paths]
    return [f"{path.parent.name}/{path.name}" if names.count(path.name) > 1 else path.name for path in paths]


def write_step(given: argparse.Namespace, found: Part | Calibration, page: Page | None) -> None:
    """The step's file, whole or not at all, and its page beside it."""
    from bench.store import write_synced
    from detector.calibration import dump_calibration
    from reports.render import write_report

    write_synced(given.out, dump_calibration(found, command_line()).encode("utf-8"))
    print(f"written: {given.out}")
    if page is not None:
        print(f"page: {write_report(page, given.out.with_suffix('.page'))}")


def told(findings: Sequence[Finding]) -> int:
    """Say what was found wrong; the exit code for it."""
    for finding in findings:
        print(f"teatbench: {finding.name}: {finding.sentence}", file=sys.stderr)
    return CODES.not_met if findings else CODES.met


def command_line() -> str:
    """The command as it was given, to be given again."""
    return shlex.join(["teatbench", *sys.argv[1:]])


def _board(given: argparse.Namespace) -> int:
    from bench.arm.session import refuse_existing
    from bench.calibrating.board_file import find_board_file, load_board
    from bench.calibrating.board_print import board_pdf
    from bench.store import write_synced

    refuse_existing(given.pdf, replace=True, option="--pdf")
    write_synced(given.pdf, board_pdf(load_board(find_board_file(given.board)).board, given.paper))
    print(f"written: {given.pdf}; print it at 100 % and measure the line at its foot")
    return CODES.met


def _export(given: argparse.Namespace) -> int:
    from bench.arm.session import refuse_existing
    from bench.calibrating import exchange
    from bench.calibrating.merging import read_part

    refuse_existing(given.out, replace=given.replace)
    part = read_part(given.calibration).part
    if given.format == "opencv":
        exchange.write_opencv(part, given.out)
    elif given.format == "bouguet":
        exchange.write_bouguet(part, given.out)
    else:
        exchange.write_ros(part, given.out, given.camera)
    print(f"written: {given.out}")
    return CODES.met


def _import(given: argparse.Namespace) -> int:
    from dataclasses import replace

    from bench.arm.session import refuse_existing
    from bench.calibrating import exchange
    from bench.config import ConfigError

    refuse_existing(given.out, replace=given.replace)
    if len(given.file) > (2 if given.format == "ros" else 1):
        raise ConfigError.plain(f"{given.format} takes {'two files at most, left and right' if given.format == 'ros' else 'one file'}")
    if given.format == "opencv":
        part = exchange.read_opencv(given.file[0], given.image_size)
    elif given.format == "bouguet":
        part = exchange.read_bouguet(given.file[0])
    else:
        part = exchange.read_ros(*given.file)
    write_step(given, replace(part, record=make_record(given, given.file, {})), None)
    return CODES.met
