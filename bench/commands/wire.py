"""`replay-wire`: the far end of a capture, played back for whoever connects."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands

if TYPE_CHECKING:
    from instruments.capture_reader import Capture
    from instruments.clock import Clock
    from instruments.replay import Replay


def add_to(commands: Commands) -> None:
    """The family's command with its arguments."""
    replay = commands.add("replay-wire", "play the far end of a capture back, for drivers to talk to", _replay_wire, opens_links=False)
    replay.add_argument("file", type=Path, help="what a command wrote with --capture")
    replay.add_argument("--listen", default="127.0.0.1", metavar="HOST", help="address to listen on (default: 127.0.0.1)")
    replay.add_argument("--link", action="append", default=[], metavar="NAME", help="only this link; may be given several times")
    replay.add_argument("--fast", action="store_true", help="answer at once, not after the recorded while")
    replay.add_argument("--once", action="store_true", help="end when all has been played, instead of beginning again")


def _replay_wire(given: argparse.Namespace) -> int:
    from instruments.capture_reader import read_capture
    from instruments.clock import RealClock
    from instruments.replay import Replay

    capture = read_capture(given.file)
    links = _links(capture, given.link)
    if capture.cut:
        print(f"teatbench: {given.file}: the last line is cut, and left out", file=sys.stderr)
    with closing(RealClock()) as clock:
        try:
            replay = Replay(capture, clock, links=links, fast=given.fast, again=not given.once, host=given.listen)
        except OSError as error:
            print(f"teatbench: can't listen on {given.listen}: {error}", file=sys.stderr)
            return CODES.wrong_use
        with replay:
            for name, url in replay.urls.items():
                print(f"{name} {url}", flush=True)
            return _watch(replay, clock, given.file, once=given.once)


def _links(capture: Capture, wanted: list[str]) -> list[str]:
    """The names of the links to play. Raises ConfigError for one that the file lacks, or when it has none."""
    from bench.config import ConfigError, did_you_mean

    if not capture.links:
        raise ConfigError.plain(f"{capture.path}: no link was opened in it, so there is nothing to play")
    for name in wanted:
        if name not in capture.links:
            there = ", ".join(capture.links)
            raise ConfigError.plain(f'{capture.path}: no link "{name}"{did_you_mean(name, capture.links) or "."} It has: {there}.')
    return wanted or list(capture.links)


def _tell(replay: Replay, path: Path, told: int) -> int:
    """Print the mismatches behind the first ``told``; gives back how many there are."""
    for mismatch in replay.mismatches[told:]:
        print(f"{path}:{mismatch.line}: {mismatch.link}: {mismatch.sentence}", flush=True)
        told += 1
    return told


def _watch(replay: Replay, clock: Clock, path: Path, *, once: bool) -> int:
    """Tell mismatches as they come, until Ctrl-C or, for ``once``, the end; gives back the exit code."""
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
