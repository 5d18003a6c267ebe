"""A script's `[[trials]]` as a person writes them, and the trials of a run that they expand to:
pure, the same script gives the same trials and names.

Poses are numbered as they are written, whatever order they are visited in, so that a name means one
pose. All chance comes from the script's own seed, never from the run's.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.config import FileTable, did_you_mean
from bench.script.phantom import Layout, find_layout, load_layout, ordered
from instruments.operators.operator import Arrangement
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom, PlatePose
from instruments.world.setups import Situation
from instruments.world.situations import SITUATIONS, situation
from textfiles.text import plural, range_text

MOST_POSES = 100_000
RUN_FILES = ("rig.toml", "script.toml", "calibration.toml")  # a run's folder has these already
STEP_SLACK = 1e-6  # of a step: what a range may miss a whole number of steps by

Side = Literal["+x", "-x", "+y", "-y"]
Shift = Annotated[float, Field(ge=-2000, le=2000)]
Lift = Annotated[float, Field(ge=0, le=500)]
Yaw = Annotated[float, Field(ge=-360, le=360)]
Step = Annotated[float, Field(gt=0, le=2000)]
Count = Annotated[int, Field(ge=1, le=1000)]


def layout_of(name: str, info: ValidationInfo) -> str:
    """A layout's ``name``. Raises ValueError, and ConfigError for faults in its file."""
    if Path(name).name != name or name in RUN_FILES:
        raise ValueError(
            "a layout is a shipped one's name, or the name of a file of its own in the script's"
            " folder"
        )
    load_layout(find_layout(name, (info.context or {}).get("folder")))
    return name


LayoutName = Annotated[str, AfterValidator(layout_of)]


class PoseTable(FileTable):
    """The plate from its reference place: shifted, and turned about the turntable's axis."""

    x_mm: Shift = 0.0
    y_mm: Shift = 0.0
    z_mm: Lift = 0.0
    yaw_deg: Yaw = 0.0

    @property
    def pose(self) -> PlatePose:
        return PlatePose(self.x_mm, self.y_mm, self.z_mm, float(np.radians(self.yaw_deg)))


class Grid(FileTable):
    """Every x with every y, numbered by rows along x from the least y up. Visited by rows ``along``
    x or y; ``serpentine`` goes every other row backwards.
    """

    x_mm: tuple[Shift, Shift]
    y_mm: tuple[Shift, Shift]
    step_mm: tuple[Step, Step]
    z_mm: Lift = 0.0
    yaw_deg: Yaw = 0.0
    order: Literal["serpentine", "rows"] = "serpentine"
    along: Literal["x", "y"] = "x"

    _spans = field_validator("x_mm", "y_mm")(ordered)

    @model_validator(mode="after")
    def _whole_steps(self) -> Grid:
        for axis, span, step in zip("xy", (self.x_mm, self.y_mm), self.step_mm, strict=True):
            steps = (span[1] - span[0]) / step
            if abs(steps - round(steps)) > STEP_SLACK:
                raise ValueError(
                    f"{axis}_mm spans {span[1] - span[0]:g} mm, which is no whole number of steps"
                    f" of {step:g} mm"
                )
        if (count := self.columns * self.rows) > MOST_POSES:
            raise ValueError(f"the grid has {count} poses; at most {MOST_POSES}")
        return self

    @property
    def columns(self) -> int:
        return round((self.x_mm[1] - self.x_mm[0]) / self.step_mm[0]) + 1

    @property
    def rows(self) -> int:
        return round((self.y_mm[1] - self.y_mm[0]) / self.step_mm[1]) + 1

    def poses(self) -> list[PlatePose]:
        """Row by row, each from the least x: the order by which poses are numbered."""
        x = np.linspace(*self.x_mm, self.columns).tolist()
        yaw = float(np.radians(self.yaw_deg))
        return [
            PlatePose(at, y, self.z_mm, yaw)
            for y in np.linspace(*self.y_mm, self.rows).tolist()
            for at in x
        ]

    def visited(self) -> list[int]:
        """In which order the poses are visited: indices into `poses`."""
        rows = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        rows = rows.T.copy() if self.along == "y" else rows
        if self.order == "serpentine":
            rows[1::2] = rows[1::2, ::-1].copy()
        return list(rows.ravel().tolist())


