"""`stage status|home|move|jog|recover` and `camera list|show|focus|grab`: the stage or the cameras
alone, of a rig or by their URLs.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import webbrowser
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import bench
from bench.cli.arguments import CODES, complain, print_json, print_values
from bench.cli.commands import CAMERAS
from bench.cli.verdict import on_a_desktop
from bench.config import ConfigError
from instruments import Clock, FrameError, LimitError, Stage

AXES = {"X": "x_mm", "Y": "y_mm", "Z": "z_mm", "A": "a_deg"}
_STEP = re.compile(r"([XYZA])([-+]?(?:\d+\.?\d*|\.\d+))", re.IGNORECASE)


def step(text: str) -> dict[str, float]:
    """A way as ``X-5Y2.5``: arguments of a stage's ``jog``. Raises ValueError."""
    found = _STEP.findall(text)
    axes = [axis.upper() for axis, _ in found]
    whole = "".join(axis + way for axis, way in found) == text
    if not found or not whole or len(set(axes)) != len(axes):
        raise ValueError(
            f"{text!r} is no way to go; write X-5, or X-5Y2.5 for both at once (mm, degrees for A)"
        )
    return {AXES[axis]: float(way) for axis, (_, way) in zip(axes, found, strict=True)}


@contextmanager
def _opened(given: argparse.Namespace) -> Iterator[Stage]:
    """The stage; what its driver refuses to send is wrong use."""
    if given.rig and (given.axes or given.dialect):
        raise ConfigError.plain(
            "--axes and --dialect go with --port; a rig file says itself what its stage is"
        )
    named = {key: value for key in ("rig", "axes", "dialect") if (value := getattr(given, key))}
    try:
        with bench.open_stage(given.port, **named, capture=given.capture) as stage:
            yield stage
    except LimitError as error:
        raise ConfigError.plain(str(error)) from error


def _at(stage: Stage) -> str:
    at = bench.describe_stage(stage)
    return ", ".join(f"{axis} {at[key]:.3f} {key[2:]}" for axis, key in AXES.items() if key in at)


def _home(stage: Stage, _: argparse.Namespace) -> Iterator[str]:
    stage.home()
    yield f"homed: {_at(stage)}"


def _move(stage: Stage, given: argparse.Namespace) -> Iterator[str]:
    target, more = (given.x_mm, given.y_mm), {"z_mm": given.z_mm, "a_deg": given.a_deg}
    bench.check_target(stage, *target, **more)
    yield from _home(stage, given)
    stage.move_to(*target, **more, feed_mm_min=given.feed)
    yield f"moved: {_at(stage)}"


def _jog(stage: Stage, given: argparse.Namespace) -> Iterator[str]:
    yield from _home(stage, given)
    for way in given.steps:
        stage.jog(**way, feed_mm_min=given.feed)
        try:
            stage.finish_move()
        except KeyboardInterrupt:
            stage.cancel_jog()
            raise
        yield f"moved: {_at(stage)}"


def _recover(stage: Stage, _: argparse.Namespace) -> Iterator[str]:
    stage.recover()
    unknown = "its position is unknown until 'teatbench stage home'"
    yield f"restarted, in state {stage.status().name}; {unknown}"


STAGE = {"home": _home, "move": _move, "jog": _jog, "recover": _recover}  # verb -> what it says


def of_stage(given: argparse.Namespace) -> None:
    """A verb of the stage: what it says, as it comes."""
    with _opened(given) as stage:
        for line in STAGE[given.called.split()[1]](stage, given):
            print(line, flush=True)


def status(given: argparse.Namespace) -> None:
    with _opened(given) as stage:
        print_values(bench.describe_stage(stage), as_json=given.json)


def attached(given: argparse.Namespace) -> None:
    rows = list(bench.list_cameras(given.rig))
    for name, what in rows:
        print(f"{name}  {what}")
    if not rows:
        print("no camera answers on this machine's USB or network")


def show(given: argparse.Namespace) -> int:
    with bench.open_cameras(given.sources) as alone:
        seen = alone.describe()
    if given.json:
        print_json(seen)
    else:
        for name, values in seen["cameras"].items():
            print(f"{name}: {seen['identity'].get(name, '')}")
            for key, value in values.items():
                print(f"  {key}: {'none seen' if value is None else value}")
    for sentence in seen["faults"]:
        complain(sentence, CODES.fault)
    return CODES.fault if seen["faults"] else CODES.met


def _next_look(
    alone: bench.OpenCameras, clock: Clock, end_s: float, every_s: float
) -> Mapping[str, Any]:
    """Pictures of all cameras, once all come whole. Raises FrameError after ``end_s``."""
    while True:
        try:
            return alone.look()
        except FrameError as error:
            if clock.now() >= end_s:
                raise
            print(f"teatbench: {error}", file=sys.stderr, flush=True)
            clock.sleep(every_s)


def focus(given: argparse.Namespace) -> None:
    """Print the blur of each camera's edges; smaller is sharper. Ends with the smallest."""
    best: dict[str, float] = {}
    seconds = given.seconds or math.inf
    live = sys.stdout.isatty()
    with bench.open_cameras(given.sources) as alone, ExitStack() as stack:
        page, clock = None, alone.clock
        if given.page:
            first = _next_look(alone, clock, clock.now() + seconds, given.every)
            page = stack.enter_context(bench.live_page(first, given.every))
            clock = page.clock  # a person looks in real time, on an emulated rig too
            print(f"page {page.url}", flush=True)
            if on_a_desktop():
                webbrowser.open(page.url)
        end_s = clock.now() + seconds
        try:
            while clock.now() < end_s:
                parts, seen = [], _next_look(alone, clock, end_s, given.every)
                for name, picture in seen.items():
                    blur_px = bench.edge_blur_px(picture)
                    if blur_px is None:
                        parts.append(f"{name} no edge")
                        continue
                    least = best[name] = min(best.get(name, math.inf), blur_px)
                    # full where the picture is as sharp as it has ever been
                    bar = "#" * round(10 * (least + 0.1) / (blur_px + 0.1))
                    parts.append(f"{name} {blur_px:5.2f} px (best {least:.2f}) {bar}")
                if page:
                    page.show(seen, parts)
                print("  ".join(parts), end="\r" if live else "\n", flush=True)
                clock.sleep(given.every)
        except KeyboardInterrupt:
            live = True
        if live:
            print()
    if best:
        print(focus_line(best))


def focus_line(best: Mapping[str, float]) -> str:
    """The least blur (px) of each camera, as a rig file takes it; never 0, which has no limit."""
    places = {name if name in CAMERAS else CAMERAS[0]: px for name, px in best.items()}
    values = ", ".join(f"{place} = {max(0.01, px):.2f}" for place, px in places.items())
    where = "of [cameras.checks] in the rig file"
    if set(best) - set(CAMERAS):
        where += f"; write {' or '.join(CAMERAS[1:])} for {CAMERAS[0]} where it is that camera"
    return f"focus_px = {{ {values} }}  # {where}"


def grab(given: argparse.Namespace) -> None:
    with bench.open_cameras(given.sources) as alone:
        warn = {"warn": lambda text: print(f"teatbench: {text}", file=sys.stderr)}
        for name in bench.record_frames(alone, given.out, given.count, **warn):
            print(f"{given.out / 'frames' / name}", flush=True)
        uncalibrated = alone.rig.made_calibration is None
    if uncalibrated:
        why = "there is no calibration: put calibration.toml into the folder before it is scored"
        print(why, file=sys.stderr)
