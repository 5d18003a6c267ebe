"""Emulated cameras that look at the simulated world in this process, and their faults.

The world is whatever has a scene, a renderer, a clock and a generator for each frame, so the same
run gives the same bytes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.camera.faults import FrameError, FrameFault
from instruments.camera.frame import CentiKelvin, FrameSet, Grey
from instruments.world.scene import RenderedSet, Renderer
from instruments.world.state import SceneState

# What an emulated camera can have, and which camera has it where nobody says. A wrong size is a
# wrong rig file, not a fault of a camera.
FAULTS: Mapping[FrameFault, str] = {
    FrameFault.DROPPED: "left",
    FrameFault.LOST_PACKETS: "left",
    FrameFault.LATE: "thermal",
    FrameFault.FROZEN: "left",
    FrameFault.BLACK: "left",
    FrameFault.SATURATED: "left",
    FrameFault.HALF: "left",
    FrameFault.FLAT_FIELD: "thermal",
    FrameFault.OUT_OF_FOCUS: "left",
    FrameFault.SWAPPED: "left",
}
KEPT_BACK = (FrameFault.DROPPED, FrameFault.LOST_PACKETS)
FOREVER = 1 << 30
AMOUNTS: Mapping[FrameFault, tuple[float, str]] = {
    FrameFault.LATE: (0.2, "seconds"),
    FrameFault.SATURATED: (6.0, "times the light"),
    FrameFault.OUT_OF_FOCUS: (4.0, "px of blur"),
}
BLACK_DN, READ_NOISE_DN = 4.0, 0.5
SHUTTER_CK, SHUTTER_NOISE_CK = 29900.0, 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Three pictures, and the temperatures behind the third."""

    left: Grey
    right: Grey
    thermal: Grey
    thermal_ck: CentiKelvin

    def with_camera(self, camera: str, other: Sight) -> Sight:
        """This sight, but ``camera``'s part from ``other``."""
        parts = ("thermal", "thermal_ck") if camera == "thermal" else (camera,)
        return replace(self, **{part: getattr(other, part) for part in parts})


@dataclass(frozen=True, slots=True)
class Active:
    """What spoils one frame set: each fault with its camera, and its amount where it has one."""

    spoiling: Mapping[FrameFault, tuple[str, float]] = field(default_factory=dict)

    @property
    def late(self) -> Mapping[str, float]:
        """How late which camera is, in seconds."""
        return {
            camera: amount
            for fault, (camera, amount) in self.spoiling.items()
            if fault is FrameFault.LATE
        }

    @property
    def kept_back(self) -> Mapping[str, FrameFault]:
        """Cameras whose frame does not come whole."""
        return {camera: fault for fault, (camera, _) in self.spoiling.items() if fault in KEPT_BACK}


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
        fault = named(name)
        check_amount(fault, amount)
        given = AMOUNTS.get(fault, (0.0, ""))[0] if amount is None else amount
        with self._lock:
            self._on[fault] = (camera or FAULTS[fault], given, times)

    def clear(self, name: str) -> None:
        """Have it no more; no matter whether it was there."""
        with self._lock:
            self._on.pop(named(name), None)

    def next(self) -> Active:
        """What spoils the next frame set; it counts as taken."""
        with self._lock:
            spoiling = {fault: (camera, amount) for fault, (camera, amount, _) in self._on.items()}
            left = {
                fault: (camera, amount, times - 1)
                for fault, (camera, amount, times) in self._on.items()
            }
            self._on = {fault: entry for fault, entry in left.items() if entry[2] > 0}
        return Active(spoiling)


def named(name: str) -> FrameFault:
    """The fault of that name. Raises ValueError."""
    known = {str(fault): fault for fault in FAULTS}
    if name not in known:
        raise ValueError(f'no fault "{name}" (there are: {", ".join(known)})')
    return known[name]


def check_amount(fault: FrameFault, amount: float | None) -> None:
    """Raise ValueError where a fault has no amount."""
    if amount is not None and fault not in AMOUNTS:
        said = ", ".join(f'"{known}" in {unit}' for known, (_, unit) in AMOUNTS.items())
        raise ValueError(
            f'of the cameras\' faults only these have an amount: {said}; "{fault}" has none'
        )


def check_camera(fault: FrameFault, camera: str | None) -> None:
    """Raise ValueError where only the thermal camera can have a fault."""
    if fault is FrameFault.FLAT_FIELD and camera not in (None, "thermal"):
        raise ValueError(f'only the thermal camera has a "{fault}"')


def spoiled(sight: Sight, last: Sight | None, active: Active, rng: np.random.Generator) -> Sight:
    """``sight`` with each fault in the order of `FAULTS`; ``last`` is the one before."""
    for fault in FAULTS:
        if fault in active.spoiling and fault in _DO:
            camera, amount = active.spoiling[fault]
            sight = _DO[fault](sight, last, camera, amount, rng)
    return sight


Spoil = Callable[[Sight, Sight | None, str, float, np.random.Generator], Sight]


def _frozen(
    sight: Sight, last: Sight | None, camera: str, _amount: float, _rng: np.random.Generator
) -> Sight:
    return sight if last is None else sight.with_camera(camera, last)


