"""Before a run: what a script comes to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bench.api.loading import AnyRig, AnyScript, load_rig, load_script
from bench.config import all_of, wrong_use
from bench.rig.loading import LoadedRig
from bench.run.estimate import ASSUMED, UNITS, TimeEstimate, estimate
from bench.scoring import sample_size
from bench.script.model import LoadedScript
from bench.script.planned_trials import POSE_KEYS, pose_set

plan_poses = wrong_use()(sample_size.plan_poses)


@dataclass(frozen=True, slots=True)
class ScriptPlan:
    """A script on a rig: ``trials`` in their order, each with ``id``, ``pose``, ``repeat``,
    ``x_mm``, ``y_mm``, ``z_mm``, ``yaw_deg`` and ``from``; ``chosen``: how poses were chosen, a
    sentence each; ``time`` with a person at the arm, by what is ``assumed`` (a value, its unit).
    """

    script: LoadedScript
    trials: tuple[Mapping[str, Any], ...]
    chosen: tuple[str, ...]
    order: str
    seed: int
    time: TimeEstimate
    assumed: Mapping[str, tuple[float, str]]
    rig: LoadedRig


def plan_script(script: AnyScript = None, rig: AnyRig = "emulated") -> ScriptPlan:
    """The poses of a script, and how long it takes on a rig: `teatbench trials show`. Raises
    ConfigError.
    """
    on, loaded = all_of(lambda _: load_rig(rig), lambda to: load_script(script, to[0]))
    s = loaded.script
    found = pose_set(s.trials, loaded.planned, seed=s.seed, order=s.order)
    rows = tuple(dict(zip(POSE_KEYS, row, strict=True)) for row in found["poses"])
    assumed = {name: (value, UNITS.get(name, "s")) for name, value in ASSUMED.items()}
    time = estimate(on, loaded)
    return ScriptPlan(loaded, rows, tuple(found["chosen"]), s.order, s.seed, time, assumed, on)
