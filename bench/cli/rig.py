"""The rig without a run: `check` and `emulate`; `rigs`; `replay-wire`, the far end of a capture;
`scene sheet|record|boards|sensitivity` and `detect`, scenes and frames.
"""

from __future__ import annotations

import argparse
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.cli.arguments import CODES, complain, print_values, refuse_existing
from bench.cli.terminal import working
from bench.config import ConfigError, did_you_mean
from bench.rig.loading import NO_RIGS, RIGS, TO_COPY, LoadedRig, find_rig, load_rig, shipped
from instruments.clock import Clock, RealClock, wall_time

if TYPE_CHECKING:
    from bench.campaign.sensitivity import Measured
    from instruments.captures.replay import Replay


def check(given: argparse.Namespace) -> int:
    from bench.rig.alone import check_rig
    from bench.safety.latch import unconfirmed
    from bench.script.detectors import refusals
    from detector import registry

    rig = load_rig(find_rig(given.rig))
    if rig.made_calibration is None:
        print(
            f"calibration: not made yet ({rig.calibration_path}); a run needs it, see"
            " docs/calibration.md"
        )
    else:
        for why in refusals([registry.create(name) for name in registry.SHIPPED], rig.calibration):
            print(why)
    for why in unconfirmed(rig, wall_time().date()):
        print(why)
    failed = False
    for name, fault, lines in check_rig(rig, given.capture):
        failed |= fault
        print(f"{name}: {'FAULT' if fault else 'ok'}")
        for line in lines:
            print(f"  {line}")
    return CODES.fault if failed else CODES.met


def emulate(given: argparse.Namespace) -> int:
    from bench.files import write_synced
    from bench.rig.emulated_rig import EmulatedRig
    from bench.rig.urls import ELSEWHERE
    from instruments.camera.stream import StreamServer
    from instruments.listener import Listener
    from instruments.operators.remote import OperatorPort

    rig = load_rig(find_rig(given.rig))
    clock = RealClock()
    try:
        with (
            EmulatedRig(
                rig, clock, rig.rig.seed, host=given.listen, pty=given.pty, paced=given.paced
            ) as twin,
            closing(StreamServer(twin.cameras, clock, host=given.listen)) as streams,
            closing(
                Listener(
                    OperatorPort(twin.operator),
                    clock,
                    lock=threading.RLock(),
                    name="operator",
                    host=given.listen,
                )
            ) as hands,
        ):
            more = {name: f"opencv:{url}" for name, url in streams.urls.items()}
            more["operator"] = hands.url.replace("socket://", ELSEWHERE)
            shown: dict[str, str] = {}
            while True:
                urls = twin.urls | more
                for name, url in urls.items():
                    # a pty comes back under another name after the instrument hung up
                    if shown.get(name) != url:
                        print(f"{name} {url}", flush=True)
                if given.write_rig and shown != urls:
                    write_synced(given.write_rig, _rig_text(rig, urls).encode("utf-8"))
                    print(f"written: {given.write_rig}; good while this runs", flush=True)
                shown = urls
                clock.sleep(0.5)
    except KeyboardInterrupt:
        return CODES.met
    except OSError as error:
        place = "pseudo-terminals" if given.pty else given.listen
        return complain(f"can't listen on {place}: {error}", CODES.wrong_use)
    finally:
        clock.close()


def _rig_text(rig: LoadedRig, urls: Mapping[str, str]) -> str:
    """The file of ``rig`` with its emulators at ``urls``, for any folder."""
    from bench.toml import toml_text

    table = rig.rig.model_dump(exclude={"emulation"}, exclude_unset=True, by_alias=True)
    table["name"] += " (of 'teatbench emulate')"
    for name in ("operator", "arm", "bath", "stage"):
        if name in table:
            table[name]["url"] = urls[name]
    if rig.rig.stage and rig.rig.stage.dialect == "zaber":
        motors = rig.rig.stage.motors
        table["stage"]["zaber_axes"] = [f"{device} {axis}" for device, axis, _ in motors]
        table["stage"]["microsteps"] = [scale for _, _, scale in motors]
    if "pump" in urls:
        table["bath"]["pump_url"] = urls["pump"]
    cameras = {name: {"url": urls[name]} for name in ("left", "right", "thermal")}
    skew = {"max_skew_s": 1.0}  # a stream says when a frame arrived, not when it was exposed
    kept = {key: value for key, value in table["cameras"].items() if key != "url"}
    table["cameras"] = kept | skew | cameras
    files = [(table, "calibration"), (table["arm"], "frame"), (table["arm"], "verification")]
    files += [(table["bath"], "profile"), (table["bath"], "pump_profile")]
    for holder, key in files:
        name = holder.get(key, "")
        if name and ("profile" not in key or name.endswith(".toml")):
            holder[key] = (rig.path.parent / name).resolve().as_posix()
    return toml_text(table, "Written by 'teatbench emulate', and good while that runs.")


def rigs(_: argparse.Namespace) -> None:
    names = {name: "" for name in shipped(RIGS) if name not in NO_RIGS}
    names["for a real rig"] = f"copy {TO_COPY}, where every key is explained"
    print_values(names)


