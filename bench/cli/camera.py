"""`camera list|show|focus|grab`: the cameras alone, of a rig or by their URLs."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, Commands, seconds

if TYPE_CHECKING:
    from bench.rig.cameras_alone import Alone

SOURCES = (
    "a rig by name or .toml file (default: emulated), or one to three cameras: opencv:0,"
    " opencv:http://…, genicam:NAME"
)


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    camera = commands.group(
        "camera",
        "the cameras alone: which there are, what they see, how sharp, and a frame set to keep",
    )
    listing = camera.add(
        "list", "cameras that this machine can see, or those of a rig", _list, opens_links=False
    )
    listing.add_argument(
        "rig", nargs="?", help="a shipped rig by name, or a .toml file (default: this machine)"
    )
    show = _add_sources(
        camera.add(
            "show",
            "who each camera is, what it sees, and what is wrong with it",
            _show,
            opens_links=False,
        )
    )
    show.add_argument("--json", action="store_true", help="one JSON object, units in its keys")
    focus = _add_sources(
        camera.add(
            "focus",
            "a live figure of sharpness, to set a lens by, until Ctrl-C",
            _focus,
            opens_links=False,
        )
    )
    focus.add_argument(
        "--seconds",
        type=seconds,
        default=math.inf,
        metavar="N",
        help="end after so long (default: Ctrl-C ends it)",
    )
    focus.add_argument(
        "--every",
        type=seconds,
        default=0.2,
        metavar="N",
        help="seconds between two figures (default: 0.2)",
    )
    grab = _add_sources(
        camera.add("grab", "save frame sets as a recording", _grab, opens_links=False)
    )
    grab.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="the recording; one that is there is added to",
    )
    grab.add_argument(
        "--count", type=_count, default=1, metavar="N", help="how many frame sets (default: 1)"
    )


def _add_sources(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.add_argument("sources", nargs="*", metavar="SOURCE", help=SOURCES)
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of frame sets above 0")
    return int(text)


def _list(given: argparse.Namespace) -> int:
    from bench.rig.cameras_alone import attached, of_rig

    rows = list(of_rig(given.rig) if given.rig else attached())
    for name, what in rows:
        print(f"{name}  {what}")
    if not rows:
        print("no camera answers on this machine's USB or network")
    return CODES.met


def _show(given: argparse.Namespace) -> int:
    from bench.rig.cameras_alone import figures, open_alone, patient, pictures

    with open_alone(given.sources) as alone:
        noticed: list[str] = []
        if alone.frame_set is None:
            seen: Mapping[str, object] = {
                name: figures(picture) for name, picture in alone.look().items()
            }
        else:
            frames = patient(alone.frame_set.capture)()
            seen = {name: figures(picture) for name, picture in pictures(frames).items()}
            noticed = [str(one) for one in alone.checks.notice(frames)]
        identity = dict(alone.identity())
    if given.json:
        print(json.dumps({"identity": identity, "cameras": seen, "faults": noticed}))
    else:
        _print_seen(identity, seen)
    for sentence in noticed:
        print(f"teatbench: {sentence}", file=sys.stderr)
    return CODES.fault if noticed else CODES.met


def _print_seen(identity: Mapping[str, str], seen: Mapping[str, object]) -> None:
    for name, told in seen.items():
        print(f"{name}: {identity.get(name, '')}")
        for key, value in told.items() if isinstance(told, dict) else ():
            print(f"  {key}: {'none seen' if value is None else value}")


def _focus(given: argparse.Namespace) -> int:
    from bench.rig.cameras_alone import open_alone

    best: dict[str, float] = {}
    with open_alone(given.sources) as alone:
        try:
            _follow(alone, best, given.seconds, given.every)
        except KeyboardInterrupt:
            print()
    if best:
        print(
            "focus_px = { "
            + ", ".join(f"{name} = {px:.2f}" for name, px in best.items())
            + " }  # of [cameras.checks] in the rig file"
        )
    return CODES.met


def _follow(alone: Alone, best: dict[str, float], seconds: float, every_s: float) -> None:
    """Print the blur of each camera's edges; smaller is sharper. ``best`` keeps the smallest."""
    from instruments.camera.quality import edge_blur_px

    end_s, live = alone.clock.now() + seconds, sys.stdout.isatty()
    while alone.clock.now() < end_s:
        told = []
        for name, picture in alone.look().items():
            blur_px = edge_blur_px(picture)
            if blur_px is not None:
                best[name] = min(best.get(name, math.inf), blur_px)
            told.append(
                f"{name} "
                + (
                    "no edge"
                    if blur_px is None
                    else f"{blur_px:5.2f} px (best {best[name]:.2f}) {_bar(best[name], blur_px)}"
                )
            )
        print("  ".join(told), end="\r" if live else "\n", flush=True)
        alone.clock.sleep(every_s)
    if live:
        print()


def _bar(best_px: float, blur_px: float) -> str:
    """Full where the picture is as sharp as it has ever been."""
    return "#" * round(10 * (best_px + 0.1) / (blur_px + 0.1))


def _grab(given: argparse.Namespace) -> int:
    from bench.config import ConfigError
    from bench.rig.cameras_alone import calibration_text, open_alone
    from bench.rig.frame_capture import FrameTaker
    from instruments.camera.recording import RecordingWriter

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
            alone.frame_set, alone.table, None, alone.clock.sleep, _tell, checks=alone.checks
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


def _tell(_: str, text: str) -> None:
    print(f"teatbench: {text}", file=sys.stderr)