class DrawnPoses(FileTable):
    """``count`` poses drawn evenly within these spans, by the seed and the trial's name."""

    count: Annotated[int, Field(ge=1, le=MOST_POSES)]
    x_mm: tuple[Shift, Shift] = (0.0, 0.0)
    y_mm: tuple[Shift, Shift] = (0.0, 0.0)
    z_mm: tuple[Lift, Lift] = (0.0, 0.0)
    yaw_deg: tuple[Yaw, Yaw] = (0.0, 0.0)

    _spans = field_validator("x_mm", "y_mm", "z_mm", "yaw_deg")(ordered)

    def poses(self, rng: np.random.Generator) -> list[PlatePose]:
        low, high = np.array([self.x_mm, self.y_mm, self.z_mm, self.yaw_deg]).T
        drawn = rng.uniform(low, high, (self.count, 4))
        return [PlatePose(x, y, z, float(np.radians(yaw))) for x, y, z, yaw in drawn.tolist()]


class PublishedRate(FileTable):
    """What the thesis's own detector found in this situation, to print beside ours."""

    found: Annotated[int, Field(ge=0)]
    present: Annotated[int, Field(ge=1)]
    source: str = ""


class Trial(FileTable):
    """A phantom, its poses, and what else is in the scene. ``repeats``: frame sets at a pose;
    ``cycles``: times through all poses; ``approach``: sides to reach a pose from; ``redraw``:
    another udder, or member of the ``family``, for each pose.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    situation: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_]*$")]
    layout: LayoutName = ""
    family: str = ""
    member: Annotated[int, Field(ge=0)] = 0
    set_up: str = ""
    pose: PoseTable | None = None
    poses: Annotated[tuple[PoseTable, ...], Field(min_length=1)] | None = None
    grid: Grid | None = None
    draw: DrawnPoses | None = None
    approach: tuple[Side, ...] = ()
    approach_mm: Annotated[float, Field(gt=0, le=200)] = 10.0
    redraw: bool = False
    objects: tuple[dict[str, Any], ...] = ()
    repeats: Count | None = None
    cycles: Count = 1
    published: PublishedRate | None = None

    @field_validator("objects")
    @classmethod
    def _objects(cls, tables: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
        for number, table in enumerate(tables, 1):
            try:
                make_object(**table)
            except (ValueError, TypeError) as error:
                raise ValueError(f"object {number}: {error}") from error
        return tables

    @field_validator("family")
    @classmethod
    def _family(cls, name: str) -> str:
        if name and name not in SITUATIONS:
            raise ValueError(
                f"no such family{did_you_mean(name, list(SITUATIONS))} (there are:"
                f" {', '.join(SITUATIONS)})"
            )
        return name

    @model_validator(mode="after")
    def _one_of_each(self) -> Trial:
        if bool(self.layout) == bool(self.family):
            raise ValueError(
                "has both layout and family; a trial has one of them"
                if self.layout
                else "has no layout, and no family either"
            )
        if self.layout and not self.set_up:
            raise ValueError("set_up is missing: it says what a person has to do")
        given = [key for key in ("pose", "poses", "grid", "draw") if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(
                f"has {' and '.join(given)}; a trial has one of pose, poses, grid and draw, or none"
                " for the reference place"
            )
        if len(set(self.approach)) < len(self.approach):
            raise ValueError("approach names a side twice")
        return self


SIDES: Mapping[Side, tuple[float, float]] = {
    "+x": (1.0, 0.0),
    "-x": (-1.0, 0.0),
    "+y": (0.0, 1.0),
    "-y": (0.0, -1.0),
}

POSE_KEYS = ("id", "pose", "repeat", "x_mm", "y_mm", "z_mm", "yaw_deg", "from")


@dataclass(frozen=True, slots=True)
class PlannedTrial:
    """One frame set to come: the ``number``-th of the run, the ``repeat``-th of the pose ``name``.
    ``phantom`` is at its reference place; ``side``: where the pose is reached from.
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
        return f"{self.number:03d}-{self.name}-{self.repeat}"

    @property
    def situation(self) -> str:
        return self.trial.situation

    @property
    def yaw_deg(self) -> float:
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
        """What the operator sets up: the scene, and what the stage's ``axes`` don't do."""
        _, pose = shared(self.pose, axes)
        _, first = shared(self.approach or self.pose, axes)
        asked = [self.trial.set_up or (self.scene.about if self.scene else "")]
        if first != pose:
            asked.append(
                f"Move the plate to {pose_text(first)} first, so that it comes from the {self.side}"
                " side."
            )
        if first != pose or pose != PlatePose() or "X" not in axes:
            asked.append(f"Move the plate to {pose_text(pose)} from its reference place.")
        objects, said = self.trial.objects, " ".join(asked)
        things = self.scene.objects if self.scene else tuple(make_object(**one) for one in objects)
        details = [described(self.phantom), *([surrounded(things)] if things else [])]
        return Arrangement(
            self.situation,
            self.phantom,
            objects,
            said,
            pose,
            scene=self.scene,
            details="\n".join(details),
        )


