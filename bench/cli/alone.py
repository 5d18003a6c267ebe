"""One instrument alone, of a rig or at a port: `VERBS` has how it is opened, and what is done."""

from __future__ import annotations

import argparse
import math
import re
import sys
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import asdict
from functools import partial
from itertools import takewhile
from typing import Any

import bench
from bench.cli.arguments import CODES, complain, mm, print_json, print_values, say
from bench.cli.commands import CAMERAS
from bench.cli.verdict import on_a_desktop
from bench.config import ConfigError
from instruments import Arm, Clock, FrameError, InstrumentError, LimitError, RealClock, Stage

AXES = {"X": "x_mm", "Y": "y_mm", "Z": "z_mm", "A": "a_deg"}
_STEP = re.compile(r"([XYZA])([-+]?(?:\d+\.?\d*|\.\d+))", re.IGNORECASE)


def arm_at(given: argparse.Namespace) -> dict[str, Any]:
    return {"baud": given.baud, "answer_s": given.answer_s, "capture": given.capture}


def _arm(given: argparse.Namespace, **how: Any) -> AbstractContextManager[Arm]:
    return bench.open_arm(given.port, **arm_at(given), **how)


def _bath(given: argparse.Namespace, **how: Any) -> AbstractContextManager[Any]:
    how["allow_inferred"] = getattr(given, "allow_inferred", False)
    return bench.open_bath(given.port, given.profile or "", capture=given.capture, **how)


def _cameras(given: argparse.Namespace) -> AbstractContextManager[bench.OpenCameras]:
    return bench.open_cameras(given.sources)


@contextmanager
def _stage(given: argparse.Namespace) -> Iterator[Stage]:
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


def verb(given: argparse.Namespace) -> int | None:
    """A command of `VERBS`; gives back its exit code."""
    opened, work = VERBS[given.called]
    with opened(given) as instrument:
        return work(instrument, given)


def _home_arm(arm: Arm, _: argparse.Namespace) -> None:
    tip = mm(arm.read().tip_mm)
    say(f"Homed. The tip stands at {tip} in the arm's frame. Leave the arm switched on.")


def _watch_arm(arm: Arm, given: argparse.Namespace) -> int:
    live = sys.stdout.isatty()
    with closing(RealClock()) as clock, closing(bench.watch_arm(arm)) as views:
        end_s = clock.now() + (given.seconds or math.inf)
        try:
            for seen in takewhile(lambda _: clock.now() < end_s, views):
                print(_arm_line(seen), end="\r" if live else "\n", flush=True)
        except LimitError as error:
            return complain(str(error), CODES.wrong_use)
        except KeyboardInterrupt:  # the way to end it
            pass
    if live:
        print(flush=True)
    return CODES.met


def _arm_line(seen: bench.ArmView) -> str:
    each = (f"{one} {'DOWN' if down else 'up'}" for one, down in seen.pedals.items())
    (x, y, z), pedals = seen.tip_mm, ", ".join(each) or "none are known"
    return (
        f"tip {x:8.2f} {y:8.2f} {z:8.2f} mm   pedals: {pedals:<22}"
        f" {seen.packets_per_s:6.1f} packets/s   damaged: {seen.damaged}"
    )


def _read_bath(bath: Any, given: argparse.Namespace) -> None:
    values = bench.describe_bath(bath)
    if not given.json:
        values = {key: "not reported" if one is None else one for key, one in values.items()}
    print_values(values, as_json=given.json)


def _learn_bath(bath: Any, given: argparse.Namespace) -> int:
    """Asks for each row by itself and writes nothing: for a profile that is being made."""
    found = bench.try_bath(bath)
    tried, asked = found.rows, [one for one in found.rows if one.readable]
    if given.json:
        print_json({"rows": [asdict(one) for one in tried]})
    else:
        width = max(len(one.row) for one in tried)
        for one in tried:
            mark = "+" if one.sensible else "?" if one.answered else "-"
            print(f"{mark} {one.row:{width}}  {one.asked}: {one.said}")
        sensible = sum(one.sensible for one in tried)
        print(f"{sensible} of {len(asked)} rows that can be read made sense")
    if found.doubt:
        why = f"no controller answers: {found.doubt}"
    elif not any(one.answered for one in tried):
        first = next((one.said for one in asked), "it can't be read")
        why = f"no row made sense: {first}"
    else:
        return CODES.met
    return complain(f"bath at {given.port}: {why}", CODES.fault)


def _set_bath(bath: Any, given: argparse.Namespace) -> int:
    try:
        if given.display is not None:
            bath.confirm_unit(given.display)
        bath.set_point(given.set_point)
    except LimitError as error:
        return complain(str(error), CODES.wrong_use)
    works = bath.get("run") == bath.profile.row("run").values["started"]
    state = "the bath is in standby"
    if works:
        state = "it is heating or cooling to it now. IT STAYS ON: 'teatbench bath standby' ends it"
    print(f"set point {bath.get('set_point'):.2f} degC; {state}")
    return CODES.met


def _watch_bath(bath: Any, given: argparse.Namespace) -> None:
    from bench.cli.bath_plot import PERIOD_S, show_views
    from bench.cli.terminal import Terminal

    with closing(RealClock()) as clock:
        end_s = clock.now() + (given.seconds or math.inf)
        views = bench.watch_bath(bath, PERIOD_S, clock=clock)
        try:
            show_views(takewhile(lambda _: clock.now() < end_s, views), Terminal())
        except KeyboardInterrupt:
            say("left as it is; 'teatbench bath standby' switches the heater off")


