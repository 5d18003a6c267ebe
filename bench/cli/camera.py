"""`camera list|show|focus|grab`: the cameras alone, of a rig or by their URLs."""

from __future__ import annotations

import argparse
import json
import math
import sys

from bench.cli.arguments import CODES, complain
from bench.config import ConfigError
from bench.rig.alone import (
    Alone,
    calibration_text,
    cameras_of_rig,
    figures,
    open_alone,
    patient,
    pictures,
)
from bench.rig.alone import attached as attached_cameras
from bench.rig.frame_capture import FrameTaker
from instruments.camera.quality import edge_blur_px
from instruments.camera.recording import RecordingWriter


def attached(given: argparse.Namespace) -> int:
    rows = list(cameras_of_rig(given.rig) if given.rig else attached_cameras())
    for name, what in rows:
        print(f"{name}  {what}")
    if not rows:
        print("no camera answers on this machine's USB or network")
    return CODES.met


def show(given: argparse.Namespace) -> int:
    faults: list[str] = []
    with open_alone(given.sources) as alone:
        if alone.frame_set is None:
            taken = alone.look()
        else:
            frames = patient(alone.frame_set.capture)()
            taken = pictures(frames)
            faults = [str(one) for one in alone.checks.notice(frames)]
        seen = {name: figures(picture) for name, picture in taken.items()}
        identity = dict(alone.identity())
    if given.json:
        print(json.dumps({"identity": identity, "cameras": seen, "faults": faults}))
    else:
        for name, values in seen.items():
            print(f"{name}: {identity.get(name, '')}")
            for key, value in values.items():
                print(f"  {key}: {'none seen' if value is None else value}")
    for sentence in faults:
        complain(sentence, CODES.fault)
    return CODES.fault if faults else CODES.met


def focus(given: argparse.Namespace) -> int:
    best: dict[str, float] = {}
    with open_alone(given.sources) as alone:
        try:
            _follow(alone, best, given.seconds or math.inf, given.every)
        except KeyboardInterrupt:
            print()
    if best:
        values = ", ".join(f"{name} = {px:.2f}" for name, px in best.items())
        print(f"focus_px = {{ {values} }}  # of [cameras.checks] in the rig file")
    return CODES.met


def _follow(alone: Alone, best: dict[str, float], seconds: float, every_s: float) -> None:
    """Print the blur of each camera's edges; smaller is sharper. ``best`` keeps the smallest."""
    end_s, live = alone.clock.now() + seconds, sys.stdout.isatty()
    while alone.clock.now() < end_s:
        parts = []
        for name, picture in alone.look().items():
            blur_px = edge_blur_px(picture)
            if blur_px is None:
                parts.append(f"{name} no edge")
                continue
            least = best[name] = min(best.get(name, math.inf), blur_px)
            # full where the picture is as sharp as it has ever been
            bar = "#" * round(10 * (least + 0.1) / (blur_px + 0.1))
            parts.append(f"{name} {blur_px:5.2f} px (best {least:.2f}) {bar}")
        print("  ".join(parts), end="\r" if live else "\n", flush=True)
        alone.clock.sleep(every_s)
    if live:
        print()


def grab(given: argparse.Namespace) -> int:
    with open_alone(given.sources) as alone:
        if alone.frame_set is None:
            raise ConfigError.plain(
                "one camera alone makes no frame set: name left, right and perhaps thermal, or"
                " a rig"
            )
        writer = RecordingWriter(given.out)
        calibration = calibration_text(alone)
        if calibration is not None:
            writer.add_calibration(calibration)
        taker = FrameTaker(
            alone.frame_set,
            alone.table,
            None,
            alone.clock.sleep,
            lambda _, text: print(f"teatbench: {text}", file=sys.stderr),
            checks=alone.checks,
        )
        for number in range(given.count):
            name = f"{len(list((given.out / 'frames').iterdir())):04d}"
            writer.add(name, taker.take())
            print(f"{given.out / 'frames' / name}", flush=True)
            if number + 1 < given.count:
                alone.clock.sleep(alone.table.settle_s)
    if calibration is None:
        print(
            "there is no calibration: put calibration.toml into the folder before it is scored",
            file=sys.stderr,
        )
    return CODES.met
