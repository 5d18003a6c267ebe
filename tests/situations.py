"""The six situations of the shipped script as scenes, warm: what the tests of renderer and cameras
look at.
"""

from __future__ import annotations

from dataclasses import replace

from bench.config import read_config
from bench.script.model import TRIALS, Script
from bench.script.phantom import shipped_phantom
from bench.script.planned_trials import Trial
from instruments.world.objects import make_object
from instruments.world.state import SceneState

SITUATIONS: dict[str, Trial] = {
    trial.situation: trial for trial in read_config(TRIALS / "six-situations.toml", Script).trials
}


def situation(
    name: str, *, teat_c: float = 32.5, hose_c: float = 31.5, ambient_c: float = 21.0
) -> SceneState:
    """A situation as the cameras would see it, the phantom warm."""
    trial = SITUATIONS[name]
    phantom = shipped_phantom(trial.layout)
    state = SceneState(phantom, (teat_c,) * len(phantom.teats), hose_c, ambient_c)
    return replace(state, objects=tuple(make_object(**table) for table in trial.objects))
