"""`calibrate board|export|import`, and what every step of a calibration does with its file: record,
page, exit code.

What `calibrate cameras|thermal|world --rig` do before they calculate: the rig's cameras opened, the
operator led, the pictures kept.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, Commands

if TYPE_CHECKING:
    from bench.calibrate.capture import ViewsRequest
    from bench.rig.cameras_alone import Look
    from bench.rig.loading import LoadedRig
    from bench.rig.opening import Parts
    from detector.calibration import Calibration, Part, Record
    from detector.calibration.diagnosis import Finding
    from instruments.camera.frame import Grey
    from reports.page import Page


def add_files(group: Commands) -> None:
    """The commands with their arguments."""
    board = group.add(
        "board", "a calibration board as a PDF in true size", _board, opens_links=False
    )
    board.add_argument("board", metavar="BOARD", help="a shipped board by name, or a .toml file")
    board.add_argument("--pdf", type=Path, required=True, metavar="FILE", help="where to write it")
    board.add_argument(
        "--paper",
        choices=("A4", "A3", "A2", "A1", "A0"),
        help="the sheet (default: the smallest that holds it)",
    )
    export = group.add("export", "write a calibration for another tool", _export, opens_links=False)
    export.add_argument("calibration", type=Path, metavar="CAL")
    export.add_argument("--format", choices=("opencv", "bouguet", "ros"), required=True)
    export.add_argument(
        "--camera",
        choices=("left", "right", "thermal"),
        default="left",
        help="for ros, which has one camera a file",
    )
    export.add_argument("--out", type=Path, required=True, metavar="FILE")
    export.add_argument("--replace", action="store_true", help="write over a file that is there")
    taken = group.add(
        "import",
        "take the cameras of another tool over, as a part for merge",
        _import,
        opens_links=False,
    )
    taken.add_argument(
        "file", nargs="+", type=Path, metavar="FILE", help="for ros two: left, right"
    )
    taken.add_argument("--format", choices=("opencv", "bouguet", "ros"), required=True)
    taken.add_argument(
        "--image-size",
        type=size,
        metavar="COLUMNSxROWS",
        help="for opencv, whose files may leave it out",
    )
    add_out_file(taken, "cameras.toml")


def add_out_file(parser: argparse.ArgumentParser, name: str) -> None:
    """Where a step writes its file, and who says so."""
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help=f"where to write it, such as {name}; its page stands beside it",
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
    given: argparse.Namespace,
    inputs: Sequence[Path],
    cameras: Mapping[str, str],
    more: Mapping[str, str] | None = None,
) -> Record:
    """Who, today, with this program, from these files."""
    from bench import __version__
    from detector.calibration import Record, file_hash
    from instruments.clock import wall_time

    names = _short_names(inputs)
    hashes = {name: file_hash(path) for name, path in zip(names, inputs, strict=True)}
    return Record(
        wall_time().date().isoformat(),
        given.by,
        f"teatbench {__version__}",
        cameras,
        {**hashes, **(more or {})},
    )


def _short_names(paths: Sequence[Path]) -> list[str]:
    """As short as keeps them apart: the name, with the folder before it where two files have one
    name.
    """
    names = [path.name for path in paths]
    return [
        f"{path.parent.name}/{path.name}" if names.count(path.name) > 1 else path.name
        for path in paths
    ]


def write_step(given: argparse.Namespace, found: Part | Calibration, page: Page | None) -> None:
    """The step's file, whole or not at all, and its page beside it."""
    from bench.files import write_synced
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
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.board_print import board_pdf
    from bench.files import write_synced
    from bench.rig.board import find_board_file, load_board

    refuse_existing(given.pdf, replace=True, option="--pdf")
    write_synced(given.pdf, board_pdf(load_board(find_board_file(given.board)).board, given.paper))
    print(f"written: {given.pdf}; print it at 100 % and measure the line at its foot")
    return CODES.met


