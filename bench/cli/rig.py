"""`check` and `emulate`: the rig itself, without a script.

`rigs` and `detectors`: what there is.

`replay-wire`: the far end of a capture, played back for whoever connects.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, Commands, add_rig

if TYPE_CHECKING:
    from bench.rig.loading import LoadedRig
    from instruments.captures.reader import Capture
    from instruments.captures.replay import Replay
    from instruments.clock import Clock


def add_rig_commands(commands: Commands) -> None:
    """The family's commands with their arguments."""
    add_rig(
        commands.add(
            "check", "connect to every instrument, print who it is and one reading", _check
        )
    )
    emulate = commands.add(
        "emulate",
        "only the emulators of a rig, in real time, until Ctrl-C",
        _emulate,
        opens_links=False,
    )
    add_rig(emulate)
    emulate.add_argument(
        "--listen",
        default="127.0.0.1",
        metavar="HOST",
        help="address to listen on (default: 127.0.0.1)",
    )
    emulate.add_argument(
        "--pty",
        action="store_true",
        help="serial instruments on pseudo-terminals (Linux and macOS)",
    )
    what = "write a rig file with these addresses, for 'run --rig FILE' in another process"
    emulate.add_argument("--write-rig", type=Path, metavar="FILE", help=what)
    emulate.add_argument("--replace", action="store_true", help="write over a file that is there")
    emulate.add_argument(
        "--paced",
        action="store_true",
        help="serial instruments at the rig's baud rate, 10 bits a byte",
    )


def _check(given: argparse.Namespace) -> int:
    from bench.rig.check import check_rig
    from bench.rig.loading import find_rig, load_rig

    rig = load_rig(find_rig(given.rig))
    if rig.made_calibration is None:
        print(
            f"calibration: not made yet ({rig.calibration_path}); a run needs it, see"
            " docs/calibration.md"
        )
    failed = False
    for name, fault, lines in check_rig(rig, given.capture):
        failed |= fault
        print(f"{name}: {'FAULT' if fault else 'ok'}")
        for line in lines:
            print(f"  {line}")
    return CODES.fault if failed else CODES.met


