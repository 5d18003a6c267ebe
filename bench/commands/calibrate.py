"""`calibrate stage`: where the stage's axes lie in the world. Each calibration writes a dated file with its quality figures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands
from bench.commands.arguments import whole
from bench.commands.calibrating import add_steps
from bench.commands.calibration_check import add_check
from bench.commands.calibration_files import add_files

if TYPE_CHECKING:
    from bench.truth.registration import Registration


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    group = commands.group("calibrate", "make a calibration file with its quality figures")
    add_steps(group)
    add_check(group)
    add_files(group)
    stage = group.add("stage", "register the stage in the world: one teat end touched at several stage positions (docs/truth.md)", _stage)
    stage.add_argument("--rig", metavar="RIG", help="a shipped rig by name, or a .toml file (default: emulated)")
    stage.add_argument("--out", type=Path, required=True, metavar="FILE", help="where to write it; a script's [truth] names it")
    stage.add_argument("--replace", action="store_true", help="write over a file that is there")
    stage.add_argument("--layout", default="table-5-1", metavar="NAME", help="how the phantom's teats stand (default: table-5-1)")
    stage.add_argument("--teat", type=whole(1, 20), default=1, metavar="N", help="the teat to touch (default: 1)")
    stage.add_argument("--readings", type=whole(1, 20), metavar="N", help="touches at each position (default: as the rig says)")
    stage.add_argument("--seed", type=int, metavar="N", help="of the emulators' noise (default: the rig's)")
    stage.add_argument(
        "--at",
        type=_place,
        action="append",
        default=[],
        metavar="X,Y",
        help="touch there, mm from the reference place (--at=-60,80); three or more (default: the corners and the middle of 200 x 200 mm)",
    )


def _stage(given: argparse.Namespace) -> int:
    from bench.arm.session import refuse_existing
    from bench.rig import find_rig, load_rig
    from bench.truth.registration_file import write_registration
    from bench.truth.stage_job import Wanted, calibrate_stage
    from instruments.clock import wall_time
    from instruments.operators.operator import OperatorAbort, OperatorSkip

    refuse_existing(given.out, replace=given.replace)
    rig = load_rig(find_rig(given.rig))
    wanted = Wanted(given.layout, given.teat, tuple(given.at), given.readings)
    seed = rig.rig.seed if given.seed is None else given.seed
    made = wall_time().replace(microsecond=0)
    try:
        found = calibrate_stage(rig, wanted, made, lambda text: print(text, flush=True), seed=seed, capture=given.capture)
    except (OperatorAbort, OperatorSkip) as stop:
        print(f"teatbench: {stop}; nothing was written", file=sys.stderr)
        return CODES.fault
    write_registration(given.out, found)
    _show(found)
    print(f'Written: {given.out}. Name it in a script, beside which it lies: [truth] mode = "carry", registration = "{given.out.name}"')
    for fault in found.faults:
        print(f"teatbench: {fault}", file=sys.stderr)
    return CODES.not_met if found.faults else CODES.met


def _show(found: Registration) -> None:
    print(f"{len(found.stations)} positions, touches good for {found.u_mm:.2f} mm along an axis")
    for fit in found.comparison.fits:
        held_out = found.comparison.held_out_mm[fit.model]
        left_out = "too few positions to hold one out" if held_out is None else f"held out {held_out:.2f} mm"
        print(f"{fit.model}: residual {fit.fre_mm:.2f} mm rms, {left_out}")
    print(f"expected residual of the rigid fit: {found.expected_fre_mm:.2f} mm")
    for one in found.diagnostics:
        print(f"{one.name}: {one.value:+.5f} (u {one.u:.5f}){', SIGNIFICANT' if one.significant else ''}")


def _place(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a place; write two numbers as 120,-80") from error
    if not all(abs(v) <= 2000 for v in (x, y)):
        raise argparse.ArgumentTypeError(f"{text!r} is not within 2 m of the reference place")
    return x, y
