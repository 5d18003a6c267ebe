"""`plan`: before a run, how many poses a claim needs, and how small a difference between two
detectors they can show.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from bench.cli.arguments import CODES
from bench.config import ConfigError
from bench.scoring.sample_size import make_plan, plan_lines

RATES = (0.95, 0.99, 0.999)


def plan(given: argparse.Namespace) -> int:
    if given.script and given.trials is not None:
        raise ConfigError.plain(
            "--script and --trials both say how many poses there are; give one of them"
        )
    if given.shift_mm is not None and given.sd_mm is None:
        raise ConfigError.plain(
            "--shift-mm needs --sd-mm: how much the difference varies from pose to pose ('teatbench"
            " compare' shows it)"
        )
    if (given.limit_mm is None) != (given.u_mm is None):
        raise ConfigError.plain(
            "--limit-mm and --u-mm belong together: the limit of the error, and the uncertainty of"
            " the truth"
        )
    poses = given.trials
    if given.script:  # repeats of one pose count once
        from bench.script.model import find_script, load_script

        poses = len({trial.name for trial in load_script(find_script(given.script)).planned})
    found = make_plan(
        tuple(given.rate) or RATES,
        given.confidence,
        failures=given.failures,
        poses=poses,
        true_rate=given.true_rate,
        sd_mm=given.sd_mm,
        shift_mm=given.shift_mm,
        power=given.power,
        limit_mm=given.limit_mm,
        u_mm=given.u_mm,
    )
    if given.json:
        print(json.dumps(asdict(found), indent=1))
    else:
        for line in plan_lines(found):
            print(line)
    return CODES.met