def _emulate(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.files import write_synced
    from bench.rig.emulated_rig import EmulatedRig
    from bench.rig.loading import find_rig, load_rig
    from bench.rig.urls import ELSEWHERE
    from instruments.camera.stream import StreamServer
    from instruments.clock import RealClock
    from instruments.listener import Listener
    from instruments.operators.remote import OperatorPort

    if given.write_rig:
        refuse_existing(given.write_rig, replace=given.replace, option="--write-rig")
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
        print(
            f"teatbench: can't listen on {'pseudo-terminals' if given.pty else given.listen}:"
            f" {error}",
            file=sys.stderr,
        )
        return CODES.wrong_use
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
    if "pump" in urls:
        table["bath"]["pump_url"] = urls["pump"]
    cameras = {name: {"url": urls[name]} for name in ("left", "right", "thermal")}
    skew = {"max_skew_s": 1.0}  # a stream tells when a frame arrived, not when it was exposed
    kept = {key: value for key, value in table["cameras"].items() if key != "url"}
    table["cameras"] = kept | skew | cameras
    files = [(table, "calibration"), (table["arm"], "frame"), (table["arm"], "verification")]
    files += [(table["bath"], "profile"), (table["bath"], "pump_profile")]
    for holder, key in files:
        name = holder.get(key, "")
        if name and ("profile" not in key or name.endswith(".toml")):
            holder[key] = (rig.path.parent / name).resolve().as_posix()
    return toml_text(table, "Written by 'teatbench emulate', and good while that runs.")


def add_lists(commands: Commands) -> None:
    """The family's commands."""
    commands.add(
        "rigs",
        "the rig files that ship, and the one to copy for a real rig",
        _rigs,
        opens_links=False,
    )
    what = (
        "the detectors that ship, that other packages bring, and that files in ./detectors declare"
    )
    commands.add("detectors", what, _detectors, opens_links=False)


def _rigs(_: argparse.Namespace) -> int:
    from bench.rig.loading import NO_RIGS, RIGS, TO_COPY, shipped

    rigs = {name: "" for name in shipped(RIGS) if name not in NO_RIGS}
    return _list(rigs | {"for a real rig": f"copy {TO_COPY}, where every key is explained"})


def _detectors(_: argparse.Namespace) -> int:
    from bench.script.detectors import declared
    from detector.registry import available, broken

    _list({**declared(), **available()})
    return _list({name: f"BROKEN: {why}" for name, why in broken().items()})


def _list(rows: dict[str, str]) -> int:
    for name, what in rows.items():
        print(f"{name}: {what}" if what else name)
    return CODES.met


def add_wire(commands: Commands) -> None:
    """The family's command with its arguments."""
    replay = commands.add(
        "replay-wire",
        "play the far end of a capture back, for drivers to talk to",
        _replay_wire,
        opens_links=False,
    )
    replay.add_argument("file", type=Path, help="what a command wrote with --capture")
    replay.add_argument(
        "--listen",
        default="127.0.0.1",
        metavar="HOST",
        help="address to listen on (default: 127.0.0.1)",
    )
    replay.add_argument(
        "--link",
        action="append",
        default=[],
        metavar="NAME",
        help="only this link; may be given several times",
    )
    replay.add_argument(
        "--fast", action="store_true", help="answer at once, not after the recorded while"
    )
    replay.add_argument(
        "--once",
        action="store_true",
        help="end when all has been played, instead of beginning again",
    )


def _replay_wire(given: argparse.Namespace) -> int:
    from instruments.captures.reader import read_capture
    from instruments.captures.replay import Replay
    from instruments.clock import RealClock

    capture = read_capture(given.file)
    links = _links(capture, given.link)
    if capture.cut:
        print(f"teatbench: {given.file}: the last line is cut, and left out", file=sys.stderr)
    with closing(RealClock()) as clock:
        try:
            replay = Replay(
                capture,
                clock,
                links=links,
                fast=given.fast,
                again=not given.once,
                host=given.listen,
            )
        except OSError as error:
            print(f"teatbench: can't listen on {given.listen}: {error}", file=sys.stderr)
            return CODES.wrong_use
        with replay:
            for name, url in replay.urls.items():
                print(f"{name} {url}", flush=True)
            return _watch(replay, clock, given.file, once=given.once)


def _links(capture: Capture, wanted: list[str]) -> list[str]:
    """The names of the links to play. Raises ConfigError for one that the file lacks, or when it
    has none.
    """
    from bench.config import ConfigError, did_you_mean

    if not capture.links:
        raise ConfigError.plain(
            f"{capture.path}: no link was opened in it, so there is nothing to play"
        )
    for name in wanted:
        if name not in capture.links:
            there = ", ".join(capture.links)
            raise ConfigError.plain(
                f'{capture.path}: no link "{name}"{did_you_mean(name, capture.links) or "."} It'
                f" has: {there}."
            )
    return wanted or list(capture.links)


def _tell(replay: Replay, path: Path, told: int) -> int:
    """Print the mismatches behind the first ``told``; gives back how many there are."""
    for mismatch in replay.mismatches[told:]:
        print(f"{path}:{mismatch.line}: {mismatch.link}: {mismatch.sentence}", flush=True)
        told += 1
    return told


def _watch(replay: Replay, clock: Clock, path: Path, *, once: bool) -> int:
    """Tell mismatches as they come, until Ctrl-C or, for ``once``, the end; gives back the exit
    code.
    """
    told = 0
    with suppress(KeyboardInterrupt):  # the way to end it
        while not (once and replay.finished):
            clock.sleep(0.05)
            told = _tell(replay, path, told)
    told = _tell(replay, path, told)
    unplayed = replay.unplayed if once else []
    for what in unplayed:
        print(what, flush=True)
    return CODES.not_met if told or unplayed else CODES.met
