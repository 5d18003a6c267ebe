"""What a cowshed does to cameras, as a table: each perturbation is a name, an amount and a pure
change of the scene before it is drawn, of the pictures that the detectors get, or of the
calibration that they are given. The scene's truth stays.

Chance (where dirt lies, noise, which quarter is cool) comes from the scene's seeds and the
perturbation's name, so that a scene is perturbed alike in every campaign of the same seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from bench.config import ArgumentError, did_you_mean
from bench.rig import moved
from bench.scoring.errors import Floats
from detector.calibration import Calibration
from detector.geometry import Motion
from instruments.camera.frame import FrameSet, Grey
from instruments.world.shading import Lighting
from instruments.world.state import SceneState
from textfiles.bounds import NUMBER

Chance = np.random.Generator
# optical: left and right, one after the other; rig: the cameras, drawn by and stated alike
Of = Literal["scene", "frames", "optical", "stated", "rig"]
Change = Callable[[Any, float, Chance], Any]
T = TypeVar("T", SceneState, FrameSet, Calibration)

# of the quarters, how much of the whole difference each is cooler than the warmest
COOLER = (0.0, 0.3, 0.6, 1.0)
DIRT_PX, DIRT_LETS_THROUGH = (12.0, 60.0), (0.3, 0.8)
DEFOCUS_SD = 0.5  # of a blur disc's radius: the Gaussian that has its second moment
GREYS = np.arange(256.0)


@dataclass(frozen=True, slots=True)
class Kind:
    """One row of the table: ``amount`` from ``low`` to ``high`` in ``unit``; ``none`` is the amount
    that changes nothing, None where each does something. ``change`` makes another ``of``.
    """

    unit: str
    low: float
    high: float
    of: Of
    change: Change
    none: float | None = 0.0


@dataclass(frozen=True, slots=True)
class Applied:
    """A perturbation of a plan. Raises ArgumentError for an unknown name or amount out of range."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    name: str
    amount: float

    def __post_init__(self) -> None:
        kind = KINDS.get(self.name) if isinstance(self.name, str) else None
        if kind is None:
            hint, there = did_you_mean(str(self.name), KINDS), ", ".join(KINDS)
            said = f"there is no perturbation {self.name!r}{hint} (there are: {there})"
            raise ArgumentError.plain(said)
        if not (NUMBER.has(self.amount) and kind.low <= self.amount <= kind.high):
            ends = f"{kind.low:g} to {kind.high:g} {kind.unit}".strip()
            given = f"{self.amount:g}" if isinstance(self.amount, float) else repr(self.amount)
            raise ArgumentError.plain(f"{self.name} has to be from {ends}, is {given}")

    @classmethod
    def parse(cls, text: str) -> Applied:
        """Of ``vergence=0.1``. Raises ArgumentError."""
        name, _, amount = text.partition("=")
        try:
            number = float(amount)
        except ValueError:
            number = float("nan")
        if number != number:
            why = f"{text!r}: a perturbation is NAME=AMOUNT, such as vergence=0.1"
            raise ArgumentError.plain(why)
        return cls(name.strip(), number)

    def state(self, state: SceneState, seeds: Sequence[int]) -> SceneState:
        """The scene, before it is drawn."""
        return self._changed("scene", state, seeds)

    def frames(self, frames: FrameSet, seeds: Sequence[int]) -> FrameSet:
        """The pictures that the detectors get."""
        return self._changed("optical", self._changed("frames", frames, seeds), seeds)

    def rig(self, calibration: Calibration, seeds: Sequence[int]) -> Calibration:
        """The cameras that the scene is drawn by."""
        return self._changed("rig", calibration, seeds)

    def stated(self, calibration: Calibration) -> Calibration:
        """The calibration that the detectors get."""
        return self._changed("stated", calibration, ())

    def _changed(self, of: Of, thing: T, seeds: Sequence[int]) -> T:
        kind = KINDS[self.name]
        if kind.of != of or self.amount == kind.none:
            return thing
        chance = np.random.Generator(np.random.PCG64([*seeds, *self.name.encode()]))
        if isinstance(thing, FrameSet) and of == "optical":
            left, right = (
                kind.change(image, self.amount, chance) for image in (thing.left, thing.right)
            )
            return replace(thing, left=left, right=right)
        changed: T = kind.change(thing, self.amount, chance)
        return changed


