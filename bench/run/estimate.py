"""How long a script takes and what it needs, by the files alone; what the time of a run went to, by
its events; and what runs really took, kept in their folders, so that the next estimate is better
than what is assumed.

What a rig file doesn't say is assumed, and stated with the figure. A measured figure is a running
mean over the last runs on the same rig, the newest counting most. Time is the bench's own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from shutil import disk_usage
from typing import Any

from bench.config import ConfigError, writing
from bench.files import write_synced
from bench.record.reader import RunRecord
from bench.rig.loading import LoadedRig
from bench.run.events import RunState, read_events
from bench.safety.stability import BathState, StabilityGate
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial, shared
from bench.truth.carrying import fixed_key
from instruments.world.plant import Plant
from textfiles.whole import nearest_there

PREPARING, SETTLING, MOVES = "preparing", "settling", "moves"
SET_UPS, CAPTURES, TOUCHES = "set-ups", "captures", "touches"
WAITING, SAFING = "waiting for instruments", "going to safe"
KINDS = (PREPARING, SETTLING, MOVES, SET_UPS, CAPTURES, TOUCHES, WAITING, SAFING)
STATES = {
    RunState.PREPARING: PREPARING,
    RunState.SETTLING: SETTLING,
    RunState.PAUSED: WAITING,
    RunState.SAFING: SAFING,
}


def spent_of(
    events: Sequence[Mapping[str, Any]], *, first_settling: bool = False
) -> dict[str, float]:
    """Seconds of a run by kind, by its events; ``first_settling``: until its first one is over."""
    spent = dict.fromkeys(KINDS, 0.0)
    base = kind = before = PREPARING
    since_s, asked = 0.0, ""
    for event in events:
        t_s = since_s if event["t_s"] is None else float(event["t_s"])
        spent[kind] += t_s - since_s
        since_s = t_s
        work = MOVES  # what the bench does next, unless it prepares, settles, waits
        match event["what"], event.get("kind"):
            case "event", "run state":
                state = event["text"]
                if state in STATES:
                    before, kind = kind, STATES[state]
                    base = kind
                elif state == RunState.RUNNING:
                    if kind == SETTLING and first_settling:
                        break
                    # what was under way goes on
                    kind = before if before in (CAPTURES, TOUCHES) else MOVES
                    base = MOVES
                continue
            case "asked", "touch" | "check point":
                kind, asked = TOUCHES, "touch"
                continue
            case "asked", "set up":
                kind, asked = SET_UPS, "set up"
                continue
            case "asked", "" if asked == "set up":
                work, asked = CAPTURES, ""
            case ("trial", _) | ("asked", "release"):
                asked = ""
            case _:
                continue
        kind = work if base == MOVES else base
    return spent


ASSUMED = {
    "start": 20.0,  # s: instruments are opened and asked, the bath begins to heat
    "heating": 0.5,  # K/min: a bath of 20 L, with 1 kW, and its losses
    "acceleration": 200.0,  # mm/s^2: what stages of this kind are set to
    "homing": 60.0,  # s
    "set-up": 60.0,  # s: a person changes the scene
    "placing": 30.0,  # s: a person moves the plate
    "touch": 8.0,  # s: a person finds the apex and holds still
    "capture": 1.0,  # s: a frame set
    "detecting": 2.0,  # s a trial: with its record and a sign of life of the bath's sensor
}
READING_S = 0.07  # of an emulated arm, whose hand needs no time to find the apex
UNITS = {"heating": "K/min", "acceleration": "mm/s^2"}


@dataclass(frozen=True, slots=True)
class TimeEstimate:
    """Seconds by what they are spent on."""

    preparing_s: float
    settling_s: float
    moves_s: float
    set_ups_s: float
    captures_s: float
    touches_s: float
    detecting_s: float

    @property
    def total_s(self) -> float:
        return float(sum(asdict(self).values()))

    def each_s(self, trials: int) -> float:
        """One of so many trials, without what is before the first."""
        return (self.total_s - self.preparing_s - self.settling_s) / trials


def estimate(
    rig: LoadedRig, script: LoadedScript, figures: Mapping[str, float] = ASSUMED
) -> TimeEstimate:
    """How long ``script`` takes on ``rig``, in the bench's own time, by ``figures``."""
    r, planned, gate = rig.rig, script.planned, script.script.bath
    rise_k = max(0.0, gate.set_point_c - r.bath.room_c)
    moves_s = figures["homing"] if r.stage else 0.0
    if stage := r.stage:
        poses = [pose for one in planned for pose in (one.approach, one.pose) if pose is not None]
        places = [tuple(stage.machine(shared(pose, stage.axes)[0]).values()) for pose in poses]
        feed, accel = stage.feed_mm_per_min, figures["acceleration"]
        moves_s += sum(move_s(math.dist(a, b), feed, accel) for a, b in pairwise(places))
    return TimeEstimate(
        # with the arm's homing
        preparing_s=figures["start"] + (1 + _arm_checks(rig)) * figures["touch"],
        settling_s=gate.window_s + 60.0 * rise_k / figures["heating"],
        moves_s=moves_s,
        set_ups_s=sum(_set_ups_s(r.stage.axes if r.stage else "", planned, figures)),
        captures_s=len(planned) * (r.cameras.settle_s + figures["capture"]),
        touches_s=sum(_touches(rig, script)) * figures["touch"],
        detecting_s=len(planned) * figures["detecting"],
    )


