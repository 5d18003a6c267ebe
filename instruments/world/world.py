"""The one simulated world that all emulators share: plant, phantom, what stands around it, and the hand that holds the arm.

What the bath heats, the thermal camera sees; where the stage stands, the phantom stands; where the hand holds the
tip, the arm reads. It may not know how any of them speaks on its wire. One lock guards it; time comes from the clock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import Phantom, PlatePose, make_phantom
from instruments.world.plant import Plant
from instruments.world.scene import Renderer, SceneState

HOSE_DROP_K = 0.02  # the hoses' skin against the water (bath sheet, section 4.3, foamed hose at 6 L/min)


class World:
    """``renderer`` draws it; ``stage_mm`` is asked where the stage stands, relative to its reference place."""

    def __init__(self, clock: Clock, seed: int, renderer: Renderer, *, ambient_c: float = 20.0, bath_start_c: float = 20.0) -> None:
        self.clock = clock
        self.seed = seed
        self.lock = threading.RLock()
        self.renderer = renderer
        self.plant = Plant(seed, ambient_c=ambient_c, start_c=bath_start_c)
        self.ambient_c = ambient_c
        self.stage_mm: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0)
        self._phantom = make_phantom("table-5-1")
        self._objects: tuple[SceneObject, ...] = ()
        self._held: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def arrange(self, layout_name: str, objects: Sequence[Mapping[str, Any]]) -> None:
        """Set the teats up as a named layout, and put other things around them. Raises ValueError for what isn't known."""
        with self.lock:
            self._phantom = make_phantom(layout_name)
            self._objects = tuple(make_object(**table) for table in objects)

    def hold(self, point_mm: NDArray[np.float64] | None, axis: NDArray[np.float64] | None = None) -> None:
        """The hand holds the arm's tip at ``point_mm`` (3,), the stylus along ``axis`` (3,) from the tip up; None lets go."""
        with self.lock:
            self._held = None if point_mm is None or axis is None else (point_mm, axis)

    def arm_target(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Where the hand holds the arm's tip, and how; None when the arm is on its peg."""
        return self._held

    def phantom(self) -> Phantom:
        """The phantom where the stage has it now."""
        x, y = self.stage_mm()
        return self._phantom.moved(PlatePose(x, y))

    def ends_mm(self) -> NDArray[np.float64]:
        """The exact teat ends (n, 3), world frame: kept aside by the bench, never shown to a detector."""
        return self.phantom().ends_mm

    def scene(self) -> SceneState:
        """All that the cameras see, at this moment."""
        with self.lock:
            self.plant.advance_to(self.clock.now())
            phantom = self.phantom()
            teats_c = tuple(float(v) for v in np.resize(self.plant.teat_c, len(phantom.teats)))
            hose_c = float(self.plant.bath_c) - (HOSE_DROP_K if self.plant.pump_on else 0.0)
            return SceneState(phantom=phantom, objects=self._objects, teat_temps_c=teats_c, hose_temp_c=hose_c, ambient_c=self.ambient_c)

    def frame_rng(self, kind: str, index: int) -> np.random.Generator:
        """Chance for the ``index``-th frame set: the same for the same seed, whatever else was drawn."""
        return np.random.default_rng([self.seed, *kind.encode(), index])
