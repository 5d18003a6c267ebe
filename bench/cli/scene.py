"""`detect`, and `scene sheet|record|boards|sensitivity`: scenes without a run."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.cli.arguments import CODES, complain, refuse_existing
from bench.rig.loading import find_rig, load_rig

if TYPE_CHECKING:
    from bench.results.sensitivity import Measured


def detect(given: argparse.Namespace) -> int:
    from bench.run.recordings import detect_lines

    answered = False
    for line, text in detect_lines(given.recording, given.detector or ["thesis"]):
        print(json.dumps(line) if given.json else text, flush=True)
        answered = answered or "outcome" not in line
    if not answered:
        return complain("no frame had an answer: nothing was detected", CODES.fault)
    return CODES.met


def _members(given: argparse.Namespace) -> range:
    return range(given.first, given.first + given.seeds)


def sheet(given: argparse.Namespace) -> int:
    from bench.rig.scenes import write_sheet

    refuse_existing(given.out, replace=True)
    rig = load_rig(find_rig(given.rig))
    write_sheet(rig, given.situation, _members(given), given.out, given.seed)
    print(given.out)
    return CODES.met


def boards(given: argparse.Namespace) -> int:
    from bench.rig.loading import find_board_file
    from bench.rig.scenes import record_boards

    board, watching = find_board_file(given.board), given.camera or ["left", "right"]
    rig = load_rig(find_rig(given.rig))
    frames = record_boards(
        rig, board, watching, given.poses, given.out, given.seed, warmer_k=given.warmer_k
    )
    return _shown(frames, given.out)


def record(given: argparse.Namespace) -> int:
    from bench.rig.scenes import record as recorded

    rig = load_rig(find_rig(given.rig))
    frames = recorded(rig, given.situation, _members(given), given.out, given.seed)
    return _shown(frames, given.out)


def _shown(frames: Iterator[str], out: Path) -> int:
    written = 0
    for frame in frames:
        print(frame, flush=True)
        written += 1
    print(f"{written} frames in {out}")
    return CODES.met


def sensitivity(given: argparse.Namespace) -> int:
    from bench.report.sensitivity import check_curves, no_answers, write_figure, write_numbers
    from bench.results.answers import close_detectors
    from bench.results.sensitivity import Bench, chosen, measure
    from bench.script.detectors import make_detectors

    quantities = chosen(given.quantity)
    rig = load_rig(find_rig(given.rig))
    detectors = make_detectors(given.detector or ("fused", "thesis"))
    check_curves([detector.name for detector in detectors])
    bench = Bench(rig, detectors, _members(given), given.seed)
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
    made = (
        f"teatbench {__version__}; {asked}; cameras of `{rig.path.name}`; members {given.first} to"
        f" {given.first + given.seeds - 1} of `ideal` at each value, noise and cameras of seed"
        f" {given.seed}."
    )
    write_numbers(given.out, quantities, results, made)
    return CODES.met