def _arm_checks(rig: LoadedRig) -> int:
    """Touches of the check point: before the trials, and one after, where nothing has moved."""
    return rig.rig.arm.check_touches + 1 if rig.rig.arm.check_point_mm else 0


def gate_of(script: LoadedScript) -> StabilityGate:
    return StabilityGate(**script.script.bath.model_dump(exclude={"timeout_s"}))


def settling_of(rig: LoadedRig, script: LoadedScript) -> float:
    """How long the emulated bath takes until the gate opens; at most what the script allows."""
    emulation, bath, gate = rig.rig.emulation, script.script.bath, gate_of(script)
    room_c = start_c = max(0.0, rig.rig.bath.room_c)
    if "bath" in rig.rig.emulated:
        room_c, start_c = emulation.ambient_c, emulation.bath_start_c
    plant = Plant(rig.rig.seed, ambient_c=room_c, start_c=start_c)
    plant.pump = "on"
    plant.run(bath.set_point_c)
    t_s = 0.0
    while gate.add(t_s, plant.pv_c, raw=t_s) is not BathState.STABLE and t_s < bath.timeout_s:
        t_s += 1.0
        plant.advance_to(t_s)
    return t_s


def _touches(rig: LoadedRig, script: LoadedScript) -> list[int]:
    """How many, at each trial at which teat ends are touched: all, or those not carried."""
    truth, stage, planned = script.script.truth, rig.rig.stage, script.planned
    at: Sequence[int] = range(len(planned))
    if truth.mode == "carry" and stage:
        at = carry_touches(planned, stage.axes, truth.check_every)
    each = truth.readings or rig.rig.arm.touches
    return [each * len(planned[index].phantom.teats) for index in at]


def move_s(way_mm: float, feed_mm_per_min: float, accel_mm_s2: float) -> float:
    """Seconds of a move from rest to rest: a trapezoid of speed, a triangle for a short way."""
    speed = feed_mm_per_min / 60.0
    if way_mm * accel_mm_s2 <= speed**2:
        return 2.0 * math.sqrt(way_mm / accel_mm_s2)
    return way_mm / speed + speed / accel_mm_s2


def _set_ups_s(
    axes: str, planned: Sequence[PlannedTrial], figures: Mapping[str, float]
) -> Iterator[float]:
    """Seconds of a person's work before trials: a new scene, or the plate at another place."""
    before = None
    for one in planned:
        asked = one.arrangement(axes)
        scene = (asked.phantom, asked.objects, asked.scene)
        if before is None or scene != before[0]:
            yield figures["set-up"]
        elif asked.pose != before[1]:
            yield figures["placing"]
        before = (scene, asked.pose)


