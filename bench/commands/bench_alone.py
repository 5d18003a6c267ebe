"""`check` and `emulate`: the rig itself, without a script."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing

from bench.commands import CODES, Commands, add_rig


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    add_rig(commands.add("check", "connect to every instrument, print who it is and one reading", _check))
    emulate = commands.add("emulate", "only the emulators of a rig, in real time, until Ctrl-C", _emulate, opens_links=False)
    add_rig(emulate)
    emulate.add_argument("--listen", default="127.0.0.1", metavar="HOST", help="address to listen on (default: 127.0.0.1)")
    emulate.add_argument("--pty", action="store_true", help="serial instruments on pseudo-terminals (Linux and macOS)")
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
    from bench.emulated.emulation import EmulatedRig
    from bench.rig import find_rig, load_rig
    from instruments.camera.stream import StreamServer
    from instruments.clock import RealClock

    rig = load_rig(find_rig(given.rig))
    clock = RealClock()
    try:
        with (
            EmulatedRig(rig, clock, rig.rig.seed, host=given.listen, pty=given.pty, paced=given.paced) as twin,
            closing(StreamServer(twin.cameras, clock, host=given.listen)) as streams,
        ):
            shown: dict[str, str] = {}
            while True:
                for name, url in {**twin.urls, **streams.urls}.items():
                    if shown.get(name) != url:  # a pty comes back under another name after the instrument hung up
                        print(f"{name} {url}", flush=True)
                        shown[name] = url
                clock.sleep(0.5)
    except KeyboardInterrupt:
        return CODES.met
    except OSError as error:
        print(f"teatbench: can't listen on {'pseudo-terminals' if given.pty else given.listen}: {error}", file=sys.stderr)
        return CODES.wrong_use
    finally:
        clock.close()
