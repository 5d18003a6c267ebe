"""`rigs`, `trials` and `detectors`: what ships."""

from __future__ import annotations

import argparse

from bench.commands import CODES, Commands


def add_to(commands: Commands) -> None:
    """The family's commands."""
    commands.add("rigs", "the rig files that ship", _rigs, opens_links=False)
    commands.add("trials", "the trial scripts that ship", _trials, opens_links=False)
    commands.add("detectors", "the detectors that ship", _detectors, opens_links=False)


def _rigs(_: argparse.Namespace) -> int:
    from bench.rig import RIGS, shipped

    return _list({name: "" for name in shipped(RIGS) if name != "calibration"})


def _trials(_: argparse.Namespace) -> int:
    from bench.rig import shipped
    from bench.script import TRIALS, load_script

    return _list({name: load_script(TRIALS / f"{name}.toml").script.about for name in shipped(TRIALS)})


def _detectors(_: argparse.Namespace) -> int:
    from detector.registry import available

    return _list(available())


def _list(rows: dict[str, str]) -> int:
    for name, what in rows.items():
        print(f"{name}: {what}" if what else name)
    return CODES.met
