"""The rig without a run: `check` and `emulate`; `rigs`; `replay-wire`, the far end of a capture;
and `scene sheet|record|boards`.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import bench
from bench.cli.arguments import CODES, complain, print_json, print_values, refuse_existing
from bench.cli.terminal import working
from bench.config import ConfigError, did_you_mean
from bench.rig.loading import TO_COPY
from instruments.clock import Clock, RealClock

if TYPE_CHECKING:
    from instruments.captures.replay import Replay


def check(given: argparse.Namespace) -> int:
    rig = bench.load_rig(given.rig)
    print("".join(f"{note}\n" for note in bench.rig_notes(rig)), end="")
    code = CODES.wrong_use if rig.unfilled() else CODES.met
    for name, fault, lines in bench.check_rig(rig, given.capture):
        found = "not checked" if rig.unfilled(name) else "FAULT" if fault else "ok"
        code = CODES.fault if found == "FAULT" else code
        print(f"{name}: {found}", *(f"  {line}" for line in lines), sep="\n")
    return code


def emulate(given: argparse.Namespace) -> int:
    from bench.files import write_synced
    from bench.rig.emulated_rig import EmulatedRig, port_of
    from bench.rig.practice import Practice, page_of
    from bench.rig.urls import ELSEWHERE
    from instruments.camera.stream import StreamServer
    from instruments.listener import Listener
    from instruments.operators.remote import OperatorPort

    rig = bench.load_rig(given.rig)
    clock, base = RealClock(), given.port_base
    valid = f"while it runs with --port-base {base}" if base else "while this runs"
    try:
        with ExitStack() as stack:
            serial = {"pty": given.pty, "paced": given.paced, "port_base": base}
            twin = stack.enter_context(
                EmulatedRig(rig, clock, rig.rig.seed, host=given.listen, **serial)
            )
            streams = StreamServer(
                twin.cameras,
                clock,
                host=given.listen,
                port=port_of("cameras", base),
                page=lambda: page_of(practice),
                act=lambda words: practice.do(words),
            )
            stack.enter_context(closing(streams))
            lock, port = threading.RLock(), port_of("operator", base)
            operator = OperatorPort(twin.operator)
            hands = Listener(
                operator, clock, lock=lock, name="operator", host=given.listen, port=port
            )
            stack.enter_context(closing(hands))
            practice = Practice(
                twin, lambda one, out: (streams.pulled.add if out else streams.pulled.discard)(one)
            )
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
                    text = _rig_text(rig, urls, valid)
                    write_synced(given.write_rig, text.encode("utf-8"))
                    print(f"written: {given.write_rig}; good {valid}", flush=True)
                if not shown:
                    print(f"page {streams.page_url}", flush=True)
                shown = urls
                practice.jam_again()
                clock.sleep(0.5)
    except KeyboardInterrupt:
        return CODES.met
    except OSError as error:
        place = "pseudo-terminals" if given.pty else given.listen
        return complain(f"can't listen on {place}: {error}", CODES.wrong_use)
    finally:
        clock.close()


def _rig_text(rig: bench.LoadedRig, urls: Mapping[str, str], valid: str) -> str:
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
    return toml_text(table, f"Written by 'teatbench emulate', and good {valid}.")


def rigs(given: argparse.Namespace) -> None:
    if given.json:
        print_json({"rigs": bench.rigs(), "to_copy": str(TO_COPY)})
        return
    names = dict.fromkeys(bench.rigs(), "")
    print_values(names | {"for a real rig": f"copy {TO_COPY}, where every key is explained"})


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


def _members(given: argparse.Namespace) -> range:
    return range(given.first, given.first + given.seeds)


def sheet(given: argparse.Namespace) -> None:
    refuse_existing(given.out, replace=True)
    rig = bench.load_rig(given.rig)
    with working("rendering the scenes"):
        bench.write_sheet(rig, given.situation, _members(given), given.out, given.seed)
    print(given.out)


def boards(given: argparse.Namespace) -> int:
    (board, _), watching = bench.find_board(given.board), given.camera or ["left", "right"]
    rig = bench.load_rig(given.rig)
    asked = board, watching, given.poses, given.out, given.seed
    frames = bench.record_boards(rig, *asked, warmer_k=given.warmer_k)
    return _shown(frames, given.out, given.poses)


def record(given: argparse.Namespace) -> int:
    asked = given.situation, _members(given), given.out, given.seed, given.perturb
    frames = bench.record_scenes(bench.load_rig(given.rig), *asked)
    families = {*given.situation} or bench.families()
    return _shown(frames, given.out, len(families) * given.seeds)


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
