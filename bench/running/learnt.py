"""What runs really took, kept in their folders, so that the next estimate is better than what is assumed; and what a run will need.

A figure is a running mean over the last runs on the same rig; the newest count most. May not open an instrument.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bench.addresses import CONSOLE
from bench.record import RunRecord
from bench.rig import LoadedRig
from bench.running.trial_time import ASSUMED, TimeEstimate, estimate, settling_of, touched_trials
from bench.script import LoadedScript
from bench.store import write_synced

FILE = "times.json"  # in a run's folder
LOOKS_BACK = 8  # runs
KEEPS = 0.5  # of what was known before, against one further run
LEAST_RISE_K = 1.0  # less says nothing of how fast a bath heats


@dataclass(frozen=True, slots=True)
class Needs:
    """What a run will need: time by parts, room on the disk at most, and how often a person is asked."""

    time: TimeEstimate
    disk_mb: float
    prompts: int


def needs(rig: LoadedRig, script: LoadedScript, learnt: Mapping[str, float] | None = None) -> Needs:
    """By what is ``learnt`` of the rig, and by what is assumed where nothing is; of what is emulated nothing needs to be assumed."""
    learnt, emulated = learnt or {}, bool(rig.rig.emulated)
    figures = {**ASSUMED, **learnt}
    if emulated:
        figures |= {"homing": 0.0, "capture": 0.0}
    if rig.rig.operator.url != CONSOLE:
        figures |= dict.fromkeys(("set-up", "placing", "touch"), rig.rig.emulation.prompt_s if emulated else 0.0)
    time = estimate(rig, script, figures)
    if emulated or "heating" not in learnt:
        time = replace(time, settling_s=settling_of(rig, script))
    return Needs(time, _disk_mb(rig, script), _prompts(rig, script))


def _disk_mb(rig: LoadedRig, script: LoadedScript) -> float:
    """As if nothing could be compressed, with as much again for the pictures of the detectors' stages."""
    c = rig.calibration
    one = sum(w * h for w, h in (c.left.image_size, c.right.image_size, c.thermal.image_size))
    w, h = c.thermal.sensor_size
    return 2.0 * len(script.planned) * (one + 2 * w * h) / 1e6


def _prompts(rig: LoadedRig, script: LoadedScript) -> int:
    """Homing, the arm check before and after, each set-up, each touch; carried trials need neither where the stage moves all."""
    arm, planned = rig.rig.arm, script.planned
    each = script.script.truth.readings or arm.touches
    touches = sum(each * len(planned[at].phantom.teats) + 1 for at in touched_trials(rig, script))
    return 1 + (2 * arm.check_touches if arm.check_point_mm else 0) + touches


def took(run: RunRecord) -> dict[str, float]:
    """The seconds that a run took, by the same parts; what it doesn't tell is left out."""
    found: dict[str, float] = {}
    heating = next((e["t_s"] for e in run.events if e["kind"] == "state" and e["text"].startswith("heating the bath")), None)
    stable = next((e["t_s"] for e in run.events if e["kind"] == "stable"), None)
    if heating is not None and stable is not None:
        found["settling_s"] = stable - heating
    timed = [trial.head for trial in run.trials if trial.head["started_s"] is not None and trial.head["note"] is None]
    if timed[1:]:
        found["to_capture_s"] = sum(head["captured_s"] - head["started_s"] for head in timed[1:]) / len(timed[1:])
    touches = sum(len(trial.touches) for trial in run.trials)
    if touches:
        found["touch_s"] = sum(head["ended_s"] - head["captured_s"] for head in timed) / touches
    if run.events and run.events[-1]["t_s"] is not None:
        found["total_s"] = float(run.events[-1]["t_s"])
    return found


def figures(run: RunRecord, rig: LoadedRig, script: LoadedScript, spent: Mapping[str, float]) -> dict[str, float]:
    """What ``spent`` says of the figures that estimates assume, by their names."""
    learnt: dict[str, float] = {}
    gate = script.script.bath
    rise_k = gate.set_point_c - float(run.bath[0, 1]) if len(run.bath) else 0.0
    heating_s = spent.get("settling_s", 0.0) - gate.window_s
    if rise_k >= LEAST_RISE_K and heating_s > 0.0:
        learnt["heating"] = 60.0 * rise_k / heating_s
    if "touch_s" in spent:
        learnt["touch"] = spent["touch_s"]
    if "to_capture_s" in spent:
        learnt |= _set_ups(rig, script, spent["to_capture_s"])
    return learnt


def _set_ups(rig: LoadedRig, script: LoadedScript, to_capture_s: float) -> dict[str, float]:
    """Set-ups and placings both, in the proportion that is assumed of them: the record doesn't tell one from the other."""
    assumed, count = estimate(rig, script), len(script.planned)
    moving_s = max(0.0, assumed.moves_s - (ASSUMED["homing"] if rig.rig.stage else 0.0)) / count
    left_s = max(0.0, to_capture_s - rig.rig.cameras.settle_s - moving_s)
    if assumed.set_ups_s <= 0.0:
        return {}
    share = left_s * count / assumed.set_ups_s
    return {name: ASSUMED[name] * share for name in ("set-up", "placing")}


def read_learnt(folder: Path, rig: LoadedRig) -> dict[str, float]:
    """The figures learnt of ``rig`` from the last runs in ``folder``: the newest counts half, the one before a quarter, and so on."""
    known: dict[str, float] = {}
    for path in sorted(folder.glob(f"*/{FILE}"))[-LOOKS_BACK:]:
        for name, value in _read(path, rig).items():
            known[name] = KEEPS * known[name] + (1.0 - KEEPS) * value if name in known else value
    return known


def _read(path: Path, rig: LoadedRig) -> dict[str, float]:
    """Nothing where the run was another rig's, or the file can't be understood: an estimate isn't worth a fault."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        return {name: float(kept["figures"][name]) for name in ASSUMED if name in kept["figures"]} if kept["rig"] == _name(rig) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_learnt(run: Path, rig: LoadedRig, expected: TimeEstimate, spent: Mapping[str, float], new: Mapping[str, float]) -> None:
    """Keep in the folder of a ``run`` what was expected, what it took, and the figures that follow. Raises OSError."""
    known = {"rig": _name(rig), "expected_s": {**asdict(expected), "total_s": expected.total_s}, "took": dict(spent), "figures": dict(new)}
    write_synced(run / FILE, json.dumps(known, indent=1).encode())


def told(expected: TimeEstimate, spent: Mapping[str, float]) -> str:
    """``It took 20 min of the bench's time; 38 min were expected.``"""
    return f"It took {spent['total_s'] / 60:.0f} min of the bench's time; {expected.total_s / 60:.0f} min were expected."


def _name(rig: LoadedRig) -> str:
    """Emulated and in person are different hands."""
    return f"{rig.rig.name}, operator {rig.rig.operator.url}"