FILE = "times.json"  # in a run's folder
LOOKS_BACK = 8  # runs
KEEPS = 0.5  # of what was known before, against one further run
LEAST_RISE_K = 1.0  # less says nothing of how fast a bath heats


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run needs: time, disk space at most, and how often a person is asked for what."""

    time: TimeEstimate
    disk_mb: float
    asked: Mapping[str, int]

    @property
    def prompts(self) -> int:
        return sum(self.asked.values())


def needs(
    rig: LoadedRig, script: LoadedScript, measured: Mapping[str, float] | None = None
) -> Forecast:
    """From what was ``measured`` on the rig, else from what is assumed (emulated parts: none)."""
    measured, emulated = measured or {}, rig.rig.simulated
    figures = {**ASSUMED}
    if emulated:
        figures |= {"homing": 0.0, "capture": 0.0}
    if not rig.rig.by_person:
        prompt_s = rig.rig.emulation.prompt_s if emulated else 0.0
        figures |= {"set-up": prompt_s, "placing": prompt_s, "touch": prompt_s + READING_S}
    figures |= measured
    time = estimate(rig, script, figures)
    if emulated or "heating" not in measured:
        time = replace(time, settling_s=settling_of(rig, script))
    arm, touches = rig.rig.arm, _touches(rig, script)
    readings = script.script.truth.readings or arm.touches
    of_ends = f"teat ends ({readings} {'touch' if readings == 1 else 'touches'} each)"
    ends = sum(touches) // readings
    asked = {"homing": 1, "arm check": _arm_checks(rig), "set-ups": len(touches), of_ends: ends}
    return Forecast(time, disk_mb(rig, len(script.planned)), asked)


def disk_mb(rig: LoadedRig, trials: int) -> float:
    """At most: pictures uncompressed, and as much again for pictures of detectors' stages."""
    c = rig.calibration
    one = sum(w * h for w, h in (c.left.image_size, c.right.image_size, c.thermal.image_size))
    return 2.0 * trials * (one + 2 * math.prod(c.thermal.sensor_size)) / 1e6


def no_room(wanted_mb: float, folder: Path) -> str:
    """What is said where ``wanted_mb`` are not free at ``folder``, which need not be there yet.
    Raises ConfigError where it can't be.
    """
    there = _there(folder)
    if (free_mb := disk_usage(there).free / 1e6) >= wanted_mb:
        return ""
    free = f"{free_mb:.0f} MB are free in {there}"
    return f"NOT ENOUGH ROOM: {free}, and up to {wanted_mb:.0f} MB are needed. Make room."


def refuse_no_room(rig: LoadedRig, trials: int, folder: Path, record: Path | None = None) -> None:
    """Raises ConfigError where so many trials may not fit in ``folder``, and their frames once more
    in ``record``.
    """
    run_mb = disk_mb(rig, trials)
    wanted = {folder: run_mb}
    if record:  # it has no pictures of detectors' stages
        one_disk = _disk(record) == _disk(folder)
        wanted |= {folder: 1.5 * run_mb} if one_disk else {record: 0.5 * run_mb}
    for place, wanted_mb in wanted.items():
        if room := no_room(wanted_mb, place):
            raise ConfigError.plain(room)


def _there(folder: Path) -> Path:
    with writing(folder):
        return nearest_there(folder)


def _disk(folder: Path) -> int:
    return _there(folder).stat().st_dev


def took(run: RunRecord) -> dict[str, float]:
    """The seconds that a run took: settling at first, set-ups, a touch, all; as far as known."""
    found: dict[str, float] = {}
    times = [float(event["t_s"]) for event in run.events if event["t_s"] is not None]
    if times and run.events[-1]["t_s"] is not None:
        found["total_s"] = times[-1] - times[0]  # a rig that was warm has been open for longer
    with suppress(OSError, ValueError):
        events = list(read_events(run.folder))
        spent, first = spent_of(events), spent_of(events, first_settling=True)
        touches = sum(event.get("kind") in ("touch", "check point") for event in events)
        each = {"settling_s": first[SETTLING], "set_ups_s": spent[SET_UPS]}
        each |= {"preparing_s": spent[PREPARING], "moves_s": spent[MOVES]}
        found |= {name: seconds for name, seconds in each.items() if seconds}
        if touches:
            found["touch_s"] = spent[TOUCHES] / touches
    return found


