"""What a cowshed does to cameras, as a table: each perturbation is a name, an amount and a pure
change of the scene before it is drawn, of the pictures that the detectors get, or of the
calibration that they are told. The scene's truth stays.

Chance (where dirt lies, noise, which quarter is cool) comes from the scene's seeds and the
perturbation's name, so that a scene is perturbed alike in every campaign of the same seed.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Motion
from instruments.camera.frame import FrameSet
from instruments.world.shading import Lighting
from instruments.world.state import SceneState

Grey = NDArray[np.uint8]
Floats = NDArray[np.float64]
Chance = np.random.Generator

# of the quarters, how much of the whole difference each is cooler than the warmest
COOLER = (0.0, 0.3, 0.6, 1.0)
DIRT_PX, DIRT_LETS_THROUGH = (12.0, 60.0), (0.3, 0.8)
DEFOCUS_SD = 0.5  # of a blur disc's radius: the Gaussian that has its second moment


@dataclass(frozen=True, slots=True)
class Kind:
    """One row of the table: ``amount`` from ``low`` to ``high`` in ``unit``; ``none`` is the amount
    that changes nothing, None where each does something. Exactly one of the changes is there.
    """

    about: str
    unit: str
    low: float
    high: float
    none: float | None = 0.0
    state: Callable[[SceneState, float, Chance], SceneState] | None = None
    frames: Callable[[FrameSet, float, Chance], FrameSet] | None = None
    stated: Callable[[Calibration, float], Calibration] | None = None


@dataclass(frozen=True, slots=True)
class Applied:
    """A perturbation of a plan. Raises ValueError for a name that isn't in the table, or an amount
    that makes no sense.
    """

    name: str
    amount: float

    def __post_init__(self) -> None:
        kind = KINDS.get(self.name)
        if kind is None:
            close = difflib.get_close_matches(self.name, KINDS, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            there = ", ".join(KINDS)
            raise ValueError(f"there is no perturbation {self.name!r}{hint} (there are: {there})")
        if not kind.low <= self.amount <= kind.high:
            raise ValueError(
                f"{self.name} has to be from {kind.low:g} to {kind.high:g} {kind.unit}, is"
                f" {self.amount:g}"
            )

    @classmethod
    def parse(cls, text: str) -> Applied:
        """Of ``vergence=0.1``. Raises ValueError."""
        name, equals, amount = text.partition("=")
        try:
            number = float(amount)
        except ValueError:
            number = float("nan")
        if not equals or number != number:
            raise ValueError(f"{text!r}: a perturbation is NAME=AMOUNT, such as vergence=0.1")
        return cls(name.strip(), number)

    def state(self, state: SceneState, seeds: Sequence[int]) -> SceneState:
        """The scene, before it is drawn."""
        change = KINDS[self.name].state
        return change(state, self.amount, self._chance(seeds)) if change and self._does else state

    def frames(self, frames: FrameSet, seeds: Sequence[int]) -> FrameSet:
        """The pictures that the detectors get."""
        change = KINDS[self.name].frames
        return change(frames, self.amount, self._chance(seeds)) if change and self._does else frames

    def stated(self, calibration: Calibration) -> Calibration:
        """The calibration that the detectors get."""
        change = KINDS[self.name].stated
        return change(calibration, self.amount) if change and self._does else calibration

    @property
    def _does(self) -> bool:
        return self.amount != KINDS[self.name].none

    def _chance(self, seeds: Sequence[int]) -> Chance:
        return np.random.Generator(np.random.PCG64([*seeds, *self.name.encode()]))


def _optical(change: Callable[[Grey], Grey]) -> Callable[[FrameSet], FrameSet]:
    """Both optical pictures changed alike."""
    return lambda frames: replace(frames, left=change(frames.left), right=change(frames.right))


def _grey(values: NDArray[Any]) -> Grey:
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0), dtype=np.uint8)


def _table(values: Floats) -> Callable[[FrameSet], FrameSet]:
    """Each grey level (256,) becomes another."""
    table = _grey(values)
    return _optical(lambda image: np.asarray(cv2.LUT(image, table), dtype=np.uint8))


def _shifted(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    tall, wide = frames.right.shape
    move = np.array([[1.0, 0.0, amount], [0.0, 1.0, 0.0]])
    edge = cv2.BORDER_REPLICATE
    moved = cv2.warpAffine(frames.right, move, (wide, tall), borderMode=edge)
    return replace(frames, right=np.asarray(moved, dtype=np.uint8))


def _smeared(frames: FrameSet, amount: float, *, across: bool) -> FrameSet:
    """A box as long as the way, its ends in part."""
    half = int(np.ceil((amount - 1.0) / 2.0)) if amount > 1.0 else 0
    line = np.ones(2 * half + 1)
    line[[0, -1]] = 1.0 if half == 0 else (amount - (2 * half - 1)) / 2.0
    kernel = (line / line.sum())[None, :] if across else (line / line.sum())[:, None]
    return _optical(lambda image: np.asarray(cv2.filter2D(image, -1, kernel), dtype=np.uint8))(
        frames
    )


def _defocused(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    sd = DEFOCUS_SD * amount
    return _optical(lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), sd), np.uint8))(frames)


def _exposed(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    return _table(amount * np.arange(256.0))(frames)


def _gamma(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    return _table(255.0 * (np.arange(256.0) / 255.0) ** amount)(frames)


def _noisy(frames: FrameSet, amount: float, chance: Chance) -> FrameSet:
    return _optical(lambda image: _grey(image + chance.normal(0.0, amount, image.shape)))(frames)


def _dirty(frames: FrameSet, amount: float, chance: Chance) -> FrameSet:
    def smudged(image: Grey) -> Grey:
        tall, wide = image.shape
        y, x = np.mgrid[:tall, :wide].astype(np.float32)
        through = np.ones(image.shape, dtype=np.float32)
        for _ in range(round(amount)):
            at, size = chance.uniform((0, 0), (wide, tall)), chance.uniform(*DIRT_PX)
            least = chance.uniform(*DIRT_LETS_THROUGH)
            near = np.exp(-0.5 * ((x - at[0]) ** 2 + (y - at[1]) ** 2) / size**2)
            through *= (1.0 - (1.0 - least) * near).astype(np.float32)
        return _grey(image * through)

    return _optical(smudged)(frames)


def _compressed(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    def through(image: Grey) -> Grey:
        _, data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, round(amount)))
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)

    return _optical(through)(frames)


def _drifted(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    return _thermal(frames, np.full((1, 1), amount))


def _thermal_noisy(frames: FrameSet, amount: float, chance: Chance) -> FrameSet:
    like = frames.thermal if frames.thermal_ck is None else frames.thermal_ck
    return frames if like is None else _thermal(frames, chance.normal(0.0, amount, like.shape))


def _thermal(frames: FrameSet, off_k: Floats) -> FrameSet:
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
    teats = len(state.teat_temps_c)
    shares = chance.permutation(np.resize(COOLER, teats))
    cooler = np.asarray(state.teat_temps_c) - amount * shares
    return replace(state, teat_temps_c=tuple(cooler.tolist()))


def _warm_room(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, ambient_c=amount)


def _painted(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, teat_paint=replace(state.teat_paint, albedo=amount))


def _glossy(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, teat_paint=replace(state.teat_paint, gloss=amount))


def _lit(state: SceneState, amount: float, _: Chance) -> SceneState:
    light = state.lighting
    return replace(state, lighting=replace(light, brightness=amount * light.brightness))


def _evenly_lit(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, lighting=Lighting(state.lighting.brightness, lamps=(), ambient=amount))


def _before_board(state: SceneState, amount: float, _: Chance) -> SceneState:
    return replace(state, backdrop=replace(state.backdrop, board_albedo=amount))


def _of_right(name: str) -> Callable[[Calibration, float], Calibration]:
    return lambda calibration, amount: calibration.moved("right", name, amount)


def _turned(calibration: Calibration, amount: float) -> Calibration:
    """The right camera about its own vertical axis."""
    turn = Motion.from_vectors((0.0, np.radians(amount), 0.0), (0.0, 0.0, 0.0))
    return replace(calibration, right_from_left=turn @ calibration.right_from_left)


def _longer(calibration: Calibration, amount: float) -> Calibration:
    for at, name in enumerate(("fx", "fy")):
        calibration = calibration.moved("left", name, 0.01 * amount * calibration.left.fc[at])
    return calibration


def _thermal_turned(calibration: Calibration, amount: float) -> Calibration:
    pose = calibration.thermal_from_left
    turn = Motion.from_vectors((0.0, np.radians(amount), 0.0), (0.0, 0.0, 0.0))
    return calibration if pose is None else replace(calibration, thermal_from_left=turn @ pose)


def _across(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    return _smeared(frames, amount, across=True)


def _down(frames: FrameSet, amount: float, _: Chance) -> FrameSet:
    return _smeared(frames, amount, across=False)


KINDS: Mapping[str, Kind] = {
    "column": Kind(
        "the right picture's columns off",
        "px",
        -20,
        20,
        stated=_of_right("cx"),
    ),
    "row": Kind("the right picture's rows off", "px", -20, 20, stated=_of_right("cy")),
    "vergence": Kind("the right camera turned to the side", "deg", -5, 5, stated=_turned),
    "focal": Kind("the left camera's focal length off", "%", -10, 10, stated=_longer),
    "thermal-pose": Kind("the thermal camera turned", "deg", -10, 10, stated=_thermal_turned),
    "out-of-step": Kind(
        "the right picture taken later: moved along its rows", "px", -50, 50, frames=_shifted
    ),
    "blur-across": Kind("a motion along the rows", "px", 0, 100, frames=_across),
    "blur-down": Kind("a motion along the columns", "px", 0, 100, frames=_down),
    "defocus": Kind("lenses out of focus: the blur disc's radius", "px", 0, 30, frames=_defocused),
    "exposure": Kind("light times so much, cut off at white", "x", 0.02, 50, 1.0, frames=_exposed),
    "gamma": Kind("a tone curve, below 1 brighter", "", 0.1, 10, 1.0, frames=_gamma),
    "noise": Kind("noise of the optical pictures, sd", "grey levels", 0, 100, frames=_noisy),
    "dirt": Kind("smudges on each lens", "smudges", 0, 500, frames=_dirty),
    "jpeg": Kind("pictures compressed with this quality", "", 1, 100, None, frames=_compressed),
    "thermal-drift": Kind("all temperatures seen off", "K", -20, 20, frames=_drifted),
    "thermal-noise": Kind("noise of the thermal picture, sd", "K", 0, 10, frames=_thermal_noisy),
    "cool-quarters": Kind(
        "quarters up to so much cooler than the warmest", "K", 0, 20, state=_cool_quarters
    ),
    "teat-paint": Kind("albedo of the teats' paint", "", 0, 1, None, state=_painted),
    "teat-gloss": Kind("gloss of the teats' paint", "", 0, 1, None, state=_glossy),
    "board": Kind("albedo of the board behind", "", 0, 1, None, state=_before_board),
    "light": Kind("all light times so much", "x", 0, 20, 1.0, state=_lit),
    "even-light": Kind(
        "light from everywhere in place of lamps, irradiance", "", 0, 20, None, state=_evenly_lit
    ),
    "warm-room": Kind("surroundings of this temperature", "degC", -20, 45, None, state=_warm_room),
}
