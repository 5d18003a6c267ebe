"""Emulated cameras: they look at the simulated world and hand frame sets over in this process.

The world is whatever has a scene, a renderer, a generator for each frame and a clock. Frames differ only by the generator, so the same
run gives the same bytes. May not import the drivers of real cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from instruments.camera.frame import FrameSet
from instruments.world.scene import Renderer, SceneState

CAMERAS = ("left", "right", "thermal")


class Timed(Protocol):
    """What tells the time."""

    def now(self) -> float:
        """Seconds."""
        ...


class SeenWorld(Protocol):
    """What emulated cameras need of the world."""

    @property
    def renderer(self) -> Renderer:
        """The three cameras' pictures of a state."""
        ...

    @property
    def clock(self) -> Timed:
        """The bench's clock."""
        ...

    def scene(self) -> SceneState:
        """What stands before the cameras now."""
        ...

    def frame_rng(self, kind: str, index: int) -> np.random.Generator:
        """The generator for the noise of frame ``index`` of ``kind``: the same for the same run, frame and kind."""
        ...


class EmulatedCameras:
    """The left, right and thermal camera of the emulated rig."""

    def __init__(self, world: SeenWorld) -> None:
        self._world = world
        self._taken = 0

    @property
    def identity(self) -> Mapping[str, str]:
        """Who each camera is."""
        models = {camera.name: camera for camera in self._world.renderer.cameras}
        return {name: f"emulated {models[name].width_px} x {models[name].height_px}" for name in CAMERAS}

    def capture(self) -> FrameSet:
        """A frame set of the world as it is now, all cameras exposed at the same moment."""
        now_s = self._world.clock.now()
        taken = self._world.renderer.render(self._world.scene(), self._world.frame_rng("cameras", self._taken))
        self._taken += 1
        exposed_s = dict.fromkeys(CAMERAS, now_s)
        return FrameSet(taken.left, taken.right, taken.thermal_8bit, taken.thermal_ck, exposed_s, self.identity)

    def close(self) -> None:
        """Nothing is held open."""