def replay_wire(given: argparse.Namespace) -> int:
    """The far end of a capture, until Ctrl-C or, for ``--once``, its end."""
    from instruments.captures.capture import read_capture
    from instruments.captures.replay import Replay

    capture = read_capture(given.file)
    if not capture.links:
        raise ConfigError.plain(
            f"{capture.path}: no link was opened in it, so there is nothing to play"
        )
    if unknown := next((name for name in given.link if name not in capture.links), None):
        raise ConfigError.plain(
            f'{capture.path}: no link "{unknown}"{did_you_mean(unknown, capture.links) or "."} It'
            f" has: {', '.join(capture.links)}."
        )
    if capture.cut:
        complain(f"{given.file}: the last line is cut, and left out", CODES.met)
    with closing(RealClock()) as clock:
        try:
            replay = Replay(
                capture,
                clock,
                links=given.link or list(capture.links),
                fast=given.fast,
                again=not given.once,
                host=given.listen,
            )
        except OSError as error:
            return complain(f"can't listen on {given.listen}: {error}", CODES.wrong_use)
        with replay:
            for name, url in replay.urls.items():
                print(f"{name} {url}", flush=True)
            return _watch(replay, clock, given.file, once=given.once)


def _watch(replay: Replay, clock: Clock, path: Path, *, once: bool) -> int:
    """Print mismatches until Ctrl-C or, for ``once``, the end; gives back the exit code."""
    shown, going = 0, True
    while going:
        try:
            clock.sleep(0.05)
            going = not (once and replay.finished)
        except KeyboardInterrupt:  # the way to end it
            going = False
        for one in replay.mismatches[shown:]:
            print(f"{path}:{one.line}: {one.link}: {one.sentence}", flush=True)
            shown += 1
    unplayed = replay.unplayed if once else []
    for what in unplayed:
        print(what, flush=True)
    return CODES.not_met if shown or unplayed else CODES.met


def detect(given: argparse.Namespace) -> int:
    from bench.run.recordings import detect_lines

    answered = False
    for line, text in detect_lines(given.recording, given.detector or ["thesis"]):
        print(json.dumps(line) if given.json else text, flush=True)
        answered = answered or "outcome" not in line
    if not answered:
        return complain(
            "no frame had an answer: 'teatbench detectors try' says what is wrong with a detector",
            CODES.fault,
        )
    return CODES.met


def _members(given: argparse.Namespace) -> range:
    return range(given.first, given.first + given.seeds)


def sheet(given: argparse.Namespace) -> None:
    from bench.rig.scenes import write_sheet

    refuse_existing(given.out, replace=True)
    rig = load_rig(find_rig(given.rig))
    with working("rendering the scenes"):
        write_sheet(rig, given.situation, _members(given), given.out, given.seed)
    print(given.out)


def boards(given: argparse.Namespace) -> int:
    from bench.rig.loading import find_board
    from bench.rig.scenes import record_boards

    (board, _), watching = find_board(given.board), given.camera or ["left", "right"]
    rig = load_rig(find_rig(given.rig))
    frames = record_boards(
        rig, board, watching, given.poses, given.out, given.seed, warmer_k=given.warmer_k
    )
    return _shown(frames, given.out, given.poses)


def record(given: argparse.Namespace) -> int:
    from bench.rig.scenes import chosen
    from bench.rig.scenes import record as recorded

    if given.coco:
        refuse_existing(given.coco, replace=True, option="--coco", makes_folder=True)
        if given.coco.exists():
            raise ConfigError.plain(f"--coco {given.coco} is there already. Name another file.")
        if any(one.name == "out-of-step" for one in given.perturb):
            raise ConfigError.plain(
                "--coco: masks are of the scene as drawn, and out-of-step moves the right picture"
                " after that. Leave one of the two out."
            )
    rig = load_rig(find_rig(given.rig))
    frames = recorded(
        rig, given.situation, _members(given), given.out, given.seed, given.perturb, given.coco
    )
    return _shown(frames, given.out, len(chosen(given.situation)) * given.seeds)


def _shown(frames: Iterator[str], out: Path, total: int) -> int:
    written = 0
    with working("rendering the scenes") as report:
        report(0, total)
        for frame in frames:
            print(frame, flush=True)
            written += 1
            report(written, total)
    print(f"{written} frames in {out}")
    return CODES.met


def sensitivity(given: argparse.Namespace) -> int:
    from bench.campaign.plan import with_whole_paths
    from bench.campaign.quantities import chosen
    from bench.campaign.run import locked
    from bench.campaign.sensitivity import Study, measured, opened
    from bench.cli.campaign import finish
    from bench.report.sensitivity import check_curves, no_answers, write_figure, write_numbers
    from bench.script.detectors import make_detectors

    quantities = chosen(given.quantity)
    path = load_rig(find_rig(given.rig)).path
    wanted = tuple(given.detector or ("fused", "thesis"))
    detectors = make_detectors(wanted)
    check_curves([detector.name for detector in detectors])
    plan = Study(
        families=Study.names(quantities),
        scenes=given.seeds,
        first=given.first,
        seed=given.seed,
        detectors=wanted,
        rig=str(path),
    )
    folder = given.out / "campaign"
    results: dict[str, list[Measured]] = {}
    with locked(folder):
        campaign = opened(with_whole_paths(plan, Path()), folder)
        if finish(campaign, "sensitivity", given.workers, None) is None:
            return CODES.fault
        for quantity in quantities:
            points = results[quantity.name] = []
            for point in measured(campaign, quantity):
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
    asked = ", ".join(f"{detector.name} (version {detector.version})" for detector in detectors)
    made = (
        f"teatbench {__version__}; {asked}; cameras of `{path.name}`; members {given.first} to"
        f" {given.first + given.seeds - 1} of `ideal` at each value, noise and cameras of seed"
        f" {given.seed}."
    )
    write_numbers(given.out, quantities, results, made)
    return CODES.met