def _black(
    sight: Sight, _last: Sight | None, camera: str, _amount: float, rng: np.random.Generator
) -> Sight:
    if camera == "thermal":
        return replace(
            sight, thermal=np.zeros_like(sight.thermal), thermal_ck=np.zeros_like(sight.thermal_ck)
        )
    return _with(
        sight, camera, lambda picture: BLACK_DN + READ_NOISE_DN * rng.standard_normal(picture.shape)
    )


def _saturated(
    sight: Sight, _last: Sight | None, camera: str, amount: float, _rng: np.random.Generator
) -> Sight:
    if camera == "thermal":
        return replace(
            sight,
            thermal=np.full_like(sight.thermal, 255),
            thermal_ck=np.full_like(sight.thermal_ck, 65535),
        )
    return _with(sight, camera, lambda picture: picture.astype(np.float64) * amount)


def _half(
    sight: Sight, _last: Sight | None, camera: str, _amount: float, _rng: np.random.Generator
) -> Sight:
    parts = ("thermal", "thermal_ck") if camera == "thermal" else (camera,)
    return replace(sight, **{part: _cut(getattr(sight, part)) for part in parts})


def _cut(picture: NDArray[Any]) -> NDArray[Any]:
    cut = picture.copy()
    cut[picture.shape[0] // 2 :] = 0
    return cut


def _flat_field(
    sight: Sight, _last: Sight | None, _camera: str, _amount: float, rng: np.random.Generator
) -> Sight:
    """The shutter: one temperature with the same noise, mid-grey by the automatic gain."""
    shutter = SHUTTER_CK + SHUTTER_NOISE_CK * rng.standard_normal(sight.thermal_ck.shape)
    grey = 128.0 + 3.0 * rng.standard_normal(sight.thermal.shape)
    return replace(sight, thermal=_bytes(grey), thermal_ck=np.rint(shutter).astype(np.uint16))


def _out_of_focus(
    sight: Sight, _last: Sight | None, camera: str, amount: float, rng: np.random.Generator
) -> Sight:
    def blurred(picture: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(
            cv2.GaussianBlur(picture, (0, 0), amount)
            + READ_NOISE_DN * rng.standard_normal(picture.shape)
        )

    if camera == "thermal":
        kelvin = cv2.GaussianBlur(
            sight.thermal_ck.astype(np.float64),
            (0, 0),
            amount * sight.thermal_ck.shape[1] / sight.thermal.shape[1],
        )
        sight = replace(
            sight,
            thermal_ck=np.rint(
                kelvin + SHUTTER_NOISE_CK * rng.standard_normal(kelvin.shape)
            ).astype(np.uint16),
        )
    return _with(sight, camera, blurred)


def _swapped(
    sight: Sight, _last: Sight | None, _camera: str, _amount: float, _rng: np.random.Generator
) -> Sight:
    return replace(sight, left=sight.right, right=sight.left)


def _with(
    sight: Sight, camera: str, change: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> Sight:
    spoilt: dict[str, Any] = {camera: _bytes(change(getattr(sight, camera).astype(np.float64)))}
    return replace(sight, **spoilt)


def _bytes(values: NDArray[np.float64]) -> Grey:
    return np.ascontiguousarray(np.clip(np.rint(values), 0.0, 255.0).astype(np.uint8))


_DO: Mapping[FrameFault, Spoil] = {
    FrameFault.FROZEN: _frozen,
    FrameFault.BLACK: _black,
    FrameFault.SATURATED: _saturated,
    FrameFault.HALF: _half,
    FrameFault.FLAT_FIELD: _flat_field,
    FrameFault.OUT_OF_FOCUS: _out_of_focus,
    FrameFault.SWAPPED: _swapped,
}


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
        """The noise generator for frame ``index`` of ``kind``."""
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
        return {
            name: f"emulated {models[name].width_px} x {models[name].height_px}" for name in CAMERAS
        }

    def capture(self) -> FrameSet:
        """A frame set of the present world, all cameras at one moment unless one is late. Raises
        FrameError where a fault keeps a frame back.
        """
        active = self.faults.next()
        now_s = self._world.clock.now()
        sight, exposed_s = self._seen(), dict.fromkeys(CAMERAS, now_s)
        for camera, late_s in active.late.items():
            self._world.clock.sleep(max(0.0, now_s + late_s - self._world.clock.now()))
            sight = sight.with_camera(camera, self._seen())
            exposed_s[camera] = self._world.clock.now()
        sight = spoiled(
            sight, self._last, active, self._world.frame_rng("camera faults", self._taken)
        )
        for camera, fault in active.kept_back.items():
            what = (
                "a frame came with holes" if fault is FrameFault.LOST_PACKETS else "no frame came"
            )
            raise FrameError(fault, camera, f"{camera} camera, emulated", what)
        self._last = sight
        return FrameSet(
            sight.left, sight.right, sight.thermal, sight.thermal_ck, exposed_s, self.identity
        )

    def close(self) -> None:
        """Nothing is held open."""

    def _seen(self) -> Sight:
        taken: RenderedSet = self._world.renderer.render(
            self._world.scene(), self._world.frame_rng("cameras", self._taken)
        )
        self._taken += 1
        return Sight(taken.left, taken.right, taken.thermal_8bit, taken.thermal_ck)
