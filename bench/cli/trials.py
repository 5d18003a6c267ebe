"""`trials` and `trials show`: which scripts ship, what a script comes to, and how long it takes."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.cli.arguments import CODES
from bench.rig.loading import find_rig, load_rig, shipped
from bench.script.model import TRIALS, LoadedScript, find_script, load_script
from bench.script.pixel_offsets import is_offset_script, load_offsets

if TYPE_CHECKING:
    from bench.run.estimate import TimeEstimate


def listed(given: argparse.Namespace) -> int:
    rows = {}
    for name in shipped(TRIALS):
        path = TRIALS / f"{name}.toml"
        loaded = load_offsets(path) if is_offset_script(path) else load_script(path)
        rows[name] = loaded.script.about
    if given.json:
        print(json.dumps(rows, ensure_ascii=False))
    else:
        for name, what in rows.items():
            print(f"{name}: {what}" if what else name)
    return CODES.met


def show(given: argparse.Namespace) -> int:
    path = find_script(given.script)
    if is_offset_script(path):
        return _show_offsets(path, as_json=given.json)
    from bench.run.estimate import estimate

    rig = load_rig(find_rig(given.rig))
    script = load_script(path, rig.rig.limits.set_point_c)
    time = estimate(rig, script)
    if given.json:
        print(json.dumps(_as_json(script, time, rig.rig.name), ensure_ascii=False))
    else:
        _print(script, time)
    return CODES.met


def _show_offsets(path: Path, *, as_json: bool) -> int:
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
    from bench.run.estimate import ASSUMED, UNITS
    from bench.script.planned_trials import POSE_KEYS, pose_set

    s = script.script
    poses = pose_set(s.trials, script.planned, seed=s.seed, order=s.order)
    rows = [dict(zip(POSE_KEYS, row, strict=True)) for row in poses.pop("poses")]
    return {
        "script": script.name,
        "title": s.title,
        "rig": rig,
        **poses,
        "trials": rows,
        "estimate": {**asdict(time), "total_s": time.total_s},
        "assumed": {f"{what} [{UNITS.get(what, 's')}]": value for what, value in ASSUMED.items()},
    }


def _print(script: LoadedScript, time: TimeEstimate) -> None:
    from rich.table import Table

    from bench.cli.terminal import Terminal
    from bench.run.estimate import assumed_told
    from bench.script.planned_trials import chosen

    poses = len({one.name for one in script.planned})
    table = Table(title=f"{script.script.title}: {len(script.planned)} trials, {poses} poses")
    for column in ("trial", "situation", "layout", "x", "y", "z", "yaw", "from"):
        table.add_column(column, justify="right" if len(column) <= 3 else "left")
    for one in script.planned:
        pose = (one.pose.x_mm, one.pose.y_mm, one.pose.z_mm, one.yaw_deg)
        values = (f"{value:+.1f}" for value in pose)
        table.add_row(one.id, one.situation, one.phantom.name, *values, one.side or "")
    console = Terminal()
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