def _export(given: argparse.Namespace) -> int:
    from bench.calibrate import exchange
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.merge import read_part

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

    from bench.calibrate import exchange
    from bench.calibrate.arm import refuse_existing
    from bench.config import ConfigError

    refuse_existing(given.out, replace=given.replace)
    if len(given.file) > (2 if given.format == "ros" else 1):
        raise ConfigError.plain(
            f"{given.format} takes"
            f" {'two files at most, left and right' if given.format == 'ros' else 'one file'}"
        )
    if given.format == "opencv":
        part = exchange.read_opencv(given.file[0], given.image_size)
    elif given.format == "bouguet":
        part = exchange.read_bouguet(given.file[0])
    else:
        part = exchange.read_ros(*given.file)
    write_step(given, replace(part, record=make_record(given, given.file, {})), None)
    return CODES.met


PEG = "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."


@dataclass(frozen=True, slots=True)
class Gathered:
    """Where the pictures are, and which cameras took them."""

    folder: Path
    identity: dict[str, str]


def add_rig_option(parser: argparse.ArgumentParser) -> None:
    """The rig, in the place of files that are there already."""
    parser.add_argument(
        "--rig", metavar="RIG", help="live, with the cameras of this rig: by name, or a .toml file"
    )
    parser.add_argument(
        "--seed", type=int, metavar="N", help="of the emulators' noise (default: the rig's)"
    )


def gather_views(
    given: argparse.Namespace, wanted: ViewsRequest, known: Part | None = None
) -> Gathered:
    """Views of ``given.board`` from the cameras of ``given.rig``, which are those of ``known``.

    Raises ConfigError, InstrumentError, OperatorAbort.
    """
    from bench.calibrate.capture import free_folder, gather
    from bench.rig.board import find_board_file, load_board
    from instruments.operators.operator import Finish

    board = load_board(find_board_file(given.board)).board
    folder = free_folder(given.out)
    with _opened(given, known, arm=False) as (parts, rig):
        kept = gather(_look(parts, rig), parts.operator, board, wanted, folder, _tell)
        parts.operator.ask(Finish())
        identity = {
            camera: str(who)
            for camera, who in parts.cameras.identity.items()
            if camera in wanted.cameras
        }
    _tell(f"{kept} views in {folder}")
    return Gathered(folder, identity)


def gather_world(given: argparse.Namespace, known: Part) -> Gathered:
    """Points of ``given.board`` that the arm of ``given.rig`` touched and its cameras, those of
    ``known``, saw: a table in the folder.
    """
    from bench.calibrate.capture import free_folder
    from bench.calibrate.touch_board import Asking, gather_points
    from bench.rig.board import find_board_file, load_board
    from bench.truth.arm_tip import TipReader
    from instruments.operators.operator import Finish, Homing

    board = load_board(find_board_file(given.board)).board
    folder = free_folder(given.out)
    with _opened(given, known, arm=True) as (parts, rig):
        arm = parts.arm
        if arm is None:
            raise ValueError("the arm was asked for, and is not open")
        try:
            arm.sign_on()
            tip = TipReader(arm, rig.rig.arm, rig.frame)
            tip.refuse_other_arm()
            parts.operator.ask(Homing(PEG))
            arm.confirm_homed()
            asking = Asking(
                _look(parts, rig), parts.operator, tip, rig.rig.arm.tip_radius_mm, _tell
            )
            gather_points(asking, board, folder)
            parts.operator.ask(Finish())
        finally:
            arm.safe()
        identity = {"arm": arm.identity.serial_number}
    return Gathered(folder, identity)


@contextmanager
def _opened(
    given: argparse.Namespace, known: Part | None, *, arm: bool
) -> Iterator[tuple[Parts, LoadedRig]]:
    from bench.rig.loading import find_rig, load_rig
    from bench.rig.opening import open_parts
    from bench.script.calibration_age import refuse_other_cameras

    rig = load_rig(find_rig(given.rig))
    seed = rig.rig.seed if given.seed is None else given.seed
    with open_parts(rig, seed=seed, arm=arm, capture=given.capture) as parts:
        refuse_other_cameras(known.record if known else None, parts.cameras.identity)
        yield parts, rig


def _look(parts: Parts, rig: LoadedRig) -> Look:
    """Takes each camera's picture, once whatever the operator moved has come to rest."""
    from bench.rig.cameras_alone import patient, pictures

    taken = patient(lambda: pictures(parts.cameras.capture()))

    def look() -> Mapping[str, Grey]:
        parts.clock.sleep(rig.rig.cameras.settle_s)
        return taken()

    return look


def _tell(text: str) -> None:
    print(text, flush=True)
