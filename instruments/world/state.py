"""What the cameras can see at one moment (`SceneState`), and its solids as columns (`Stage`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from instruments.world.backdrop import Backdrop
from instruments.world.boards import Board
from instruments.world.objects import TEAT_PAINT, SceneObject, Warmth, phantom_objects
from instruments.world.phantom import Phantom
from instruments.world.sensor import Exposure
from instruments.world.shading import Lighting, Paint
from instruments.world.solids import Ints, Point, Solids

LOWEST_MM = 1.0  # below the table: paint and play
FOOT_MM = 10.0  # a teat's, which is in the plate: its lower edge where it leans by 40 degrees
# twice the plant's 0.046 / 1.9: the skin is as warm as the water at the base, and farthest behind
# it at the end
TEAT_FALL = 0.048
STILL: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SceneState:
    """Everything visible at one moment, a temperature for each teat: its mean, falling by
    ``teat_fall`` of its excess from base to end. ``velocity_mm_s``: the phantom's. Raises
    ValueError for the number of temperatures, or an object below the table or behind the board.
    """

    phantom: Phantom
    teat_temps_c: tuple[float, ...]
    hose_temp_c: float
    ambient_c: float
    objects: tuple[SceneObject, ...] = ()
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop = field(default_factory=Backdrop)
    teat_paint: Paint = TEAT_PAINT
    exposure: Exposure = field(default_factory=Exposure)
    boards: tuple[Board, ...] = ()
    velocity_mm_s: Point = STILL
    time_s: float = 0.0
    teat_fall: float = TEAT_FALL

    def __post_init__(self) -> None:
        if len(self.teat_temps_c) != len(self.phantom.teats):
            raise ValueError(
                f"the phantom has {len(self.phantom.teats)} teats, but there are"
                f" {len(self.teat_temps_c)} teat temperatures"
            )
        rest = {"the hoses": (self.hose_temp_c,), "the room": (self.ambient_c,)}
        for what, values in {"a teat": self.teat_temps_c, **rest}.items():
            if not all(-60.0 <= value <= 200.0 for value in values):
                raise ValueError(
                    f"the temperature of {what} must be from -60 to 200 degC, is {values}"
                )
        stage, behind_mm = Stage.of(self.everything()), self.backdrop.board_y_mm
        lowest_mm = np.where(stage.owner < len(self.phantom.teats), -FOOT_MM, -LOWEST_MM)
        low = np.flatnonzero(stage.solids.nearest_depth() < lowest_mm)
        if len(low):
            raise ValueError(f"{stage.name_of(low)} reaches below the table (z = 0): raise it")
        far = np.flatnonzero(np.maximum(stage.solids.a[:, 1], stage.solids.b[:, 1]) > behind_mm)
        if len(far):
            raise ValueError(
                f"{stage.name_of(far)} stands behind the board (y = {behind_mm:g} mm), where no"
                " camera sees it"
            )

    @property
    def moves(self) -> bool:
        """Whether anything does."""
        return any(self.velocity_mm_s) or any(any(board.velocity_mm_s) for board in self.boards)

    def later(self, seconds: float) -> SceneState:
        """The same with everything that moves a little farther on its way."""
        pose = self.phantom.pose
        x, y, z = np.array([pose.x_mm, pose.y_mm, pose.z_mm]) + seconds * np.array(
            self.velocity_mm_s
        )
        there = replace(pose, x_mm=float(x), y_mm=float(y), z_mm=max(float(z), 0.0))
        boards = tuple(board.moved(seconds) for board in self.boards)
        phantom = self.phantom.moved(there)
        return replace(self, phantom=phantom, boards=boards, time_s=self.time_s + seconds)

    def temperature_c(self, warmth: Warmth) -> float:
        """degC of "teat" (mean of the teats, else the room), "ambient", or a number."""
        if warmth == "teat" and self.teat_temps_c:
            return float(np.mean(self.teat_temps_c))
        return self.ambient_c if isinstance(warmth, str) else warmth

    def everything(self) -> tuple[SceneObject, ...]:
        """All that stands on the table: the teats first, in their order."""
        return (
            *phantom_objects(self.phantom, self.teat_paint, self.teat_temps_c, self.hose_temp_c),
            *self.objects,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """All solids of a state as columns, world frame, and each one's place in ``things``, (k,)."""

    things: tuple[SceneObject, ...]
    solids: Solids
    owner: Ints

    @classmethod
    def of(cls, things: Sequence[SceneObject]) -> Stage:
        """What these things are made of."""
        return _stage(tuple(things))

    def name_of(self, solids: Ints) -> str:
        """The thing of the first of these solids (k,)."""
        return self.things[int(self.owner[solids[0]])].name


@lru_cache(maxsize=4)  # cameras and shadows ask for the same things
def _stage(things: tuple[SceneObject, ...]) -> Stage:
    solids = Solids.from_hulls([hull for thing in things for hull in thing.hulls])
    owner = np.repeat(np.arange(len(things)), [len(thing.hulls) for thing in things])
    return Stage(things, solids, owner)
