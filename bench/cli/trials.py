"""`trials` and `trials show`: which scripts ship, what a script comes to, and how long it takes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.cli.arguments import CODES, Commands

if TYPE_CHECKING:
    from bench.run.estimate import TimeEstimate
    from bench.script.model import LoadedScript


def add_to(commands: Commands) -> None:
    """The family's commands."""
    what = "the trial scripts that ship; 'trials show SCRIPT' lists a script's poses"
    trials = commands.add("trials", what, _list, opens_links=False)
    trials.add_argument("--json", action="store_true", help="one JSON object instead of lines")
    shown = Commands(trials.add_subparsers(title="commands", metavar="COMMAND"))
    what = "list the poses of a script, and estimate the time"
    show = shown.add("show", what, _show, opens_links=False)
    what = "a shipped script by name ('teatbench trials' lists them), or a .toml file"
    show.add_argument("script", metavar="SCRIPT", help=what)
    what = "a shipped rig by name, or a .toml file (default: emulated)"
    show.add_argument("--rig", metavar="RIG", help=what)
    show.add_argument("--json", action="store_true", help="one JSON object instead of a table")


def _list(given: argparse.Namespace) -> int:
    from bench.rig.loading import shipped
    from bench.script.model import TRIALS

    rows = {name: _about(TRIALS / f"{name}.toml") for name in shipped(TRIALS)}
    if given.json:
        print(json.dumps(rows, ensure_ascii=False))
    else:
        for name, what in rows.items():
            print(f"{name}: {what}" if what else name)
    return CODES.met


def _about(path: Path) -> str:
    from bench.script.model import load_script
    from bench.script.pixel_offsets import is_offset_script, load_offsets

    return (
        load_offsets(path).script.about
        if is_offset_script(path)
        else load_script(path).script.about
    )


def _show(given: argparse.Namespace) -> int:
    from bench.rig.loading import find_rig, load_rig
    from bench.run.estimate import estimate
    from bench.script.model import find_script, load_script
    from bench.script.pixel_offsets import is_offset_script

    path = find_script(given.script)
    if is_offset_script(path):
        return _show_offsets(path, as_json=given.json)
    rig = load_rig(find_rig(given.rig))
    script = load_script(path, rig.rig.limits.set_point_c)
    time = estimate(rig, script)
    if given.json:
        print(json.dumps(_as_json(script, time, rig.rig.name), ensure_ascii=False))
    else:
        _print(script, time)
    return CODES.met


def _show_offsets(path: Path, *, as_json: bool) -> int:
    from bench.script.pixel_offsets import load_offsets

    script = load_offsets(path).script
    if as_json:
        print(script.model_dump_json())
        return CODES.met
    print(f"{script.title}: {script.about}")
    for offset in script.offsets:
        print(
            f"teat {offset.teat}: {offset.left_px:g} px in the left picture, {offset.right_px:g} px"
            " in the right one"
        )
    print(
        f"{script.directions} directions a picture. No trials: it needs a calibration and no"
        " instruments, and is over at once."
    )
    return CODES.met


def _as_json(script: LoadedScript, time: TimeEstimate, rig: str) -> dict[str, Any]:
    from dataclasses import asdict

    from bench.run.estimate import ASSUMED, UNITS
    from bench.script.planned_trials import POSE_KEYS, pose_set

    s = script.script
    poses = pose_set(s.trials, script.planned, seed=s.seed, order=s.order)
    rows = [dict(zip(POSE_KEYS, row, strict=True)) for row in poses.pop("poses")]
    seconds = {**asdict(time), "total_s": time.total_s}
    assumed = {f"{what} [{UNITS.get(what, 's')}]": value for what, value in ASSUMED.items()}
    return {
        "script": script.name,
        "title": s.title,
        "rig": rig,
        **poses,
        "trials": rows,
        "estimate": seconds,
        "assumed": assumed,
    }


def _print(script: LoadedScript, time: TimeEstimate) -> None:
    from rich.table import Table

    from bench.cli.terminal import Terminal
    from bench.run.estimate import assumed_told
    from bench.script.planned_trials import chosen

    console = Terminal()
    table = Table(
        title=(
            f"{script.script.title}: {len(script.planned)} trials,"
            f" {len({one.name for one in script.planned})} poses"
        )
    )
    for column in ("trial", "situation", "layout", "x", "y", "z", "yaw", "from"):
        table.add_column(column, justify="right" if len(column) <= 3 else "left")
    for one in script.planned:
        pose = (one.pose.x_mm, one.pose.y_mm, one.pose.z_mm, one.yaw_deg)
        table.add_row(
            one.id,
            one.situation,
            one.phantom.name,
            *(f"{value:+.1f}" for value in pose),
            one.side or "",
        )
    console.print(table)
    for trial in script.script.trials:
        console.print(chosen(trial), highlight=False)
    parts = {"settling": time.settling_s, "moves": time.moves_s, "set-ups": time.set_ups_s}
    parts |= {"captures": time.captures_s, "touches": time.touches_s}
    spent = ", ".join(f"{what} {seconds / 60:.0f} min" for what, seconds in parts.items())
    console.print(
        f"About {time.total_s / 3600:.1f} h with a person at the arm: {spent}.", highlight=False
    )
    console.print(assumed_told(), highlight=False)