def _grey(values: NDArray[Any]) -> Grey:
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0), dtype=np.uint8)


def _out_of_step(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    tall, wide = frames.right.shape
    move = np.array([[1.0, 0.0, amount], [0.0, 1.0, 0.0]])
    edge = cv2.BORDER_REPLICATE
    moved = cv2.warpAffine(frames.right, move, (wide, tall), borderMode=edge)
    return replace(frames, right=np.asarray(moved, dtype=np.uint8))


def _smeared(image: Grey, amount: float, _: Chance, *, shape: tuple[int, int]) -> Any:
    """A box as long as the way, its ends in part."""
    half = int(np.ceil((amount - 1.0) / 2.0)) if amount > 1.0 else 0
    line = np.ones(2 * half + 1)
    line[[0, -1]] = 1.0 if half == 0 else (amount - (2 * half - 1)) / 2.0
    return cv2.filter2D(image, -1, (line / line.sum()).reshape(shape))


def _defocused(image: Grey, amount: float, _: Chance) -> Any:
    return cv2.GaussianBlur(image, (0, 0), DEFOCUS_SD * amount)


def _exposed(image: Grey, amount: float, _: Chance) -> Grey:
    return _grey(amount * GREYS)[image]


def _gamma(image: Grey, amount: float, _: Chance) -> Grey:
    return _grey(255.0 * (GREYS / 255.0) ** amount)[image]


def _noisy(image: Grey, amount: float, chance: Chance) -> Grey:
    return _grey(image + chance.normal(0.0, amount, image.shape))


def _dirty(image: Grey, amount: float, chance: Chance) -> Grey:
    tall, wide = image.shape
    y, x = np.mgrid[:tall, :wide].astype(np.float32)
    through = np.ones(image.shape, dtype=np.float32)
    for _ in range(round(amount)):
        at, size = chance.uniform((0, 0), (wide, tall)), chance.uniform(*DIRT_PX)
        least = chance.uniform(*DIRT_LETS_THROUGH)
        near = np.exp(-0.5 * ((x - at[0]) ** 2 + (y - at[1]) ** 2) / size**2)
        through *= (1.0 - (1.0 - least) * near).astype(np.float32)
    return _grey(image * through)


def _compressed(image: Grey, amount: float, _: Chance) -> Any:
    data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, round(amount)))[1]
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def _thermal_drift(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    return _warmer(frames, np.full((1, 1), amount))


def _thermal_noise(frames: FrameSet, amount: float, chance: Chance) -> FrameSet:
    like = frames.thermal if frames.thermal_ck is None else frames.thermal_ck
    return frames if like is None else _warmer(frames, chance.normal(0.0, amount, like.shape))


def _warmer(frames: FrameSet, off_k: Floats) -> FrameSet:
    """Kelvin added on the sensor's grid. A picture of 8 bits has its own gain, and moves by what
    its spread of grey is to the spread of temperatures; one offset alone doesn't change it.
    """
    changed: dict[str, Any] = {}
    if frames.thermal_ck is not None:
        raised = np.rint(frames.thermal_ck + 100.0 * off_k)
        changed["thermal_ck"] = np.clip(raised, 0.0, 65535.0).astype(np.uint16)
        if frames.thermal is not None and off_k.size > 1:
            tall, wide = frames.thermal.shape
            per_k = 100.0 * float(frames.thermal.std()) / max(float(frames.thermal_ck.std()), 1.0)
            off = cv2.resize(off_k, (wide, tall), interpolation=cv2.INTER_LINEAR)
            changed["thermal"] = _grey(frames.thermal + per_k * off)
    return replace(frames, **changed)


def _cool_quarters(state: SceneState, amount: float, chance: Chance) -> SceneState:
    shares = chance.permutation(np.resize(COOLER, len(state.teat_temps_c)))
    cooler = np.asarray(state.teat_temps_c) - amount * shares
    return replace(state, teat_temps_c=tuple(cooler.tolist()))


def _warm_room(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, ambient_c=amount)


def _lit(state: SceneState, amount: float, _: Chance) -> SceneState:
    light = state.lighting
    return replace(state, lighting=replace(light, brightness=amount * light.brightness))


def _evenly_lit(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, lighting=Lighting(state.lighting.brightness, lamps=(), ambient=amount))


def _set(part: str, key: str) -> Change:
    """A value of a part of the scene becomes the amount."""
    return lambda state, amount, _: replace(
        state, **{part: replace(getattr(state, part), **{key: amount})}
    )


def _right_moved(name: str) -> Change:
    return lambda calibration, amount, _: calibration.moved("right", name, amount)


def _turned(pose: str) -> Change:
    """A camera about its own vertical axis."""

    def change(calibration: Calibration, amount: float, _: Chance) -> Calibration:
        turn = Motion.from_vectors((0.0, np.radians(amount), 0.0), (0.0, 0.0, 0.0))
        was = getattr(calibration, pose)
        return calibration if was is None else replace(calibration, **{pose: turn @ was})

    return change


def _longer(calibration: Calibration, amount: float, _: Chance) -> Calibration:
    for at, name in enumerate(("fx", "fy")):
        calibration = calibration.moved("left", name, 0.01 * amount * calibration.left.fc[at])
    return calibration


def _rig(name: str) -> Change:
    return lambda calibration, amount, _: moved.DRAWN[name][0](calibration, amount)


# docs/campaigns.md says what each is
KINDS: Mapping[str, Kind] = {
    "rig": Kind("", 0, 1, "rig", lambda calibration, _, chance: moved.drawn(calibration, chance)),
    "baseline": Kind("mm", 20, 1000, "rig", _rig("baseline"), none=None),
    "away": Kind("mm", 200, 3000, "rig", _rig("away"), none=None),
    "tilt": Kind("deg", -60, 60, "rig", _rig("tilt")),
    "roll": Kind("deg", -180, 180, "rig", _rig("roll")),
    "pixels": Kind("x", 0.1, 2, "rig", _rig("pixels"), none=1.0),
    "thermal-pixels": Kind("x", 0.2, 2, "rig", _rig("thermal-pixels"), none=1.0),
    "distortion": Kind("", -0.5, 0.5, "rig", _rig("distortion")),
    "column": Kind("px", -20, 20, "stated", _right_moved("cx")),
    "row": Kind("px", -20, 20, "stated", _right_moved("cy")),
    "vergence": Kind("deg", -5, 5, "stated", _turned("right_from_left")),
    "focal": Kind("%", -10, 10, "stated", _longer),
    "thermal-pose": Kind("deg", -10, 10, "stated", _turned("thermal_from_left")),
    "out-of-step": Kind("px", -50, 50, "frames", _out_of_step),
    "blur-across": Kind("px", 0, 100, "optical", partial(_smeared, shape=(1, -1))),
    "blur-down": Kind("px", 0, 100, "optical", partial(_smeared, shape=(-1, 1))),
    "defocus": Kind("px", 0, 30, "optical", _defocused),  # the blur disc's radius
    "exposure": Kind("x", 0.02, 50, "optical", _exposed, none=1.0),
    "gamma": Kind("", 0.1, 10, "optical", _gamma, none=1.0),
    "noise": Kind("grey levels", 0, 100, "optical", _noisy),
    "dirt": Kind("smudges", 0, 500, "optical", _dirty),
    "jpeg": Kind("", 1, 100, "optical", _compressed, none=None),
    "thermal-drift": Kind("K", -20, 20, "frames", _thermal_drift),
    "thermal-noise": Kind("K", 0, 10, "frames", _thermal_noise),
    "cool-quarters": Kind("K", 0, 20, "scene", _cool_quarters),
    "teat-paint": Kind("", 0, 1, "scene", _set("teat_paint", "albedo"), none=None),
    "teat-gloss": Kind("", 0, 1, "scene", _set("teat_paint", "gloss"), none=None),
    "board": Kind("", 0, 1, "scene", _set("backdrop", "board_albedo"), none=None),
    "light": Kind("x", 0, 20, "scene", _lit, none=1.0),
    "even-light": Kind("", 0, 20, "scene", _evenly_lit, none=None),
    "warm-room": Kind("degC", -20, 45, "scene", _warm_room, none=None),
}
