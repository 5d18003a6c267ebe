"""A situation as a value. May not know how situations are drawn."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from instruments.world.backdrop import Backdrop
from instruments.world.boards import Board
from instruments.world.objects import TEAT_PAINT, SceneObject
from instruments.world.phantom import Phantom
from instruments.world.sensor import Exposure
from instruments.world.shading import Lighting, Paint
from instruments.world.state import SceneState


@dataclass(frozen=True, slots=True)
class Situation:
    """One member of a family: what stands where, how it is lit and painted, how the optical cameras are set.

    ``about`` tells a person in one sentence what to set up. Temperatures of the teats are the bath's affair, and no part of it.
    """

    name: str
    seed: int
    about: str
    phantom: Phantom
    objects: tuple[SceneObject, ...] = ()
    boards: tuple[Board, ...] = ()
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop = field(default_factory=Backdrop)
    teat_paint: Paint = TEAT_PAINT
    exposure: Exposure = field(default_factory=Exposure)

    def state(self, teat_temps_c: tuple[float, ...], hose_temp_c: float, ambient_c: float, **more: Any) -> SceneState:
        """What the cameras see of it where the plant has these temperatures; ``more`` are further fields of `SceneState`."""
        fields: dict[str, Any] = {
            "phantom": self.phantom, "objects": self.objects, "boards": self.boards, "lighting": self.lighting,
            "backdrop": self.backdrop, "teat_paint": self.teat_paint, "exposure": self.exposure,
        }  # fmt: skip
        return SceneState(teat_temps_c=teat_temps_c, hose_temp_c=hose_temp_c, ambient_c=ambient_c, **(fields | more))
