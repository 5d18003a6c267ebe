"""`rigs` and `detectors`: what there is."""

from __future__ import annotations

import argparse

from bench.commands import CODES, Commands


def add_to(commands: Commands) -> None:
    """The family's commands."""
    commands.add("rigs", "the rig files that ship, and the one to copy for a real rig", _rigs, opens_links=False)
    what = "the detectors that ship, that other packages bring, and that files in ./detectors declare"
    commands.add("detectors", what, _detectors, opens_links=False)


def _rigs(_: argparse.Namespace) -> int:
    from bench.rig import NO_RIGS, RIGS, TO_COPY, shipped

    rigs = {name: "" for name in shipped(RIGS) if name not in NO_RIGS}
    return _list(rigs | {"for a real rig": f"copy {TO_COPY}, where every key is explained"})


def _detectors(_: argparse.Namespace) -> int:
    from bench.detecting.choice import declared
    from detector.registry import available, broken

    _list({**declared(), **available()})
    return _list({name: f"BROKEN: {why}" for name, why in broken().items()})


def _list(rows: dict[str, str]) -> int:
    for name, what in rows.items():
        print(f"{name}: {what}" if what else name)
    return CODES.met
