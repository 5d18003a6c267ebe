"""`scene sensitivity`: errors of detectors over one quantity at a time, as figures and numbers.

`detect`: what detectors find in recorded frames, without a score. `scene`: frames of the simulated
scene, without a run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.cli.arguments import CODES, Commands, add_detectors, natural

if TYPE_CHECKING:
    from bench.results.sensitivity import Measured

OUT = Path("sensitivity")
DETECTORS = ("fused", "thesis")
SEEDS = 6


def add_sensitivity(scene: Commands) -> None:
    """The command with its arguments, in the group ``scene``."""
    what = (
        "errors over one quantity at a time, a figure each, beside the physical limit"
        " (docs/sensitivity.md)"
    )
    sensitivity = scene.add("sensitivity", what, _sensitivity, opens_links=False)
    add_detectors(sensitivity)
    sensitivity.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="several times (default: all eight)",
    )
    sensitivity.add_argument(
        "--rig", help="whose cameras: a shipped rig by name, or a .toml file (default: emulated)"
    )
    sensitivity.add_argument(
        "--seeds",
        type=_at_least_one,
        default=SEEDS,
        metavar="N",
        help=f"scenes at each value (default: {SEEDS})",
    )
    sensitivity.add_argument(
        "--first", type=natural, default=0, metavar="N", help="the first scene's seed (default: 0)"
    )
    sensitivity.add_argument(
        "--seed",
        type=natural,
        default=1,
        metavar="N",
        help="of noise and of the cameras' fixed patterns (default: 1)",
    )
    sensitivity.add_argument(
        "--out",
        type=Path,
        default=OUT,
        metavar="DIR",
        help="default: sensitivity; files there are replaced",
    )


def _at_least_one(text: str) -> int:
    if not natural(text):
        raise argparse.ArgumentTypeError("must be at least 1: there is nothing to draw")
    return int(text)


def _sensitivity(given: argparse.Namespace) -> int:
    from bench.report.sensitivity import check_curves, no_answers, write_figure, write_numbers
    from bench.results.answers import close_detectors
    from bench.results.sensitivity import Bench, chosen, measure
    from bench.rig.loading import find_rig, load_rig
    from bench.script.detectors import make_detectors

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
                found = ", ".join(
                    f"{name} {len(tally.distances_mm)}{no_answers(tally.failures)}"
                    for name, tally in point.tallies.items()
                )
                print(
                    f"{quantity.name} {point.value:g}: found of {point.visible} visible: {found}",
                    flush=True,
                )
            print(write_figure(given.out, quantity, points), flush=True)
    finally:
        close_detectors(detectors)
    asked = ", ".join(f"{detector.name} (version {detector.version})" for detector in detectors)
    scenes = (
        f"members {given.first} to {given.first + given.seeds - 1} of `ideal` at each value, noise"
        f" and cameras of seed {given.seed}"
    )
    write_numbers(
        given.out,
        quantities,
        results,
        f"teatbench {__version__}; {asked}; cameras of `{rig.path.name}`; {scenes}.",
    )
    return CODES.met


SHEET, RECORDING, BOARDS = (
    Path("scene.png"),
    Path("recordings") / "situations",
    Path("recordings") / "boards",
)
CAMERAS = ("left", "right", "thermal")


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    detect = commands.add(
        "detect",
        "detect only: what each detector finds in recorded frames",
        _detect,
        opens_links=False,
    )
    detect.add_argument("recording", type=Path, help="a recording's folder")
    detect.add_argument("--json", action="store_true", help="one JSON line a frame")
    add_detectors(detect)
    scene = commands.group(
        "scene",
        "the simulated scene: situations from families, drawn without a run (docs/scene.md)",
    )
    sheet = scene.add("sheet", "a contact sheet of situations, one PNG", _sheet, opens_links=False)
    _add_scenes(sheet, seeds=1)
    sheet.add_argument("--out", type=Path, default=SHEET, metavar="FILE", help="default: scene.png")
    record = scene.add(
        "record",
        "a recording of situations with exact truth, for `teatbench score`",
        _record,
        opens_links=False,
    )
    _add_scenes(record, seeds=20)
    record.add_argument(
        "--out",
        type=Path,
        default=RECORDING,
        metavar="DIR",
        help="default: recordings/situations; is added to",
    )
    boards = scene.add(
        "boards",
        "pictures of a calibration board all over the view, for `teatbench calibrate`",
        _boards,
        opens_links=False,
    )
    boards.add_argument("board", help="a shipped board by name, or a .toml file")
    boards.add_argument(
        "--rig", help="whose cameras: a shipped rig by name, or a .toml file (default: emulated)"
    )
    boards.add_argument(
        "--camera",
        action="append",
        choices=CAMERAS,
        metavar="NAME",
        help="sees the whole board; several times (default: left and right)",
    )
    boards.add_argument("--poses", type=natural, default=24, metavar="N", help="default: 24")
    boards.add_argument(
        "--warmer-k",
        type=float,
        default=0.0,
        metavar="K",
        help="what is dark on the board above the room (default: 0)",
    )
    boards.add_argument(
        "--seed",
        type=natural,
        default=1,
        metavar="N",
        help="of poses, noise and the cameras' fixed patterns (default: 1)",
    )
    boards.add_argument(
        "--out",
        type=Path,
        default=BOARDS,
        metavar="DIR",
        help="default: recordings/boards; is added to",
    )
    add_sensitivity(scene)


def _add_scenes(parser: argparse.ArgumentParser, seeds: int) -> None:
    parser.add_argument(
        "--rig", help="whose cameras: a shipped rig by name, or a .toml file (default: emulated)"
    )
    parser.add_argument(
        "--situation",
        action="append",
        default=[],
        metavar="NAME",
        help="may be given several times (default: all eleven)",
    )
    parser.add_argument(
        "--seeds",
        type=natural,
        metavar="N",
        default=seeds,
        help=f"members of each family (default: {seeds})",
    )
    parser.add_argument(
        "--first", type=natural, metavar="N", default=0, help="the first member's seed (default: 0)"
    )
    parser.add_argument(
        "--seed",
        type=natural,
        metavar="N",
        default=1,
        help="of noise and of the cameras' fixed patterns (default: 1)",
    )


def _members(given: argparse.Namespace) -> range:
    from bench.config import ConfigError

    if given.seeds < 1:
        raise ConfigError.plain("--seeds must be at least 1: there is nothing to draw")
    return range(given.first, given.first + given.seeds)


def _sheet(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.rig.loading import find_rig, load_rig
    from bench.rig.scenes import write_sheet

    refuse_existing(given.out, replace=True)
    write_sheet(
        load_rig(find_rig(given.rig)), given.situation, _members(given), given.out, given.seed
    )
    print(given.out)
    return CODES.met


def _boards(given: argparse.Namespace) -> int:
    from bench.rig.board import find_board_file
    from bench.rig.loading import find_rig, load_rig
    from bench.rig.scenes import record_boards

    board, watching = find_board_file(given.board), given.camera or ["left", "right"]
    rig = load_rig(find_rig(given.rig))
    frames = record_boards(
        rig, board, watching, given.poses, given.out, given.seed, warmer_k=given.warmer_k
    )
    return _shown(frames, given.out)


def _shown(frames: Iterator[str], out: Path) -> int:
    written = 0
    for frame in frames:
        print(frame, flush=True)
        written += 1
    print(f"{written} frames in {out}")
    return CODES.met


def _record(given: argparse.Namespace) -> int:
    from bench.rig.loading import find_rig, load_rig
    from bench.rig.scenes import record

    rig = load_rig(find_rig(given.rig))
    return _shown(record(rig, given.situation, _members(given), given.out, given.seed), given.out)


def _detect(given: argparse.Namespace) -> int:
    from bench.run.recordings import detect_lines

    answered = False
    for line, text in detect_lines(given.recording, given.detector or ["thesis"]):
        print(json.dumps(line) if given.json else text, flush=True)
        answered = answered or "outcome" not in line
    if not answered:
        print("teatbench: no frame had an answer: nothing was detected", file=sys.stderr)
    return CODES.met if answered else CODES.fault
