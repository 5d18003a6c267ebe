"""From a script's trial tables to the trials of a run, one by one: pure, the same script gives the
same trials and names.

Poses are numbered as they are written, whatever order they are visited in, so that a name means one
pose. All chance comes from the script's own seed, never from the run's: the poses are fixed before
anything is run.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.script.phantom import Layout
from bench.script.trial_table import PoseTable, Side, Trial
from instruments.operators.operator import Arrangement
from instruments.world.phantom import Phantom, PlatePose
from instruments.world.situations import Situation, situation

SIDES: Mapping[Side, tuple[float, float]] = {
    "+x": (1.0, 0.0),
    "-x": (-1.0, 0.0),
    "+y": (0.0, 1.0),
    "-y": (0.0, -1.0),
}

POSE_KEYS = ("id", "pose", "repeat", "x_mm", "y_mm", "z_mm", "yaw_deg", "from")


@dataclass(frozen=True, slots=True)
class PlannedTrial:
    """One frame set to come: the ``number``-th of the run (from 1), the ``repeat``-th at its pose
    (from 1).

    ``name`` is the pose's: repeats of one pose share it. ``phantom`` stands at its reference place;
    ``side`` is where the pose is reached from, None for straight from the one before.
    """

    number: int
    name: str
    repeat: int
    trial: Trial
    phantom: Phantom
    pose: PlatePose
    side: Side | None = None
    scene: Situation | None = None

    @property
    def id(self) -> str:
        """Unique in the run."""
        return f"{self.number:03d}-{self.name}-{self.repeat}"

    @property
    def situation(self) -> str:
        """The kind of scene."""
        return self.trial.situation

    @property
    def yaw_deg(self) -> float:
        """The turn of the plate."""
        return float(np.degrees(self.pose.yaw_rad))

    @property
    def approach(self) -> PlatePose | None:
        """Where the plate goes first, so as to reach its pose from the side asked for."""
        if self.side is None:
            return None
        dx, dy = SIDES[self.side]
        return replace(
            self.pose,
            x_mm=self.pose.x_mm + dx * self.trial.approach_mm,
            y_mm=self.pose.y_mm + dy * self.trial.approach_mm,
        )

    def arrangement(self, axes: Collection[str]) -> Arrangement:
        """What the operator is asked to set up: the scene, and of the pose what the stage's
        ``axes`` (of "XYZA") don't do.
        """
        _, pose = shared(self.pose, axes)
        _, first = shared(self.approach or self.pose, axes)
        asked = [self.trial.set_up or (self.scene.about if self.scene else "")]
        if self.trial.redraw or self.scene:
            asked.append(described(self.phantom))
        if self.scene and self.scene.objects:
            asked.append(surrounded(self.scene))
        if first != pose:
            asked.append(
                f"Move the plate to {told(first)} first, so that it comes from the {self.side}"
                " side."
            )
        if first != pose or pose != PlatePose() or "X" not in axes:
            asked.append(f"Move the plate to {told(pose)} from its reference place.")
        objects, said = self.trial.objects, " ".join(asked)
        return Arrangement(self.situation, self.phantom, objects, said, pose, scene=self.scene)


def shared(pose: PlatePose, axes: Collection[str]) -> tuple[PlatePose, PlatePose]:
    """Which part of ``pose`` the stage's ``axes`` (of "XYZA") do, and which the operator: together
    they are the pose.
    """
    parts = {"X": "x_mm", "Y": "y_mm", "Z": "z_mm", "A": "yaw_rad"}
    by_hand = {part: 0.0 for axis, part in parts.items() if axis in axes}
    by_stage = {part: 0.0 for axis, part in parts.items() if axis not in axes}
    return replace(pose, **by_stage), replace(pose, **by_hand)


def plan(
    trials: Sequence[Trial],
    layouts: Mapping[str, Layout],
    *,
    repeats: int,
    seed: int,
    shuffled: bool,
) -> tuple[PlannedTrial, ...]:
    """All trials of a run in its order. ``repeats`` is for trials that don't say their own."""
    planned = [
        one
        for trial in trials
        for one in _expanded(trial, layouts.get(trial.layout), trial.repeats or repeats, seed)
    ]
    if shuffled:
        order = np.random.default_rng([seed, *b"order"]).permutation(len(planned))
        planned = [planned[index] for index in order]
    return tuple(replace(one, number=number) for number, one in enumerate(planned, 1))


def _expanded(
    trial: Trial, layout: Layout | None, repeats: int, seed: int
) -> Iterator[PlannedTrial]:
    poses, visited = _poses(trial, seed)
    names, digits = [trial.name], len(str(len(poses)))
    if len(poses) > 1:
        names = [f"{trial.name}-{number:0{digits}d}" for number, _ in enumerate(poses, 1)]
    phantoms, scenes = _udders(trial, layout, len(poses), [seed, *trial.name.encode()])
    sides: tuple[Side | None, ...] = trial.approach or (None,)
    for cycle in range(trial.cycles):
        for index in visited:
            for turn, side in enumerate(sides):
                first = (cycle * len(sides) + turn) * repeats + 1
                scene = phantoms[index], poses[index], side, scenes[index]
                for repeat in range(first, first + repeats):
                    yield PlannedTrial(0, names[index], repeat, trial, *scene)


