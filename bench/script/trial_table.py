"""A script's `[[trials]]`: which poses of which phantom, and what else is in the scene, as a person
writes them.

A table names one pose, a list, a grid or a draw, and how often and from which sides each pose is
reached. It says what is wanted; what that comes to, trial by trial, is `script.planned_trials`'s
business. May not open an instrument.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from bench.config import Section, did_you_mean
from bench.script.phantom import find_layout, load_layout, ordered
from instruments.world.objects import make_object
from instruments.world.phantom import PlatePose
from instruments.world.situations import SITUATIONS

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
    """``name`` where it is a layout that can be read. Raises ValueError, and ConfigError for faults
    in its file.
    """
    if Path(name).name != name or name in RUN_FILES:
        raise ValueError(
            "a layout is a shipped one's name, or the name of a file of its own in the script's"
            " folder"
        )
    load_layout(find_layout(name, (info.context or {}).get("folder")))
    return name


class PoseTable(Section):
    """Where the plate stands, from its reference place: shifted, and turned about the turntable's
    axis.
    """

    x_mm: Shift = 0.0
    y_mm: Shift = 0.0
    z_mm: Lift = 0.0
    yaw_deg: Yaw = 0.0

    @property
    def pose(self) -> PlatePose:
        """As the plate takes it."""
        return PlatePose(self.x_mm, self.y_mm, self.z_mm, float(np.radians(self.yaw_deg)))


class Grid(Section):
    """Every x with every y. Poses are numbered by rows along x, from the least y up, whatever way
    they are visited.

    They are visited by rows ``along`` x or y; ``serpentine`` goes every other row backwards, so
    that no move is long.
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
        """Poses in a row."""
        return round((self.x_mm[1] - self.x_mm[0]) / self.step_mm[0]) + 1

    @property
    def rows(self) -> int:
        """Rows."""
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


class Draw(Section):
    """``count`` poses drawn evenly within these spans, by the seed and the trial's name."""

    count: Annotated[int, Field(ge=1, le=MOST_POSES)]
    x_mm: tuple[Shift, Shift] = (0.0, 0.0)
    y_mm: tuple[Shift, Shift] = (0.0, 0.0)
    z_mm: tuple[Lift, Lift] = (0.0, 0.0)
    yaw_deg: tuple[Yaw, Yaw] = (0.0, 0.0)

    _spans = field_validator("x_mm", "y_mm", "z_mm", "yaw_deg")(ordered)

    def poses(self, rng: np.random.Generator) -> list[PlatePose]:
        """The poses in the order of drawing."""
        low, high = np.array([self.x_mm, self.y_mm, self.z_mm, self.yaw_deg]).T
        drawn = rng.uniform(low, high, (self.count, 4))
        return [PlatePose(x, y, z, float(np.radians(yaw))) for x, y, z, yaw in drawn.tolist()]


class Published(Section):
    """What the thesis's own detector found in this situation, to print beside ours."""

    found: Annotated[int, Field(ge=0)]
    present: Annotated[int, Field(ge=1)]
    source: str = ""


class Trial(Section):
    """A phantom, its poses, and what else is in the scene. ``set_up`` tells a person what to do.

    ``repeats`` takes that many frame sets at a pose before the next; ``cycles`` goes through all
    poses that many times. ``approach`` reaches each pose from these sides, from ``approach_mm``
    away. ``redraw``: another udder for each pose. Instead of a layout a trial may show a ``family``
    of situations (docs/scene.md): its ``member``, with ``redraw`` from that one on another for each
    pose.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    situation: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_]*$")]
    layout: str = ""
    family: str = ""
    member: Annotated[int, Field(ge=0)] = 0
    set_up: str = ""
    pose: PoseTable | None = None
    poses: Annotated[tuple[PoseTable, ...], Field(min_length=1)] | None = None
    grid: Grid | None = None
    draw: Draw | None = None
    approach: tuple[Side, ...] = ()
    approach_mm: Annotated[float, Field(gt=0, le=200)] = 10.0
    redraw: bool = False
    objects: tuple[dict[str, Any], ...] = ()
    repeats: Count | None = None
    cycles: Count = 1
    published: Published | None = None

    @field_validator("layout")
    @classmethod
    def _layout(cls, name: str, info: ValidationInfo) -> str:
        return layout_of(name, info)

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
    def _one_source_of_scenes(self) -> Trial:
        if bool(self.layout) == bool(self.family):
            raise ValueError(
                "has both layout and family; a trial has one of them"
                if self.layout
                else "has no layout, and no family either"
            )
        if self.layout and not self.set_up:
            raise ValueError("set_up is missing: it tells a person what to do")
        return self

    @model_validator(mode="after")
    def _one_kind_of_poses(self) -> Trial:
        given = [key for key in ("pose", "poses", "grid", "draw") if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(
                f"has {' and '.join(given)}; a trial has one of pose, poses, grid and draw, or none"
                " for the reference place"
            )
        if len(set(self.approach)) < len(self.approach):
            raise ValueError("approach names a side twice")
        return self