def figures(
    run: RunRecord, rig: LoadedRig, script: LoadedScript, spent: Mapping[str, float]
) -> dict[str, float]:
    """What ``spent`` says of the figures that estimates assume, by their names."""
    measured: dict[str, float] = {}
    gate = script.script.bath
    rise_k = gate.set_point_c - float(run.bath[0, 1]) if len(run.bath) else 0.0
    heating_s = spent.get("settling_s", 0.0) - gate.window_s
    if rise_k >= LEAST_RISE_K and heating_s > 0.0:
        measured["heating"] = 60.0 * rise_k / heating_s
    if "touch_s" in spent:
        measured["touch"] = spent["touch_s"]
    assumed = estimate(rig, script)
    if "preparing_s" in spent:
        measured["start"] = spent["preparing_s"]
    if "moves_s" in spent:  # and what can't be separated from them
        others_s = spent["moves_s"] - assumed.moves_s + (ASSUMED["homing"] if rig.rig.stage else 0)
        measured["detecting"] = max(0.0, others_s) / len(script.planned)
    assumed_s = assumed.set_ups_s
    if "set_ups_s" in spent and assumed_s > 0.0:
        # both in the proportion that is assumed of them
        share = spent["set_ups_s"] / assumed_s
        measured |= {name: ASSUMED[name] * share for name in ("set-up", "placing")}
    return measured


def read_durations(folder: Path, rig: LoadedRig) -> dict[str, float]:
    """The figures measured of ``rig`` from the last runs in ``folder``; the newest counts half."""
    last: list[dict[str, float]] = []
    for path in sorted(folder.glob(f"*/{FILE}"), reverse=True):
        # another rig's run, or a file that can't be read: an estimate does without it
        with suppress(OSError, ValueError, KeyError, TypeError):
            kept = json.loads(path.read_text(encoding="utf-8"))
            known = {k: float(v) for k, v in kept["figures"].items() if k in ASSUMED}
            last += [known] if kept["rig"] == _name(rig) else []
        if len(last) == LOOKS_BACK:
            break
    mean: dict[str, float] = {}
    for known in reversed(last):
        for name, value in known.items():
            mean[name] = KEEPS * mean.get(name, value) + (1.0 - KEEPS) * value
    return mean


def write_durations(
    run: Path,
    rig: LoadedRig,
    expected: TimeEstimate,
    spent: Mapping[str, float],
    new: Mapping[str, float],
) -> None:
    """Keep what was expected, what it took, and what follows. Raises OSError."""
    expected_s = {**asdict(expected), "total_s": expected.total_s}
    known = {"rig": _name(rig), "expected_s": expected_s, "took": {**spent}, "figures": {**new}}
    write_synced(run / FILE, json.dumps(known, indent=1).encode())


def estimate_text(expected: TimeEstimate, spent: Mapping[str, float]) -> str:
    """``It took 20 min of the bench's time; 38 min had been expected.``"""
    both_s = spent["total_s"], expected.total_s
    took, wanted = (f"{s / 60:.0f} min" if s >= 30.0 else "less than a minute" for s in both_s)
    return f"It took {took} of the bench's time; {wanted} had been expected."


def _name(rig: LoadedRig) -> str:
    """The rig with its operator: an emulated one and a person take different times."""
    return f"{rig.rig.name}, operator {rig.rig.operator.url}"


def carry_touches(planned: Sequence[PlannedTrial], axes: str, check_every: int) -> list[int]:
    """Trials at which a carried truth is touched: first of an arrangement, last before a check."""
    at: list[int] = []
    standing, carried = None, 0
    for index, one in enumerate(planned):
        fixed = fixed_key(one.phantom, shared(one.pose, axes)[1], one.pose.yaw_rad)
        if carried and (fixed != standing or 0 < check_every <= carried):
            at.append(index - 1)
            carried = 0
        if fixed == standing:
            carried += 1
        else:
            at.append(index)
            standing, carried = fixed, 0
    return [*at, len(planned) - 1] if carried else at
