"""`stage status|home|move|jog|recover`: the motion stage alone."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, Commands, address

if TYPE_CHECKING:
    from bench.rig.model import Stage as StageTable
    from instruments.stage.driver import Stage

_RESETS = "opening the port resets most controllers, so that the stage has to be homed again"


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    stage = commands.group("stage", "the motion stage alone, without a script")
    status = _add_stage(
        stage.add(
            "status",
            f"who answered, its state, position and travel; moves nothing, but {_RESETS}",
            _status,
        )
    )
    status.add_argument("--json", action="store_true", help="one JSON object, units in its keys")
    _add_stage(stage.add("home", "run to the switches and set the position", _home))
    move = _add_stage(
        stage.add("move", f"home, then move to a place in machine coordinates ({_RESETS})", _move)
    )
    move.add_argument(
        "x_mm", type=_number, metavar="X", help="mm, 0 at the switch and negative elsewhere"
    )
    move.add_argument("y_mm", type=_number, metavar="Y", help="mm")
    move.add_argument(
        "--z", type=_number, dest="z_mm", metavar="MM", help="height, on a stage declared with Z"
    )
    move.add_argument(
        "--a",
        type=_number,
        dest="a_deg",
        metavar="DEG",
        help="rotation, on a stage declared with A",
    )
    jog = _add_stage(
        stage.add(
            "jog",
            f"home, then go by so much, step by step; Ctrl-C ends a step at once ({_RESETS})",
            _jog,
        )
    )
    jog.add_argument(
        "steps",
        type=_step,
        nargs="+",
        metavar="STEP",
        help="X-5, or X-5Y2.5 for both at once: mm, degrees for A",
    )
    for parser in (move, jog):
        parser.add_argument(
            "--feed",
            type=_number,
            metavar="MM_MIN",
            help="mm/min (default: as fast as the slowest axis can)",
        )
    _add_stage(
        stage.add(
            "recover",
            "leave an alarm or a hold: restart the controller. It has to be homed after it",
            _recover,
        )
    )


def _add_stage(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--port",
        type=address("stage"),
        metavar="URL",
        help="where the controller is, as in a rig file's [stage] url",
    )
    which.add_argument("--rig", metavar="RIG", help="the stage of this rig")
    parser.add_argument(
        "--axes",
        choices=["XY", "XYZ", "XYA", "XYZA"],
        help="with --port: the axes that it has (default: XY)",
    )
    return parser


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return value


def _step(text: str) -> dict[str, float]:
    from bench.rig.stage_alone import step

    try:
        return step(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _at(given: argparse.Namespace) -> StageTable:
    from bench.config import ConfigError
    from bench.rig.model import Stage as StageTable
    from bench.rig.stage_alone import of_rig

    if given.rig is None:
        return StageTable(url=given.port, axes=given.axes or "XY")
    if given.axes:
        raise ConfigError.plain(
            "--axes goes with --port; a rig file says itself which axes its stage has"
        )
    return of_rig(given.rig)


def _status(given: argparse.Namespace) -> int:
    from bench.rig.stage_alone import described, open_stage

    with open_stage(_at(given), given.capture) as stage:
        told = described(stage)
    if given.json:
        print(json.dumps(told))
    else:
        for key, value in told.items():
            print(f"{key}: {value}")
    return CODES.met


def _home(given: argparse.Namespace) -> int:
    return _work(given, _homed)


def _move(given: argparse.Namespace) -> int:
    from bench.rig.stage_alone import check_target, shown

    def go(stage: Stage) -> None:
        check_target(stage, given.x_mm, given.y_mm, z_mm=given.z_mm, a_deg=given.a_deg)
        _homed(stage)
        stage.move_to(
            given.x_mm, given.y_mm, z_mm=given.z_mm, a_deg=given.a_deg, feed_mm_min=given.feed
        )
        print(f"moved: {shown(stage)}")

    return _work(given, go)


def _jog(given: argparse.Namespace) -> int:
    from bench.rig.stage_alone import jog, shown

    def go(stage: Stage) -> None:
        _homed(stage)
        for way in given.steps:
            jog(stage, way, given.feed)
            print(f"moved: {shown(stage)}", flush=True)

    return _work(given, go)


def _homed(stage: Stage) -> None:
    from bench.rig.stage_alone import shown

    stage.home()
    print(f"homed: {shown(stage)}", flush=True)


def _work(given: argparse.Namespace, go: Callable[[Stage], None]) -> int:
    """``go`` with the stage; what the driver refuses to send is wrong use."""
    from bench.rig.stage_alone import open_stage
    from instruments.errors import LimitError

    try:
        with open_stage(_at(given), given.capture) as stage:
            go(stage)
    except LimitError as error:
        print(f"teatbench: {error}", file=sys.stderr)
        return CODES.wrong_use
    return CODES.met


def _recover(given: argparse.Namespace) -> int:
    from bench.rig.stage_alone import open_stage

    with open_stage(_at(given), given.capture) as stage:
        stage.recover()
        print(
            f"restarted, in state {stage.status().name}; its position is unknown until 'teatbench"
            " stage home'"
        )
    return CODES.met
