"""Emulated cameras that look at the simulated world in this process, and their faults. The same run
gives the same bytes.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.camera.frame import CentiKelvin, FrameError, FrameFault, FrameSet, Grey
from instruments.clock import Clock
from instruments.faults import Amounts, check_fault
from instruments.world.scene import RenderedSet, Renderer
from instruments.world.state import SceneState

# what an emulated camera can have, and by default which one; a wrong size is a wrong rig file
FAULTS: Mapping[FrameFault, str] = {
    fault: "thermal" if fault in (FrameFault.LATE, FrameFault.FLAT_FIELD) else "left"
    for fault in FrameFault
    if fault is not FrameFault.WRONG_SIZE
}
THERMAL_ALONE = FrameFault.FLAT_FIELD  # other cameras have no shutter
KEPT_BACK: Mapping[FrameFault, str] = {
    FrameFault.DROPPED: "no frame came",
    FrameFault.LOST_PACKETS: "a frame came with holes",
}
FOREVER = 1 << 30
AMOUNTS: Amounts = {
    FrameFault.LATE: (0.2, "seconds"),
    FrameFault.SATURATED: (6.0, "times the light"),
    FrameFault.OUT_OF_FOCUS: (4.0, "px of blur"),
}
BLACK_DN, READ_NOISE_DN = 4.0, 0.5
SHUTTER_CK, SHUTTER_NOISE_CK = 29900.0, 8.0
Spoiling = Mapping[FrameFault, tuple[str, float]]  # each fault with its camera and its amount


class CameraFaults:
    """Which faults are on. Each lasts for a number of frame sets, or until it is cleared."""

    def __init__(self) -> None:
        self._on: dict[FrameFault, tuple[str, float, int]] = {}
        # faults come and go on the clock's thread, sets are taken on others
        self._lock = threading.Lock()

    def inject(
        self,
        name: str,
        times: int = FOREVER,
        *,
        camera: str | None = None,
        amount: float | None = None,
    ) -> None:
        """Start a fault at the next frame set. Raises ValueError for an unknown name or amount."""
        check_fault("the cameras have", name, FAULTS, AMOUNTS, amount)
        fault = FrameFault(name)
        usual = AMOUNTS.get(fault, (0.0, ""))[0]
        with self._lock:
            self._on[fault] = camera or FAULTS[fault], usual if amount is None else amount, times

    def clear(self, name: str) -> None:
        """End a fault, whether it was on or not."""
        check_fault("the cameras have", name, FAULTS, AMOUNTS)
        with self._lock:
            self._on.pop(FrameFault(name), None)

    def next(self) -> Spoiling:
        """What spoils the next frame set, in the order of `FAULTS`; it counts as taken."""
        with self._lock:
            on, self._on = self._on, {}
            for fault, (camera, amount, times) in on.items():
                if times > 1:
                    self._on[fault] = camera, amount, times - 1
        return {fault: on[fault][:2] for fault in FAULTS if fault in on}


def spoiled(
    frames: FrameSet, last: FrameSet | None, spoiling: Spoiling, rng: np.random.Generator
) -> FrameSet:
    """``frames`` with each fault; ``last`` is the set before."""
    for fault, (camera, amount) in spoiling.items():
        old = {part: getattr(frames, part) for part in _parts(camera)}
        new: dict[str, Any] = {}
        if fault is FrameFault.SWAPPED:
            new = {"left": frames.right, "right": frames.left}
        elif fault is FrameFault.FROZEN and last is not None:
            new = {part: getattr(last, part) for part in old}
        elif fault is FrameFault.HALF:
            for part, image in old.items():
                new[part] = np.where(np.arange(len(image))[:, None] < len(image) // 2, image, 0)
        elif camera == "thermal":
            new = _spoiled_thermal(fault, old["thermal"], old["thermal_ck"], amount, rng)
        elif fault is FrameFault.BLACK:
            new = {camera: _bytes(BLACK_DN + _noise(rng, READ_NOISE_DN, old[camera]))}
        elif fault is FrameFault.SATURATED:
            new = {camera: _bytes(old[camera].astype(np.float64) * amount)}
        elif fault is FrameFault.OUT_OF_FOCUS:
            new = {camera: _bytes(_blurred(old[camera], amount, rng, READ_NOISE_DN))}
        frames = replace(frames, **new)
    return frames


def _spoiled_thermal(
    fault: FrameFault, grey: Grey, ck: CentiKelvin, amount: float, rng: np.random.Generator
) -> dict[str, Any]:
    match fault:
        case FrameFault.BLACK:
            return {"thermal": np.zeros_like(grey), "thermal_ck": np.zeros_like(ck)}
        case FrameFault.SATURATED:
            return {"thermal": np.full_like(grey, 255), "thermal_ck": np.full_like(ck, 65535)}
        case FrameFault.FLAT_FIELD:
            # the shutter: one temperature with the same noise, mid-grey by the automatic gain
            kelvin = SHUTTER_CK + _noise(rng, SHUTTER_NOISE_CK, ck)
            shown = 128.0 + _noise(rng, 3.0, grey)
        case FrameFault.OUT_OF_FOCUS:
            kelvin = _blurred(ck, amount * ck.shape[1] / grey.shape[1], rng, SHUTTER_NOISE_CK)
            shown = _blurred(grey, amount, rng, READ_NOISE_DN)
        case _:
            return {}
    return {"thermal": _bytes(shown), "thermal_ck": np.rint(kelvin).astype(np.uint16)}


def _parts(camera: str) -> tuple[str, ...]:
    return ("thermal", "thermal_ck") if camera == "thermal" else (camera,)


def _noise(rng: np.random.Generator, sigma: float, image: Any) -> NDArray[np.float64]:
    return np.asarray(sigma * rng.standard_normal(image.shape))


def _blurred(
    image: NDArray[Any], blur_px: float, rng: np.random.Generator, noise: float
) -> NDArray[np.float64]:
    smooth = cv2.GaussianBlur(image.astype(np.float64), (0, 0), blur_px)
    return np.asarray(smooth + _noise(rng, noise, image))


def _bytes(values: NDArray[np.float64]) -> Grey:
    return np.ascontiguousarray(np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8))


class RenderedWorld(Protocol):
    """What emulated cameras need of the world."""

    @property
    def renderer(self) -> Renderer: ...
    @property
    def clock(self) -> Clock: ...

    def scene(self) -> SceneState:
        """What stands before the cameras now."""

    def frame_rng(self, kind: str, index: int) -> np.random.Generator:
        """The noise generator for frame ``index`` of ``kind``."""


class EmulatedCameras:
    """The left, right and thermal camera of the emulated rig."""

    def __init__(self, world: RenderedWorld) -> None:
        self._world = world
        self._taken = 0
        self._last: FrameSet | None = None
        self._pulled: set[str] = set()
        self.faults = CameraFaults()

    @property
    def identity(self) -> Mapping[str, str]:
        """Who each camera is."""
        renderer = self._world.renderer
        deep = [renderer.depth.view.camera] if renderer.depth else []
        return {
            one.name: f"emulated {one.width_px} x {one.height_px}"
            for one in [*renderer.cameras, *deep]
        }

    def pull(self, camera: str, out: bool) -> None:
        """Pull a camera's cable, or put it back: no set is whole without it."""
        (self._pulled.add if out else self._pulled.discard)(camera)

    def glance(self) -> None:
        """Raises FrameError where a camera's cable is out."""
        for camera in tuple(self._pulled):
            what = KEPT_BACK[FrameFault.DROPPED]
            raise FrameError(FrameFault.DROPPED, camera, f"{camera} camera, emulated", what)

    def capture(self) -> FrameSet:
        """A frame set of the present world. Raises FrameError where a fault keeps a frame back."""
        self.glance()
        spoiling = self.faults.next()
        clock = self._world.clock
        now_s = clock.now()
        frames, exposed_s = self._seen(), dict.fromkeys(self.identity, now_s)
        if FrameFault.LATE in spoiling:
            camera, late_s = spoiling[FrameFault.LATE]
            clock.sleep(max(0.0, now_s + late_s - clock.now()))
            late = self._seen()
            frames = replace(frames, **{part: getattr(late, part) for part in _parts(camera)})
            exposed_s[camera] = clock.now()
        rng = self._world.frame_rng("camera faults", self._taken)
        frames = spoiled(frames, self._last, spoiling, rng)
        for fault, what in KEPT_BACK.items():
            if fault in spoiling:
                camera = spoiling[fault][0]
                raise FrameError(fault, camera, f"{camera} camera, emulated", what)
        self._last = replace(frames, exposed_s=exposed_s, identity=self.identity)
        return self._last

    def close(self) -> None:
        """Nothing is held open."""

    def _seen(self) -> FrameSet:
        rng = self._world.frame_rng("cameras", self._taken)
        self._taken += 1
        return frame_set(self._world.renderer.render(self._world.scene(), rng))


def frame_set(taken: RenderedSet) -> FrameSet:
    """What was rendered, as cameras deliver it."""
    images = taken.left, taken.right, taken.thermal_8bit, taken.thermal_ck
    return FrameSet(*images, depth_dmm=taken.depth_dmm, amplitude=taken.amplitude)
