"""`bath read|set|watch|standby|acknowledge`: the water bath alone."""

from __future__ import annotations

import argparse
import json
import math
import sys

from bench.cli.arguments import CODES, Commands, add_rig, address, seconds


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    bath = commands.group("bath", "the water bath alone, without a rig file")
    read = _add_bath(bath.add("read", "one reading, and who answered; changes nothing", _read))
    read.add_argument("--json", action="store_true", help="one JSON object, units in its keys")
    change = _add_bath(bath.add("set", "change the set point; starts and stops nothing", _set))
    change.add_argument(
        "set_point", type=_degrees, metavar="DEGC", help="the new set point in degC"
    )
    change.add_argument(
        "--allow-inferred", action="store_true", help="also write what the profile only infers"
    )
    watch = _add_bath(bath.add("watch", "a live plot until Ctrl-C; changes nothing", _watch))
    watch.add_argument(
        "--seconds",
        type=seconds,
        default=math.inf,
        metavar="N",
        help="end after so long (default: Ctrl-C ends it)",
    )
    _add_bath(bath.add("standby", "heater off now, whatever the bath is doing", _standby))
    acknowledge = bath.add(
        "acknowledge",
        "after an interlock has tripped and its cause is gone: let the rig run again",
        _acknowledge,
    )
    add_rig(acknowledge)


def _add_bath(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.add_argument(
        "--port",
        required=True,
        type=address("bath"),
        metavar="URL",
        help="where the controller is, as in a rig file's [bath] url",
    )
    parser.add_argument(
        "--profile",
        required=True,
        metavar="NAME",
        help="the controller's family, or the path of a profile of your own",
    )
    return parser


def _degrees(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a temperature in degC")
    return value


def _read(given: argparse.Namespace) -> int:
    from bench.cli.live_view import described, open_bath, profile_of

    with open_bath(given.port, profile_of(given.profile), capture=given.capture) as (bath, _):
        told = described(bath)
    if given.json:
        print(json.dumps(told))
    else:
        for key, value in told.items():
            print(f"{key}: {'not told' if value is None else value}")
    return CODES.met


def _set(given: argparse.Namespace) -> int:
    from bench.cli.live_view import open_bath, profile_of, set_point
    from instruments.errors import LimitError

    with open_bath(
        given.port,
        profile_of(given.profile),
        allow_inferred=given.allow_inferred,
        capture=given.capture,
    ) as (bath, _):
        try:
            print(set_point(bath, given.set_point))
        except LimitError as error:
            print(f"teatbench: {error}", file=sys.stderr)
            return CODES.wrong_use
    return CODES.met


def _watch(given: argparse.Namespace) -> int:
    from bench.cli.live_view import open_bath, profile_of, watch_bath
    from bench.cli.terminal import Terminal

    with open_bath(given.port, profile_of(given.profile), capture=given.capture) as (bath, clock):
        try:
            watch_bath(bath, clock, Terminal(), given.seconds)
        except KeyboardInterrupt:
            print("left as it is; 'teatbench bath standby' switches the heater off")
    return CODES.met


def _standby(given: argparse.Namespace) -> int:
    from bench.cli.live_view import open_bath, profile_of, standby

    with open_bath(
        given.port, profile_of(given.profile), identify=False, capture=given.capture
    ) as (bath, _):
        print(standby(bath))
    return CODES.met


def _acknowledge(given: argparse.Namespace) -> int:
    from bench.cli.live_view import open_bath
    from bench.rig.loading import find_rig, load_rig
    from bench.safety.latch import acknowledge, latch_path, read_latch

    rig = load_rig(find_rig(given.rig))
    latch = read_latch(latch_path(rig))
    if latch is None:
        print("nothing is latched: no interlock of this rig waits to be acknowledged")
        return CODES.met
    print(f"latched: {latch}")
    with open_bath(rig.rig.bath.url, rig.profile, capture=given.capture) as (bath, _):
        acknowledge(rig, latch, bath.read())
    print("acknowledged; the rig may run again")
    return CODES.met