def shared(pose: PlatePose, axes: Collection[str]) -> tuple[PlatePose, PlatePose]:
    """Which part of ``pose`` the stage's ``axes`` (of "XYZA") do, and which the operator."""
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
    scenes: list[tuple[Phantom, Situation | None]]
    if layout is None:
        members = [trial.member + (at if trial.redraw else 0) for at in range(len(poses))]
        scenes = [(one.phantom, one) for one in (situation(trial.family, m) for m in members)]
    else:
        own = [seed, *trial.name.encode()]
        same = None if trial.redraw else layout.phantom(*own)
        scenes = [(same or layout.phantom(*own, at), None) for at in range(len(poses))]
    sides: tuple[Side | None, ...] = trial.approach or (None,)
    for cycle in range(trial.cycles):
        for index in visited:
            for turn, side in enumerate(sides):
                first = (cycle * len(sides) + turn) * repeats + 1
                phantom, scene = scenes[index]
                shown = phantom, poses[index], side, scene
                for repeat in range(first, first + repeats):
                    yield PlannedTrial(0, names[index], repeat, trial, *shown)


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


def pose_text(pose: PlatePose) -> str:
    """``x +10 mm, y -5 mm``, with z and yaw where they aren't zero."""
    parts = [f"x {pose.x_mm:+g} mm", f"y {pose.y_mm:+g} mm"]
    parts += [f"z {pose.z_mm:+g} mm"] if pose.z_mm else []
    parts += [f"yaw {np.degrees(pose.yaw_rad):+g} deg"] if pose.yaw_rad else []
    return ", ".join(parts)


def described(phantom: Phantom) -> str:
    """Each teat's place on the plate, length and lean, for who sets them by hand."""
    teats = []
    for name, teat in zip(phantom.called, phantom.teats, strict=True):
        (x, y), (lean_x, lean_y) = teat.base_mm, np.degrees(teat.tilt_rad)
        teats.append(f"{name}: x {x:.1f}, y {y:.1f}, length {teat.shape.length_mm:.1f} mm")
        if any(teat.tilt_rad):
            teats[-1] += f", leaning {lean_x:+.1f} deg to x and {lean_y:+.1f} deg to y"
    return "\n".join(["On the plate, before it is moved:", *(f"  {teat}" for teat in teats)])


def surrounded(things: Sequence[SceneObject]) -> str:
    """What else stands in a scene and where, for who puts it there."""
    pose_text = [
        f"  {thing.name.replace('_', ' ')} at x {thing.hulls[0].a_mm[0]:.0f}, y"
        f" {thing.hulls[0].a_mm[1]:.0f} mm"
        for thing in things
    ]
    return "\n".join(["On the table:", *pose_text])


def pose_set(
    trials: Sequence[Trial], planned: Sequence[PlannedTrial], *, seed: int, order: str
) -> dict[str, Any]:
    """For the record: how poses were chosen, and each trial's, in the order of `POSE_KEYS`."""
    rows = [
        [one.id, one.name, one.repeat, p.x_mm, p.y_mm, p.z_mm, one.yaw_deg, one.side]
        for one in planned
        for p in [one.pose]
    ]
    return {"chosen": [*map(chosen, trials)], "order": order, "seed": seed, "poses": rows}


def chosen(trial: Trial) -> str:
    """A sentence on how a trial's poses were chosen."""
    if grid := trial.grid:
        x, y, dx, dy = *(range_text(*s, "g") for s in (grid.x_mm, grid.y_mm)), *grid.step_mm
        spans = f"x {x} mm by {dx:g}, y {y} mm by {dy:g}"
        how = (
            f"a grid of {grid.columns} x {grid.rows} poses, {spans}, {grid.order} along"
            f" {grid.along}"
        )
    elif draw := trial.draw:
        drawn = {"x": draw.x_mm, "y": draw.y_mm, "z": draw.z_mm, "yaw": draw.yaw_deg}
        within = ", ".join(
            f"{k} {range_text(a, b, 'g')} {'deg' if k == 'yaw' else 'mm'}"
            for k, (a, b) in drawn.items()
            if (a, b) != (0.0, 0.0)
        )
        how = plural(draw.count, "pose")
        how += f" drawn evenly within {within}" if within else " at the reference place"
    else:
        how = f"{plural(len(trial.poses or (1,)), 'pose')} as written"
    more = [f"layout {trial.layout}{', another udder for each pose' if trial.redraw else ''}"]
    if trial.family:
        many = f"members from {trial.member} on, one for each pose"
        more = [f"family {trial.family}, {many if trial.redraw else f'member {trial.member}'}"]
    more += [f"{trial.cycles} cycles"] if trial.cycles > 1 else []
    if trial.approach:
        sides = ", ".join(trial.approach)
        more.append(f"each reached from {sides} ({trial.approach_mm:g} mm away)")
    return f"{trial.name}: {'; '.join([how, *more])}."
