"""Before a run: `trials` and `trials show` say which scripts ship, what a script comes to, and how
long it takes; `plan`, how many poses a claim needs and what so many can show.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import bench
from bench.cli.arguments import CODES, print_json, print_values
from bench.config import ConfigError
from textfiles.text import plural

if TYPE_CHECKING:
    from rich.table import Table


def listed(given: argparse.Namespace) -> None:
    rows = {name: bench.load_script(name).script.about for name in bench.scripts()}
    print_values({"scripts": rows} if given.json else rows, as_json=given.json)


def show(given: argparse.Namespace) -> int:
    found = bench.plan_script(given.script, given.rig or "emulated")
    time, script, rows = found.time, found.script, found.trials
    if given.json:
        shown = {
            "script": script.name,
            "title": script.script.title,
            "rig": found.rig.rig.name,
            **{key: getattr(found, key) for key in ("chosen", "order", "seed", "trials")},
            "estimate": {**asdict(time), "total_s": time.total_s},
            "assumed": {f"{key} [{unit}]": value for key, (value, unit) in found.assumed.items()},
        }
        print_json(shown)
        return CODES.met
    from bench.cli.terminal import Terminal, print_table

    console = Terminal()
    print_table(console, _pose_table(script, rows))
    for sentence in found.chosen:
        console.print(sentence, highlight=False)
    spent = ", ".join(
        f"{what.removesuffix('_s').replace('_', '-')} {seconds / 60:.0f} min"
        for what, seconds in asdict(time).items()
    )
    console.print(
        f"About {time.total_s / 3600:.1f} h with a person at the arm: {spent}.", highlight=False
    )
    assumed = (f"{what} {value:g} {unit}" for what, (value, unit) in found.assumed.items())
    console.print(f"Assumed: {', '.join(assumed)}.", highlight=False)
    return CODES.met


def _pose_table(script: bench.LoadedScript, rows: Sequence[Mapping[str, float]]) -> Table:
    """A row a trial; columns that are 0 in all of them are left out, and named below."""
    from rich.table import Table

    from instruments import spoken

    many = f"{plural(len(rows), 'trial')}, {plural(script.poses, 'pose')}"
    cells: dict[str, list[str]] = {
        "trial": [one.id for one in script.planned],
        "situation": [spoken(one.situation) for one in script.planned],
        "layout": [one.phantom.name for one in script.planned],
        **{
            head: [f"{row[key]:+z.1f}" for row in rows]
            for head, key in (("x", "x_mm"), ("y", "y_mm"), ("z", "z_mm"), ("yaw", "yaw_deg"))
        },
        "from": [one.side or "" for one in script.planned],
    }
    zero = [head for head, column in cells.items() if set(column) <= {"+0.0", ""}]
    text = [head for head in zero if head != "from"]
    table = Table(
        title=f"{script.script.title}: {many}",
        caption=f"0 in all trials: {', '.join(text)}" if text else None,
    )
    heads = [head for head in cells if head not in zero]
    for head in heads:
        table.add_column(head, justify="right" if len(head) <= 3 else "left")
    for values in zip(*(cells[head] for head in heads), strict=True):
        table.add_row(*values)
    return table


def plan(given: argparse.Namespace) -> None:
    if given.script and given.trials is not None:
        raise ConfigError.plain(
            "--script and --trials both say how many poses there are; give one of them"
        )
    poses, confidence = given.trials, given.confidence
    if given.script:
        script = bench.load_script(given.script)
        poses, confidence = script.poses, script.first_confidence(confidence)
    names = ("failures", "true_rate", "sd_mm", "shift_mm", "power", "limit_mm", "u_mm")
    more = {name: getattr(given, name) for name in names}
    rates = {"rates": given.rate} if given.rate else {}
    found = bench.plan_poses(**rates, confidence=confidence, poses=poses, **more)
    if given.json:
        print_json(asdict(found), indent=1)
    else:
        print(*found.lines(), sep="\n")
