"""`plan`: before a run, how many poses a claim needs, and how small a difference between two detectors they can show."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands
from bench.commands.arguments import number

if TYPE_CHECKING:
    from bench.planning.claims import Plan

RATES = (0.95, 0.99, 0.999)


def add_to(commands: Commands) -> None:
    """The command with its arguments."""
    plan = commands.add("plan", "how many poses a claim needs, and what so many poses can show", _plan, opens_links=False)
    plan.add_argument("--rate", type=_share, action="append", default=[], metavar="R", help="to be shown (default: 0.95, 0.99 and 0.999)")
    plan.add_argument("--confidence", type=_share, default=0.95, metavar="P", help="of the claim (default: 0.95)")
    plan.add_argument("--failures", type=_whole, default=3, metavar="N", help="plan for up to so many failures (default: 3)")
    plan.add_argument("--trials", type=_whole, metavar="N", help="poses there are: what do they show?")
    plan.add_argument("--script", metavar="SCRIPT", help="take the poses of a script, shipped by name or a .toml file")
    plan.add_argument("--true-rate", type=_share, metavar="R", help="what the detector is hoped to do: its chance to show the rate")
    plan.add_argument("--sd-mm", type=_length, metavar="SD", help="of the difference of two detectors' errors from pose to pose")
    plan.add_argument("--shift-mm", type=_length, metavar="MM", help="difference of two detectors to be shown: how many poses?")
    plan.add_argument("--power", type=_share, default=0.8, metavar="P", help="chance to show a difference that is there (default: 0.8)")
    plan.add_argument("--limit-mm", type=_length, metavar="T", help="of the error: how near to it may the largest lie? With --u-mm")
    plan.add_argument("--u-mm", type=_length, metavar="U", help="standard uncertainty of the truth along an axis; a report says it")
    plan.add_argument("--json", action="store_true", help="print JSON")


def _share(text: str) -> float:
    value = number(text)
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} must lie between 0 and 1, for example 0.95: no number of poses shows 100 %")
    return value


def _length(text: str) -> float:
    value = number(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a length in mm above 0")
    return value


def _whole(text: str) -> int:
    if not text.isdecimal() or int(text) > 1_000_000:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to a million")
    return int(text)


def _plan(given: argparse.Namespace) -> int:
    from dataclasses import asdict

    from bench.config import ConfigError
    from bench.planning.claims import make_plan, told

    if given.script and given.trials is not None:
        raise ConfigError.plain("--script and --trials both say how many poses there are; give one of them")
    if given.shift_mm is not None and given.sd_mm is None:
        raise ConfigError.plain("--shift-mm needs --sd-mm: how much the difference varies from pose to pose ('teatbench compare' shows it)")
    if (given.limit_mm is None) != (given.u_mm is None):
        raise ConfigError.plain("--limit-mm and --u-mm belong together: the limit of the error, and the uncertainty of the truth")
    plan: Plan = make_plan(
        tuple(given.rate) or RATES,
        given.confidence,
        failures=given.failures,
        poses=_poses(given.script) if given.script else given.trials,
        true_rate=given.true_rate,
        sd_mm=given.sd_mm,
        shift_mm=given.shift_mm,
        power=given.power,
        limit_mm=given.limit_mm,
        u_mm=given.u_mm,
    )
    if given.json:
        print(json.dumps(asdict(plan), indent=1))
    else:
        for line in told(plan):
            print(line)
    return CODES.met


def _poses(script: str) -> int:
    """Independent poses of a script: repeats of one pose count once."""
    from bench.script import find_script, load_script

    return len({trial.name for trial in load_script(find_script(script)).planned})
