"""`stage status|home|move|jog|recover`: the motion stage alone."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

from bench.cli.arguments import CODES, complain
from bench.config import ConfigError
from bench.rig import alone
from bench.rig.alone import open_stage, shown
from bench.rig.model import Stage as StageTable
from instruments.errors import LimitError
from instruments.stage.driver import Stage


def _at(given: argparse.Namespace) -> StageTable:
    if given.rig is None:
        return StageTable(url=given.port, axes=given.axes or "XY")
    if given.axes:
        raise ConfigError.plain(
            "--axes goes with --port; a rig file says itself which axes its stage has"
        )
    return alone.stage_of_rig(given.rig)


def status(given: argparse.Namespace) -> int:
    with open_stage(_at(given), given.capture) as stage:
        figures = alone.described(stage)
    if given.json:
        print(json.dumps(figures))
    else:
        for key, value in figures.items():
            print(f"{key}: {value}")
    return CODES.met


def home(given: argparse.Namespace) -> int:
    return _work(given, _home)


def move(given: argparse.Namespace) -> int:
    def go(stage: Stage) -> None:
        target = given.x_mm, given.y_mm
        alone.check_target(stage, *target, z_mm=given.z_mm, a_deg=given.a_deg)
        _home(stage)
        stage.move_to(*target, z_mm=given.z_mm, a_deg=given.a_deg, feed_mm_min=given.feed)
        print(f"moved: {shown(stage)}")

    return _work(given, go)


def jog(given: argparse.Namespace) -> int:
    def go(stage: Stage) -> None:
        _home(stage)
        for way in given.steps:
            alone.jog(stage, way, given.feed)
            print(f"moved: {shown(stage)}", flush=True)

    return _work(given, go)


def _home(stage: Stage) -> None:
    stage.home()
    print(f"homed: {shown(stage)}", flush=True)


def _work(given: argparse.Namespace, go: Callable[[Stage], None]) -> int:
    """``go`` with the stage; what the driver refuses to send is wrong use."""
    try:
        with open_stage(_at(given), given.capture) as stage:
            go(stage)
    except LimitError as error:
        return complain(str(error), CODES.wrong_use)
    return CODES.met


def recover(given: argparse.Namespace) -> int:
    with open_stage(_at(given), given.capture) as stage:
        stage.recover()
        print(
            f"restarted, in state {stage.status().name}; its position is unknown until 'teatbench"
            " stage home'"
        )
    return CODES.met
