"""`scene sensitivity`: errors of detectors over one quantity at a time, as figures and numbers."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.commands import CODES, Commands, add_detectors
from bench.commands.arguments import natural

if TYPE_CHECKING:
    from bench.sensitivity.values import Measured

OUT = Path("sensitivity")
DETECTORS = ("fused", "thesis")
SEEDS = 6


def add_to(scene: Commands) -> None:
    """The command with its arguments, in the group ``scene``."""
    what = "errors over one quantity at a time, a figure each, beside the physical limit (docs/sensitivity.md)"
    sensitivity = scene.add("sensitivity", what, _sensitivity, opens_links=False)
    add_detectors(sensitivity)
    sensitivity.add_argument("--quantity", action="append", default=[], metavar="NAME", help="several times (default: all eight)")
    sensitivity.add_argument("--rig", help="whose cameras: a shipped rig by name, or a .toml file (default: emulated)")
    sensitivity.add_argument("--seeds", type=_at_least_one, default=SEEDS, metavar="N", help=f"scenes at each value (default: {SEEDS})")
    sensitivity.add_argument("--first", type=natural, default=0, metavar="N", help="the first scene's seed (default: 0)")
    sensitivity.add_argument(
        "--seed", type=natural, default=1, metavar="N", help="of noise and of the cameras' fixed patterns (default: 1)"
    )
    sensitivity.add_argument("--out", type=Path, default=OUT, metavar="DIR", help="default: sensitivity; files there are replaced")


def _at_least_one(text: str) -> int:
    if not natural(text):
        raise argparse.ArgumentTypeError("must be at least 1: there is nothing to draw")
    return int(text)


def _sensitivity(given: argparse.Namespace) -> int:
    from bench.detecting.choice import make_detectors
    from bench.detecting.examine import close_detectors
    from bench.rig import find_rig, load_rig
    from bench.sensitivity.measuring import Bench, measure
    from bench.sensitivity.output import check_curves, no_answers, write_figure, write_numbers
    from bench.sensitivity.quantities import chosen

    quantities = chosen(given.quantity)
    rig = load_rig(find_rig(given.rig))
    detectors = make_detectors(given.detector or DETECTORS)
    check_curves([detector.name for detector in detectors])
    bench = Bench(rig, detectors, range(given.first, given.first + given.seeds), given.seed)
    results: dict[str, list[Measured]] = {}
    try:
        for quantity in quantities:
            points = results[quantity.name] = []
            for point in measure(bench, quantity):
                points.append(point)
                found = ", ".join(f"{name} {len(tally.distances_mm)}{no_answers(tally.failures)}" for name, tally in point.tallies.items())
                print(f"{quantity.name} {point.value:g}: found of {point.visible} visible: {found}", flush=True)
            print(write_figure(given.out, quantity, points), flush=True)
    finally:
        close_detectors(detectors)
    asked = ", ".join(f"{detector.name} (version {detector.version})" for detector in detectors)
    scenes = f"members {given.first} to {given.first + given.seeds - 1} of `ideal` at each value, noise and cameras of seed {given.seed}"
    write_numbers(given.out, quantities, results, f"teatbench {__version__}; {asked}; cameras of `{rig.path.name}`; {scenes}.")
    return CODES.met
