"""`check` and `emulate`: the rig itself, without a script; `rigs` and `detectors`: what there is;
`replay-wire`: the far end of a capture, played back for whoever connects.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES, complain, refuse_existing
from bench.config import ConfigError, did_you_mean
from bench.rig.loading import NO_RIGS, RIGS, TO_COPY, LoadedRig, find_rig, load_rig, shipped
from instruments.clock import Clock, RealClock

if TYPE_CHECKING:
    from instruments.captures.replay import Replay


def check(given: argparse.Namespace) -> int:
    from bench.rig.check import check_rig

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


def emulate(given: argparse.Namespace) -> int:
    from bench.files import write_synced
    from bench.rig.emulated_rig import EmulatedRig
    from bench.rig.urls import ELSEWHERE
    from instruments.camera.stream import StreamServer
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


def rigs(_: argparse.Namespace) -> int:
    names = {name: "" for name in shipped(RIGS) if name not in NO_RIGS}
    return _list(names | {"for a real rig": f"copy {TO_COPY}, where every key is explained"})


def detectors(_: argparse.Namespace) -> int:
    from bench.script.detectors import declared
    from detector.registry import available, broken

    _list({**declared(), **available()})
    return _list({name: f"BROKEN: {why}" for name, why in broken().items()})


def _list(rows: dict[str, str]) -> int:
    for name, what in rows.items():
        print(f"{name}: {what}" if what else name)
    return CODES.met


def replay_wire(given: argparse.Namespace) -> int:
    """The far end of a capture, until Ctrl-C or, for ``--once``, its end; mismatches are printed as
    they come.
    """
    from instruments.captures.capture import read_capture
    from instruments.captures.replay import Replay

    capture = read_capture(given.file)
    if not capture.links:
        raise ConfigError.plain(
            f"{capture.path}: no link was opened in it, so there is nothing to play"
        )
    for name in given.link:
        if name not in capture.links:
            there = ", ".join(capture.links)
            raise ConfigError.plain(
                f'{capture.path}: no link "{name}"{did_you_mean(name, capture.links) or "."} It'
                f" has: {there}."
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
    """Print mismatches as they come, until Ctrl-C or, for ``once``, the end; gives back the exit
    code.
    """
    shown = 0

    def show() -> int:
        new = replay.mismatches[shown:]
        for one in new:
            print(f"{path}:{one.line}: {one.link}: {one.sentence}", flush=True)
        return shown + len(new)

    with suppress(KeyboardInterrupt):  # the way to end it
        while not (once and replay.finished):
            clock.sleep(0.05)
            shown = show()
    shown = show()
    unplayed = replay.unplayed if once else []
    for what in unplayed:
        print(what, flush=True)
    return CODES.not_met if shown or unplayed else CODES.met
