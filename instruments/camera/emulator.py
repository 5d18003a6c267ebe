"""Emulated cameras: they look at the simulated world and hand frame sets over in this process.

The world is whatever has a scene, a renderer, a generator for each frame and a clock. Frames differ only by the generator, so the same
run gives the same bytes. What is to go wrong is said in `faults`. May not import the drivers of real cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from instruments.camera.emulator_faults import CameraFaults, Sight, spoiled
from instruments.camera.faults import FrameError, FrameFault
from instruments.camera.frame import FrameSet
from instruments.world.scene import RenderedSet, Renderer, SceneState

CAMERAS = ("left", "right", "thermal")


class Clock(Protocol):
    """What tells the time, and lets it pass."""

    def now(self) -> float:
        """Seconds."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SeenWorld(Protocol):
    """What emulated cameras need of the world."""

    @property
    def renderer(self) -> Renderer:
        """The three cameras' pictures of a state."""
        ...

    @property
    def clock(self) -> Clock:
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
        self._last: Sight | None = None
        self.faults = CameraFaults()

    @property
    def identity(self) -> Mapping[str, str]:
        """Who each camera is."""
        models = {camera.name: camera for camera in self._world.renderer.cameras}
        return {name: f"emulated {models[name].width_px} x {models[name].height_px}" for name in CAMERAS}

    def capture(self) -> FrameSet:
        """A frame set of the world as it is now, all cameras exposed at the same moment unless one is late.

        Raises FrameError where a fault keeps a camera's frame back.
        """
        active = self.faults.next()
        now_s = self._world.clock.now()
        sight, exposed_s = self._seen(), dict.fromkeys(CAMERAS, now_s)
        for camera, late_s in active.late.items():
            self._world.clock.sleep(max(0.0, now_s + late_s - self._world.clock.now()))
            sight = sight.with_camera(camera, self._seen())
            exposed_s[camera] = self._world.clock.now()
        sight = spoiled(sight, self._last, active, self._world.frame_rng("camera faults", self._taken))
        for camera, fault in active.kept_back.items():
            what = "a frame came with holes" if fault is FrameFault.LOST_PACKETS else "no frame came"
            raise FrameError(fault, camera, f"{camera} camera, emulated", what)
        self._last = sight
        return FrameSet(sight.left, sight.right, sight.thermal, sight.thermal_ck, exposed_s, self.identity)

    def close(self) -> None:
        """Nothing is held open."""

    def _seen(self) -> Sight:
        taken: RenderedSet = self._world.renderer.render(self._world.scene(), self._world.frame_rng("cameras", self._taken))
        self._taken += 1
        return Sight(taken.left, taken.right, taken.thermal_8bit, taken.thermal_ck)
