"""How long a script takes: settling, moves, set-ups, captures, touches. An estimate from the files alone; it opens nothing.

What a rig file doesn't say is assumed, and told with the figure. A person is slower than an emulated one; time is the bench's own, so
an emulated run is over much sooner.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

from bench.planning.dry_run import carry_touches
from bench.planning.trials import PlannedTrial, shared
from bench.rig import LoadedRig
from bench.rig_tables import Stage
from bench.running.stability import StabilityGate, State
from bench.script import LoadedScript
from instruments.world.plant import Plant

ASSUMED = {
    "heating": 0.5,  # K/min: a bath of 20 L, with 1 kW, and its losses
    "acceleration": 200.0,  # mm/s^2: what stages of this kind are set to
    "homing": 60.0,  # s
    "set-up": 60.0,  # s: a person changes the scene
    "placing": 30.0,  # s: a person moves the plate
    "touch": 8.0,  # s: a person finds the apex and holds still
    "capture": 1.0,  # s: a frame set
}
UNITS = {"heating": "K/min", "acceleration": "mm/s^2"}


@dataclass(frozen=True, slots=True)
class TimeEstimate:
    """Seconds by what they are spent on."""

    settling_s: float
    moves_s: float
    set_ups_s: float
    captures_s: float
    touches_s: float

    @property
    def total_s(self) -> float:
        """All of it."""
        return self.settling_s + self.moves_s + self.set_ups_s + self.captures_s + self.touches_s

    def each_s(self, trials: int) -> float:
        """One of so many trials, without the settling before the first."""
        return (self.total_s - self.settling_s) / trials


def estimate(rig: LoadedRig, script: LoadedScript, figures: Mapping[str, float] = ASSUMED) -> TimeEstimate:
    """How long ``script`` takes on ``rig``, at the bench's own time, by ``figures`` as those assumed."""
    r, planned = rig.rig, script.planned
    gate = script.script.bath
    settling = gate.window_s + 60.0 * max(0.0, gate.set_point_c - r.bath.room_c) / figures["heating"]
    touches = (script.script.truth.readings or r.arm.touches) * sum(len(planned[at].phantom.teats) for at in touched_trials(rig, script))
    return TimeEstimate(
        settling_s=settling,
        moves_s=_moves_s(r.stage, planned, figures) if r.stage else 0.0,
        set_ups_s=sum(_set_ups_s(r.stage.axes if r.stage else "", planned, figures)),
        captures_s=len(planned) * (r.cameras.settle_s + figures["capture"]),
        touches_s=touches * figures["touch"],
    )


def gate_of(script: LoadedScript) -> StabilityGate:
    """The stability gate that ``script`` asks for."""
    return StabilityGate(**script.script.bath.model_dump(exclude={"timeout_s"}))


def settling_of(rig: LoadedRig, script: LoadedScript) -> float:
    """How long the emulated bath takes from its start until the gate opens, as a dry run finds it; at most what the script allows."""
    emulation, bath, gate = rig.rig.emulation, script.script.bath, gate_of(script)
    room_c, start_c = (emulation.ambient_c, emulation.bath_start_c) if rig.rig.emulated else (max(0.0, rig.rig.bath.room_c),) * 2
    plant = Plant(rig.rig.seed, ambient_c=room_c, start_c=start_c)
    plant.pump = "on"
    plant.run(bath.set_point_c)
    t_s = 0.0
    while gate.add(t_s, plant.pv_c, raw=t_s) is not State.STABLE and t_s < bath.timeout_s:
        t_s += 1.0
        plant.advance_to(t_s)
    return t_s


def touched_trials(rig: LoadedRig, script: LoadedScript) -> list[int]:
    """At which of the planned trials (from 0) teat ends are touched, once for each time: all, or those that a stage doesn't carry."""
    truth, stage = script.script.truth, rig.rig.stage
    if truth.mode == "carry" and stage:
        return carry_touches(script.planned, stage.axes, truth.check_every)
    return list(range(len(script.planned)))


def assumed_told() -> str:
    """What was assumed, as a sentence."""
    return "Assumed: " + ", ".join(f"{what} {value:g} {UNITS.get(what, 's')}" for what, value in ASSUMED.items()) + "."


def _moves_s(stage: Stage, planned: tuple[PlannedTrial, ...], figures: Mapping[str, float]) -> float:
    places = [stage.machine(shared(pose, stage.axes)[0]) for one in planned for pose in (one.approach, one.pose) if pose is not None]
    ways = [math.dist(tuple(a.values()), tuple(b.values())) for a, b in pairwise(places)]
    return figures["homing"] + sum(move_s(way, stage.feed_mm_per_min, figures["acceleration"]) for way in ways)


def move_s(way_mm: float, feed_mm_per_min: float, accel_mm_s2: float) -> float:
    """Seconds of a move from stand to stand: a trapezoid of speed, or a triangle where the way is short."""
    speed = feed_mm_per_min / 60.0
    if way_mm * accel_mm_s2 <= speed**2:
        return 2.0 * math.sqrt(way_mm / accel_mm_s2)
    return way_mm / speed + speed / accel_mm_s2


def _set_ups_s(axes: str, planned: tuple[PlannedTrial, ...], figures: Mapping[str, float]) -> Iterator[float]:
    """What a person does between trials: a new scene, or the plate to another place."""
    before = None
    for one in planned:
        asked = one.arrangement(axes)
        scene = (asked.phantom, asked.objects, asked.scene)
        if before is None or scene != before[0]:
            yield figures["set-up"]
        elif asked.pose != before[1]:
            yield figures["placing"]
        before = (scene, asked.pose)