def _stand_by(bath: Any, given: argparse.Namespace) -> int:
    bath.safe()
    try:
        print(f"in standby at {bath.read().temp_c:.2f} degC")
    # what matters is done; an alarm or a broken sensor doesn't undo it
    except InstrumentError as error:
        if bath.doubt:
            what = f"bath at {given.port}: standby was sent, but no controller answers"
            return complain(f"{what}: {bath.doubt}. Look at the bath.", CODES.fault)
        print(f"in standby; no temperature: {error}")
    return CODES.met


def acknowledge(given: argparse.Namespace) -> None:
    if (found := bench.latched(bench.load_rig(given.rig))) is None:
        say("nothing is latched: no interlock of this rig waits to be acknowledged")
        return
    say(f"latched: {found}")
    bench.acknowledge(given.rig, capture=given.capture)
    print("acknowledged; the rig may run again")


def attached(given: argparse.Namespace) -> None:
    rows = list(bench.list_cameras(given.rig))
    for name, what in rows:
        print(f"{name}  {what}")
    if not rows:
        print("no camera answers on this machine's USB or network")


def _show_cameras(cameras: bench.OpenCameras, given: argparse.Namespace) -> int:
    seen = cameras.describe()
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


def next_look(
    cameras: bench.OpenCameras, clock: Clock, end_s: float, every_s: float
) -> Mapping[str, Any]:
    """Pictures of all cameras, once all come whole. Raises FrameError after ``end_s``."""
    while True:
        try:
            return cameras.look()
        except FrameError as error:
            if clock.now() >= end_s:
                raise
            print(f"teatbench: {error}", file=sys.stderr, flush=True)
            clock.sleep(every_s)


def _focus_cameras(cameras: bench.OpenCameras, given: argparse.Namespace) -> None:
    """Print the blur of each camera's edges; smaller is sharper. Ends with the smallest."""
    best: dict[str, float] = {}
    seconds = given.seconds or math.inf
    live = sys.stdout.isatty()
    with ExitStack() as stack:
        page, clock = None, cameras.clock
        if given.page:
            first = next_look(cameras, clock, clock.now() + seconds, given.every)
            page = stack.enter_context(bench.live_page(first, given.every))
            clock = page.clock  # a person looks in real time, on an emulated rig too
            print(f"page {page.url}", flush=True)
            if on_a_desktop():
                webbrowser.open(page.url)
        end_s = clock.now() + seconds
        try:
            while clock.now() < end_s:
                parts, seen = [], next_look(cameras, clock, end_s, given.every)
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


def _grab_frames(cameras: bench.OpenCameras, given: argparse.Namespace) -> None:
    warn = {"warn": lambda text: print(f"teatbench: {text}", file=sys.stderr)}
    for name in bench.record_frames(cameras, given.out, given.count, **warn):
        print(f"{given.out / 'frames' / name}", flush=True)
    if cameras.rig.made_calibration is None:
        why = "there is no calibration: put calibration.toml into the folder before it is scored"
        print(why, file=sys.stderr)


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


def _show_place(said: str, stage: Stage) -> None:
    at = bench.describe_stage(stage)
    places = (f"{axis} {at[key]:.3f} {key[2:]}" for axis, key in AXES.items() if key in at)
    print(f"{said}: {', '.join(places)}", flush=True)


def _show_stage(stage: Stage, given: argparse.Namespace) -> None:
    print_values(bench.describe_stage(stage), as_json=given.json)


def _home_stage(stage: Stage, _: argparse.Namespace) -> None:
    stage.home()
    _show_place("homed", stage)


def _move_stage(stage: Stage, given: argparse.Namespace) -> None:
    target, more = (given.x_mm, given.y_mm), {"z_mm": given.z_mm, "a_deg": given.a_deg}
    bench.check_target(stage, *target, **more)
    _home_stage(stage, given)
    stage.move_to(*target, **more, feed_mm_min=given.feed)
    _show_place("moved", stage)


def _jog_stage(stage: Stage, given: argparse.Namespace) -> None:
    _home_stage(stage, given)
    for way in given.steps:
        stage.jog(**way, feed_mm_min=given.feed)
        try:
            stage.finish_move()
        except KeyboardInterrupt:
            stage.cancel_jog()
            raise
        _show_place("moved", stage)


def _recover_stage(stage: Stage, _: argparse.Namespace) -> None:
    stage.recover()
    unknown = "its position is unknown until 'teatbench stage home'"
    print(f"restarted, in state {stage.status().name}; {unknown}", flush=True)


Opener = Callable[[argparse.Namespace], AbstractContextManager[Any]]
Work = Callable[[Any, argparse.Namespace], int | None]
_unidentified = partial(_bath, identify=False)
_left_running = partial(_bath, leave_running=True)  # it goes on, at another temperature
VERBS: Mapping[str, tuple[Opener, Work]] = {
    "arm home": (lambda given: _arm(given, on_peg=given.on_peg), _home_arm),
    "arm watch": (lambda given: _arm(given, homed=given.homed, ask=True), _watch_arm),
    "bath read": (_bath, _read_bath),
    "bath learn": (_unidentified, _learn_bath),
    "bath set": (_left_running, _set_bath),
    "bath watch": (_bath, _watch_bath),
    "bath standby": (_unidentified, _stand_by),
    "camera show": (_cameras, _show_cameras),
    "camera focus": (_cameras, _focus_cameras),
    "camera grab": (_cameras, _grab_frames),
    "stage status": (_stage, _show_stage),
    "stage home": (_stage, _home_stage),
    "stage move": (_stage, _move_stage),
    "stage jog": (_stage, _jog_stage),
    "stage recover": (_stage, _recover_stage),
}
