"""`detect`: what detectors find in recorded frames, without a score."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from bench.commands import CODES, Commands, add_detectors


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    detect = commands.add("detect", "detect only: what each detector finds in recorded frames", _detect, opens_links=False)
    detect.add_argument("recording", type=Path, help="a recording's folder")
    detect.add_argument("--json", action="store_true", help="one JSON line a frame")
    add_detectors(detect)


def _detect(given: argparse.Namespace) -> int:
    from bench.detections import detect_lines

    for line, text in detect_lines(given.recording, given.detector or ["thesis"]):
        print(json.dumps(line) if given.json else text, flush=True)
    return CODES.met
