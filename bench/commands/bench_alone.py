"""`check` and `emulate`: the rig itself, without a script."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands, add_rig

if TYPE_CHECKING:
    from bench.rig import LoadedRig


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    add_rig(commands.add("check", "connect to every instrument, print who it is and one reading", _check))
    emulate = commands.add("emulate", "only the emulators of a rig, in real time, until Ctrl-C", _emulate, opens_links=False)
    add_rig(emulate)
    emulate.add_argument("--listen", default="127.0.0.1", metavar="HOST", help="address to listen on (default: 127.0.0.1)")
    emulate.add_argument("--pty", action="store_true", help="serial instruments on pseudo-terminals (Linux and macOS)")
    what = "write a rig file with these addresses, for 'run --rig FILE' in another process"
    emulate.add_argument("--write-rig", type=Path, metavar="FILE", help=what)
    emulate.add_argument("--replace", action="store_true", help="write over a file that is there")
    emulate.add_argument("--paced", action="store_true", help="serial instruments at the rig's baud rate, 10 bits a byte")


def _check(given: argparse.Namespace) -> int:
    from bench.checks import check_rig
    from bench.rig import find_rig, load_rig

    rig = load_rig(find_rig(given.rig))
    if rig.made_calibration is None:
        print(f"calibration: not made yet ({rig.calibration_path}); a run needs it, see docs/calibration.md")
    failed = False
    for name, fault, lines in check_rig(rig, given.capture):
        failed |= fault
        print(f"{name}: {'FAULT' if fault else 'ok'}")
        for line in lines:
            print(f"  {line}")
    return CODES.fault if failed else CODES.met


def _emulate(given: argparse.Namespace) -> int:
    from bench.addresses import ELSEWHERE
    from bench.arm.session import refuse_existing
    from bench.emulated.emulation import EmulatedRig
    from bench.rig import find_rig, load_rig
    from bench.store import write_synced
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
            EmulatedRig(rig, clock, rig.rig.seed, host=given.listen, pty=given.pty, paced=given.paced) as twin,
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
                    if shown.get(name) != url:  # a pty comes back under another name after the instrument hung up
                        print(f"{name} {url}", flush=True)
                if given.write_rig and shown != urls:
                    write_synced(given.write_rig, _rig_text(rig, urls).encode("utf-8"))
                    print(f"written: {given.write_rig}; good while this runs", flush=True)
                shown = urls
                clock.sleep(0.5)
    except KeyboardInterrupt:
        return CODES.met
    except OSError as error:
        print(f"teatbench: can't listen on {'pseudo-terminals' if given.pty else given.listen}: {error}", file=sys.stderr)
        return CODES.wrong_use
    finally:
        clock.close()


def _rig_text(rig: LoadedRig, urls: Mapping[str, str]) -> str:
    """The file of ``rig`` with its emulators at ``urls``, for any folder."""
    from bench.arm.toml_text import toml_text

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
