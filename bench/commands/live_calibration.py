"""What `calibrate cameras|thermal|world --rig` do before they calculate: the rig's cameras opened, the operator led, the pictures kept."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.alone.cameras import Look
    from bench.calibrating.live import Wanted
    from bench.hookup import Parts
    from bench.rig import LoadedRig
    from detector.calibration import Part
    from instruments.camera.frame import Grey

PEG = "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."


@dataclass(frozen=True, slots=True)
class Gathered:
    """Where the pictures are, and which cameras took them."""

    folder: Path
    identity: dict[str, str]


def add_rig_option(parser: argparse.ArgumentParser) -> None:
    """The rig, in the place of files that are there already."""
    parser.add_argument("--rig", metavar="RIG", help="live, with the cameras of this rig: by name, or a .toml file")
    parser.add_argument("--seed", type=int, metavar="N", help="of the emulators' noise (default: the rig's)")


def gather_views(given: argparse.Namespace, wanted: Wanted, known: Part | None = None) -> Gathered:
    """Views of ``given.board`` from the cameras of ``given.rig``, which are those of ``known``.

    Raises ConfigError, InstrumentError, OperatorAbort.
    """
    from bench.calibrating.board_file import find_board_file, load_board
    from bench.calibrating.live import free_folder, gather

    board = load_board(find_board_file(given.board)).board
    folder = free_folder(given.out)
    with _opened(given, known, arm=False) as (parts, rig):
        kept = gather(_look(parts, rig), parts.operator, board, wanted, folder, _tell)
        parts.operator.finish()
        identity = {camera: str(who) for camera, who in parts.cameras.identity.items() if camera in wanted.cameras}
    _tell(f"{kept} views in {folder}")
    return Gathered(folder, identity)


def gather_world(given: argparse.Namespace, known: Part) -> Gathered:
    """Points of ``given.board`` that the arm of ``given.rig`` touched and its cameras, those of ``known``, saw: a table in the folder."""
    from bench.arm.tip import TipReader
    from bench.calibrating.board_file import find_board_file, load_board
    from bench.calibrating.live import free_folder
    from bench.calibrating.live_world import Asking, gather_points

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
            parts.operator.confirm_homing(PEG)
            arm.confirm_homed()
            asking = Asking(_look(parts, rig), parts.operator, tip, rig.rig.arm.tip_radius_mm, _tell)
            gather_points(asking, board, folder)
            parts.operator.finish()
        finally:
            arm.safe()
        identity = {"arm": arm.identity.serial_number}
    return Gathered(folder, identity)


@contextmanager
def _opened(given: argparse.Namespace, known: Part | None, *, arm: bool) -> Iterator[tuple[Parts, LoadedRig]]:
    from bench.calibration_age import refuse_other_cameras
    from bench.hookup import open_parts
    from bench.rig import find_rig, load_rig

    rig = load_rig(find_rig(given.rig))
    seed = rig.rig.seed if given.seed is None else given.seed
    with open_parts(rig, seed=seed, arm=arm, capture=given.capture) as parts:
        refuse_other_cameras(known.record if known else None, parts.cameras.identity)
        yield parts, rig


def _look(parts: Parts, rig: LoadedRig) -> Look:
    """Takes each camera's picture, once whatever the operator moved has come to rest."""
    from bench.alone.cameras import patient, pictures

    taken = patient(lambda: pictures(parts.cameras.capture()))

    def look() -> Mapping[str, Grey]:
        parts.clock.sleep(rig.rig.cameras.settle_s)
        return taken()

    return look


def _tell(text: str) -> None:
    print(text, flush=True)
