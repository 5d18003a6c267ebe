"""The world that all emulators share: plant, phantom, what stands around it, and the hand that
holds the arm. One lock guards it; time comes from the clock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.world.boards import Board
from instruments.world.objects import TEAT_PAINT, SceneObject, make_object
from instruments.world.phantom import TABLE_5_1_MM, Phantom, PlatePose, upright
from instruments.world.plant import Plant
from instruments.world.scene import Renderer
from instruments.world.setups import Situation
from instruments.world.solids import Point
from instruments.world.state import STILL, SceneState

# the hoses' skin against the water (bath sheet, section 4.3, foamed hose at 6 L/min)
HOSE_DROP_K = 0.02


class World:
    """``make_renderer`` makes what draws it; ``stage_pose``, ``stage_velocity`` are the stage's."""

    def __init__(
        self,
        clock: Clock,
        seed: int,
        make_renderer: Callable[[], Renderer],
        *,
        ambient_c: float = 20.0,
        bath_start_c: float = 20.0,
    ) -> None:
        self.clock = clock
        self.seed = seed
        self.lock = threading.RLock()
        self._make_renderer = make_renderer
        self.plant = Plant(seed, ambient_c=ambient_c, start_c=bath_start_c)
        self.ambient_c = ambient_c
        self.stage_pose: Callable[[], PlatePose] = PlatePose
        self.stage_velocity: Callable[[], Point] = lambda: STILL
        self._phantom = upright(TABLE_5_1_MM)
        self._objects: tuple[SceneObject, ...] = ()
        self._situation: Situation | None = None
        self._held: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._board: Board | None = None

    @cached_property
    def renderer(self) -> Renderer:
        """Draws it; made when first asked for, which takes half a second. Raises ValueError."""
        return self._make_renderer()

    def close(self) -> None:
        """Drop the renderer's 100 MB: a closed rig stays in reference cycles for a while."""
        self.__dict__.pop("renderer", None)

    def arrange(
        self,
        phantom: Phantom,
        objects: Sequence[Mapping[str, Any]],
        situation: Situation | None = None,
    ) -> None:
        """Put a phantom on the plate, things around it, and a ``situation``. Raises ValueError."""
        with self.lock:
            self._phantom = phantom
            self._objects = tuple(make_object(**table) for table in objects)
            self._situation = situation

    def show(self, board: Board | None) -> None:
        """Hold a board before the cameras and remove the phantom; None puts it back."""
        with self.lock:
            self._board = board

    def set_room(self, ambient_c: float) -> None:
        """The room's temperature from now on, for plant and pictures."""
        with self.lock:
            self.plant.advance_to(self.clock.now())
            self.ambient_c = self.plant.ambient_c = ambient_c

    def hold(
        self, point_mm: NDArray[np.float64] | None, axis: NDArray[np.float64] | None = None
    ) -> None:
        """Hold the tip at ``point_mm`` (3,), the stylus along ``axis`` (3,); None lets go."""
        with self.lock:
            self._held = None if point_mm is None or axis is None else (point_mm, axis)

    def arm_target(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Where the hand holds the arm's tip, and how; None when the arm is on its peg."""
        return self._held

    def phantom(self) -> Phantom:
        """The phantom where the stage has it now, with its pose on the stage."""
        with self.lock:
            return self._phantom.moved(self._phantom.pose.carried(self.stage_pose()))

    def ends_mm(self) -> NDArray[np.float64]:
        """The exact teat ends (n, 3), world frame; never shown to a detector."""
        return self.phantom().ends_mm

    def scene(self) -> SceneState:
        """All that the cameras see, at this moment."""
        with self.lock:
            self.plant.advance_to(self.clock.now())
            phantom = self.phantom() if self._board is None else Phantom(())
            teats_c = tuple(float(v) for v in np.resize(self.plant.teat_c, len(phantom.teats)))
            hose_c = float(self.plant.bath_c) - (HOSE_DROP_K if self.plant.pump_on else 0.0)
            constants = self.plant.constants
            # the skin's mean lag behind the water, twice
            fall = 2.0 * constants.teat_out_w_per_k / constants.teat_in_w_per_k
            around = self._situation or Situation(
                "", 0, "", phantom, teat_paint=replace(TEAT_PAINT, emissivity=phantom.emissivity)
            )
            things = (*around.objects, *self._objects)
            moment = {"time_s": self.clock.now(), "velocity_mm_s": self.stage_velocity()}
            if self._board is not None:
                moment |= {"boards": (self._board,), "velocity_mm_s": STILL}
            return around.state(
                teats_c,
                hose_c,
                self.ambient_c,
                phantom=phantom,
                objects=things,
                teat_fall=fall,
                **moment,
            )

    def frame_rng(self, kind: str, index: int) -> np.random.Generator:
        """The generator for frame set ``index``, from the seed alone."""
        return np.random.default_rng([self.seed, *kind.encode(), index])
