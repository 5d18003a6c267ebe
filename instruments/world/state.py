"""What the cameras can see at one moment, as a value: `SceneState`; and all its solids as columns: `Stage`.

Checks that a scene makes sense. May not know of cameras, or how anything is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from instruments.world.backdrop import Backdrop
from instruments.world.objects import TEAT_PAINT, SceneObject, phantom_objects
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom
from instruments.world.shading import Lighting, Paint
from instruments.world.solids import Ints, Solids

LOWEST_MM = 1.0  # below the table: paint and play


@dataclass(frozen=True, slots=True)
class SceneState:
    """Everything that the cameras can see at one moment. Temperatures in degC, one for each teat, in the phantom's order.

    ``teat_paint`` is the phantom's paint; the room (board, table, what is mirrored in paint) is at ``ambient_c``. Raises ValueError
    where the number of temperatures is wrong, or an object reaches below the table or behind the board.
    """

    phantom: Phantom
    teat_temps_c: tuple[float, ...]
    hose_temp_c: float
    ambient_c: float
    objects: tuple[SceneObject, ...] = ()
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop = field(default_factory=Backdrop)
    teat_paint: Paint = TEAT_PAINT

    def __post_init__(self) -> None:
        if len(self.teat_temps_c) != len(self.phantom.teats):
            raise ValueError(f"the phantom has {len(self.phantom.teats)} teats, but there are {len(self.teat_temps_c)} teat temperatures")
        temps = {"a teat": self.teat_temps_c, "the hoses": (self.hose_temp_c,), "the room": (self.ambient_c,)}
        for what, values in temps.items():
            if not all(-60.0 <= value <= 200.0 for value in values):
                raise ValueError(f"the temperature of {what} must be from -60 to 200 degC, is {values}")
        _refuse_outside(Stage.of(self), self.backdrop)

    def everything(self) -> tuple[SceneObject, ...]:
        """All that stands on the table: the teats first, in their order."""
        return (*phantom_objects(self.phantom, self.teat_paint, self.teat_temps_c, self.hose_temp_c), *self.objects)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """All solids of a state as columns in the world frame, and which thing of ``things`` each belongs to, (k,)."""

    things: tuple[SceneObject, ...]
    solids: Solids
    owner: Ints

    @classmethod
    def of(cls, state: SceneState) -> Stage:
        """What stands on the table in a state."""
        things = state.everything()
        solids = Solids.from_hulls([hull for thing in things for hull in thing.hulls])
        return cls(things, solids, np.repeat(np.arange(len(things)), [len(thing.hulls) for thing in things]))

    def temperatures_c(self, state: SceneState) -> Floats:
        """degC of each thing; "teat" means the mean of the teats, or the room where there are none."""
        teat_c = float(np.mean(state.teat_temps_c)) if state.teat_temps_c else state.ambient_c
        return np.array([thing.temperature_c(state.ambient_c, teat_c) for thing in self.things], dtype=np.float64)


def _refuse_outside(stage: Stage, backdrop: Backdrop) -> None:
    low = np.flatnonzero(stage.solids.nearest_depth() < -LOWEST_MM)
    if len(low):
        raise ValueError(f"{stage.things[stage.owner[low[0]]].name} reaches below the table (z = 0): raise it")
    far = np.flatnonzero(np.maximum(stage.solids.a[:, 1], stage.solids.b[:, 1]) > backdrop.board_y_mm)
    if len(far):
        name = stage.things[stage.owner[far[0]]].name
        raise ValueError(f"{name} stands behind the board (y = {backdrop.board_y_mm:g} mm), where no camera sees it")