def _udders(
    trial: Trial, layout: Layout | None, count: int, own: Sequence[int]
) -> tuple[list[Phantom], list[Situation | None]]:
    """The phantom of each pose, and the whole scene where it is a family's: the same for all, or
    another for each.
    """
    if layout is None:
        members = [
            situation(trial.family, trial.member + (index if trial.redraw else 0))
            for index in range(count)
        ]
        return [member.phantom for member in members], [*members]
    same = None if trial.redraw else layout.phantom(*own)
    return [same or layout.phantom(*own, index) for index in range(count)], [None] * count


def _poses(trial: Trial, seed: int) -> tuple[list[PlatePose], Sequence[int]]:
    """The poses as they are numbered, and the order in which they are visited."""
    if trial.grid:
        return trial.grid.poses(), trial.grid.visited()
    if trial.draw:
        poses = trial.draw.poses(np.random.default_rng([seed, *trial.name.encode(), *b"poses"]))
    else:
        tables = trial.poses or (trial.pose or PoseTable(),)
        poses = [table.pose for table in tables]
    return poses, range(len(poses))


def told(pose: PlatePose) -> str:
    """``x +10 mm, y -5 mm``, with z and yaw where they aren't zero."""
    parts = [f"x {pose.x_mm:+g} mm", f"y {pose.y_mm:+g} mm"]
    parts += [f"z {pose.z_mm:+g} mm"] if pose.z_mm else []
    parts += [f"yaw {np.degrees(pose.yaw_rad):+g} deg"] if pose.yaw_rad else []
    return ", ".join(parts)


def described(phantom: Phantom) -> str:
    """Each teat's place, length and lean, for who sets them by hand."""
    teats = []
    for number, teat in enumerate(phantom.teats, 1):
        (x, y), (lean_x, lean_y) = teat.base_mm, np.degrees(teat.tilt_rad)
        teats.append(
            f"{teat.name or number}: x {x:.1f}, y {y:.1f}, length {teat.shape.length_mm:.1f} mm"
        )
        if any(teat.tilt_rad):
            teats[-1] += f", leaning {lean_x:+.1f} deg to x and {lean_y:+.1f} deg to y"
    return f"Teats: {'; '.join(teats)}."


def surrounded(scene: Situation) -> str:
    """What else stands in a scene and where, for who puts it there."""
    things = [
        f"{thing.name.replace('_', ' ')} at x {thing.hulls[0].a_mm[0]:.0f}, y"
        f" {thing.hulls[0].a_mm[1]:.0f} mm"
        for thing in scene.objects
    ]
    return f"Around them: {'; '.join(things)}."


def pose_set(
    trials: Sequence[Trial], planned: Sequence[PlannedTrial], *, seed: int, order: str
) -> dict[str, Any]:
    """What the record keeps of the poses: how they were chosen, and each trial with its place, in
    the order of `POSE_KEYS`.
    """
    rows = [
        [one.id, one.name, one.repeat, p.x_mm, p.y_mm, p.z_mm, one.yaw_deg, one.side]
        for one in planned
        for p in [one.pose]
    ]
    return {"chosen": [*map(chosen, trials)], "order": order, "seed": seed, "poses": rows}


def chosen(trial: Trial) -> str:
    """A sentence on how a trial's poses were chosen."""
    if grid := trial.grid:
        (x0, x1), (y0, y1), (dx, dy) = grid.x_mm, grid.y_mm, grid.step_mm
        spans = f"x {x0:g} to {x1:g} mm by {dx:g}, y {y0:g} to {y1:g} mm by {dy:g}"
        how = (
            f"a grid of {grid.columns} x {grid.rows} poses, {spans}, {grid.order} along"
            f" {grid.along}"
        )
    elif draw := trial.draw:
        drawn = {"x": draw.x_mm, "y": draw.y_mm, "z": draw.z_mm, "yaw": draw.yaw_deg}
        within = ", ".join(
            f"{k} {a:g} to {b:g} {'deg' if k == 'yaw' else 'mm'}"
            for k, (a, b) in drawn.items()
            if (a, b) != (0.0, 0.0)
        )
        how = f"{draw.count} poses drawn evenly within {within or 'the reference place alone'}"
    else:
        count = len(trial.poses or (1,))
        how = f"{count} pose{'s' if count > 1 else ''} as written"
    more = [f"layout {trial.layout}{', another udder for each pose' if trial.redraw else ''}"]
    if trial.family:
        many = f"members from {trial.member} on, one for each pose"
        more = [f"family {trial.family}, {many if trial.redraw else f'member {trial.member}'}"]
    more += [f"{trial.cycles} cycles"] if trial.cycles > 1 else []
    if trial.approach:
        sides = ", ".join(trial.approach)
        more.append(f"each reached from {sides} ({trial.approach_mm:g} mm away)")
    return f"{trial.name}: {'; '.join([how, *more])}."
