"""Frames: raw, as a set of grey pictures and temperatures, the conversion, and a frame's faults.

Conversion, in this order: colour to grey, mirrored back, turned, flipped, then 16 bits to 8 and
perhaps inverted, or counts to centi-kelvin, or to tenths of a millimetre.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.errors import ProtocolError

Grey = NDArray[np.uint8]
CentiKelvin = NDArray[np.uint16]
TenthsMm = NDArray[np.uint16]
# of a frame set: name, type, and whether it may be missing
_IMAGES = (
    ("left", np.uint8, False),
    ("right", np.uint8, False),
    ("thermal", np.uint8, True),
    ("thermal_ck", np.uint16, True),
    ("depth_dmm", np.uint16, True),
    ("amplitude", np.uint16, True),
)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """``left``, ``right``, ``thermal`` (as delivered) uint8 (h, w); ``thermal_ck`` uint16
    centi-kelvin, un-mirrored; ``depth_dmm`` uint16 tenths of a mm along the axis, 0: not measured;
    ``amplitude`` uint16 of its signal. By camera: ``exposed_s`` (bench's clock), ``identity``,
    ``passed_over`` as in `RawFrame`. Raises ValueError.
    """

    left: Grey
    right: Grey
    thermal: Grey | None = None
    thermal_ck: CentiKelvin | None = None
    exposed_s: Mapping[str, float] = field(default_factory=dict)
    identity: Mapping[str, str] = field(default_factory=dict)
    depth_dmm: TenthsMm | None = None
    amplitude: NDArray[np.uint16] | None = None
    passed_over: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, dtype, optional in _IMAGES:
            image = getattr(self, name)
            if image is None and optional:
                continue
            wanted = f"a frame set's {name} must be an array (height, width) of {np.dtype(dtype)}"
            if not isinstance(image, np.ndarray):
                raise ValueError(f"{wanted}, is a {type(image).__name__}")
            if image.dtype != dtype or image.ndim != 2 or image.size == 0:
                seen = f"{image.shape} of {image.dtype}"
                raise ValueError(f"{wanted}, is {seen}; `grey8` makes 8-bit grey of raw images")
        depth_size = None if self.depth_dmm is None else self.depth_dmm.shape
        if self.amplitude is not None and self.amplitude.shape != depth_size:
            raise ValueError("a frame set's amplitude goes with a depth picture of its size")

    @property
    def pictures(self) -> dict[str, NDArray[np.uint8] | NDArray[np.uint16]]:
        """Those that are there, by the names that the record has for them."""
        images = {
            "left": self.left,
            "right": self.right,
            "thermal": self.thermal,
            "thermal_radiometric": self.thermal_ck,
            "depth": self.depth_dmm,
            "depth_amplitude": self.amplitude,
        }
        return {name: image for name, image in images.items() if image is not None}

    @property
    def thermal_k(self) -> NDArray[np.float64] | None:
        """Apparent temperature in kelvin, sensor's grid, un-mirrored; None if not radiometric."""
        return None if self.thermal_ck is None else self.thermal_ck / 100.0

    @property
    def depth_mm(self) -> NDArray[np.float64] | None:
        """Along the depth camera's optical axis, NaN where nothing was measured; None without."""
        depth = self.depth_dmm
        return None if depth is None else np.where(depth > 0, depth / 10.0, np.nan)


def grey8(image: NDArray[Any], full_scale: int = 65535) -> Grey:
    """An 8-bit grey image of a raw one; ``full_scale`` is white in one of 16 bits (4095 for 12 bits
    in 16). Raises ValueError.
    """
    if image.ndim not in (2, 3) or not image.size or image.shape[2:] not in ((), (1,), (3,), (4,)):
        what = "an image must be (height, width) with one, three or four channels"
        raise ValueError(f"{what}, is {image.shape}")
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"an image must have 8 or 16 bits, is {image.dtype}")
    if image.ndim == 3:
        code = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}.get(image.shape[2])
        image = image[:, :, 0] if code is None else np.asarray(cv2.cvtColor(image, code))
    if image.dtype == np.uint16:
        return np.clip(np.rint(image * (255.0 / full_scale)), 0.0, 255.0).astype(np.uint8)
    return np.ascontiguousarray(image, dtype=np.uint8)


# the middle of a barn's picture: from frost under a winter's sky to a lamp before the camera
BARN_C = (-60.0, 150.0)


def no_temperatures(centikelvin: CentiKelvin) -> str:
    """Why counts can't be hundredths of a kelvin that a barn has; empty where they may be."""
    middle_c = float(np.median(centikelvin)) / 100.0 - 273.15
    if BARN_C[0] <= middle_c <= BARN_C[1]:
        return ""
    return f"{middle_c:.0f} degC in the middle of all: these counts are no hundredths of a kelvin"


Pixels = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Ranging:
    """Distance: ``mm_at_zero`` + ``mm_per_count`` x count; ``none`` is no measurement."""

    mm_per_count: float
    mm_at_zero: float = 0.0
    none: float | None = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """``pixels`` uint8 or uint16, (h, w) or (h, w, 3) blue-green-red, or distances as float32, with
    ``bits`` of signal. Of a depth camera: what its counts are, and its ``amplitude``.
    ``passed_over``: damaged frames that came before it and were left out.
    """

    pixels: Pixels
    exposed_s: float
    bits: int = 8
    ranging: Ranging | None = None
    amplitude: Pixels | None = None
    passed_over: int = 0


MOST_VALUES = 200_000_000  # of a picture: no sensor has as many


def no_picture(frame: RawFrame) -> Iterator[tuple[str, object]]:
    """What is wrong with a frame that no camera can give, and what was seen."""
    bits, ranging = frame.bits, frame.ranging
    if not isinstance(ranging, Ranging | None) or bits not in range(1, 33):
        yield "has no such bits or ranging", (bits, ranging)
        return
    given: list[Any] = [frame.pixels, *([] if frame.amplitude is None else [frame.amplitude])]
    for one in given:
        if not isinstance(one, np.ndarray):
            yield "has pixels that are no array of NumPy", one
            return
        native = one.dtype.newbyteorder("=")
        known = native in (np.uint8, np.uint16) or (ranging and one.dtype.kind in "uif")
        if one.ndim not in (2, 3) or not 0 < one.size <= MOST_VALUES or not known:
            yield "is no picture of 8 or 16 bits", (one.shape, one.dtype)
        elif not ranging and one.max() >= 2 ** int(bits):
            yield f"has values beyond its {bits} bits", one.max()


Channel = Literal["luma", "red", "green", "blue"]
Flip = Literal["none", "horizontal", "vertical", "both"]
Turn = Literal[0, 90, 180, 270]
_BGR = {"blue": 0, "green": 1, "red": 2}
_FLIPPED = {"none": (), "horizontal": (1,), "vertical": (0,), "both": (0, 1)}  # axes


@dataclass(frozen=True, slots=True)
class Radiometry:
    """Apparent temperature: ``kelvin_at_zero`` + ``kelvin_per_count`` x count (data sheet)."""

    kelvin_per_count: float
    kelvin_at_zero: float = 0.0


@dataclass(frozen=True, slots=True)
class Conversion:
    """What is done to each raw frame. ``grey``: a colour frame's channel; ``turn_deg``: clockwise;
    ``white``: the count that becomes 255; with ``radiometry`` the frame is temperatures;
    ``ranging``: None for what the depth camera says.
    """

    grey: Channel = "luma"
    mirrored: bool = False
    turn_deg: Turn = 0
    flip: Flip = "none"
    white: int | None = None
    inverted: bool = False
    radiometry: Radiometry | None = None
    ranging: Ranging | None = None

    def picture(self, raw: RawFrame) -> Grey:
        """The frame in 8-bit grey (h, w). Raises ValueError for an array that is no image."""
        image = grey8(self._upright(raw.pixels), full_scale=self.white or (1 << raw.bits) - 1)
        return np.ascontiguousarray(255 - image if self.inverted else image)

    def temperatures(self, raw: RawFrame) -> CentiKelvin:
        """Hundredths of a kelvin (h, w). Raises ValueError for a frame that has none."""
        if self.radiometry is None:
            raise ValueError("no radiometry is declared, so counts can't become temperatures")
        if raw.pixels.dtype == np.uint8:
            raise ValueError(EIGHT_BITS)
        counts = self._upright(raw.pixels)
        if counts.ndim != 2:
            raise ValueError(f"temperatures come from a grey frame, this one is {counts.shape}")
        zero_k, per_count_k = self.radiometry.kelvin_at_zero, self.radiometry.kelvin_per_count
        centikelvin = np.rint(100.0 * (zero_k + per_count_k * counts.astype(np.float64)))
        if centikelvin.min() < 0.0 or centikelvin.max() > 65535.0:
            span = f"{centikelvin.min() / 100:g} to {centikelvin.max() / 100:g} K"
            what = f"counts {counts.min()} to {counts.max()} would be {span}"
            raise ValueError(f"{what}: kelvin_per_count or kelvin_at_zero is wrong")
        found = np.ascontiguousarray(centikelvin.astype(np.uint16))
        if wrong := no_temperatures(found):
            raise ValueError(f"{wrong}: kelvin_per_count or kelvin_at_zero is wrong")
        return found

    def depth(self, raw: RawFrame) -> tuple[TenthsMm, NDArray[np.uint16] | None]:
        """Tenths of a mm (h, w), 0 where not measured, and amplitude (h, w) or None. Raises
        ValueError for a frame that has no distances.
        """
        ranging = self.ranging or raw.ranging
        if ranging is None:
            what = "nothing says how far a count of the depth camera is"
            raise ValueError(f"{what}: set mm_per_count in [cameras.depth]")
        counts = self._upright(raw.pixels)
        if counts.ndim != 2 or counts.dtype == np.uint8:
            seen = f"this one is {counts.shape} of {counts.dtype}"
            raise ValueError(f"depth comes from a grey frame of 16 bits or more, {seen}")
        tenths = np.rint(10.0 * (ranging.mm_at_zero + ranging.mm_per_count * counts.astype(float)))
        measured = (tenths >= 1.0) & (tenths <= 65535.0)  # false for what is no number
        if ranging.none is not None:
            measured &= counts != counts.dtype.type(ranging.none)
        found = np.where(measured, tenths, 0.0).astype(np.uint16)
        given = raw.amplitude
        return found, None if given is None else self._upright(given).astype(np.uint16)

    def _upright(self, image: NDArray[Any]) -> NDArray[Any]:
        if image.ndim == 3 and self.grey in _BGR:
            image = image[:, :, _BGR[self.grey]]
        if self.mirrored:
            image = np.fliplr(image)
        image = np.rot90(image, k=-self.turn_deg // 90)
        return np.ascontiguousarray(np.flip(image, _FLIPPED[self.flip]))


EIGHT_BITS = (
    "temperatures are asked for (radiometric), but a frame of 8 bits came: the camera, its driver"
    " or a program before it has made a picture of the counts. Ask for a pixel_format of 16 bits"
    " (Y16, Mono16, Mono14), or leave radiometric out"
)


class FrameFault(StrEnum):
    """A frame, or a set of them, that must not be measured with."""

    DROPPED = "dropped"  # no frame came
    LOST_PACKETS = "lost packets"  # a frame came with holes, and said so
    LATE = "late"  # exposed too long after the others of its set
    WRONG_SIZE = "wrong size"  # another picture size than the calibration's
    FROZEN = "frozen"  # the last frame once more, to the last bit
    BLACK = "black"
    SATURATED = "saturated"
    HALF = "half a frame"  # rows at an edge are missing, or still the last frame's
    FLAT_FIELD = "flat-field event"  # the thermal camera looks at its own shutter
    OUT_OF_FOCUS = "out of focus"
    SWAPPED = "swapped"  # left and right have changed places


class FrameError(ProtocolError):
    """A frame did not come whole. Worth another try, unlike a lost link (`LinkError`)."""

    def __init__(
        self,
        fault: FrameFault,
        camera: str,
        who: str,
        what: str,
        *,
        seconds: float | None = None,
        hint: str | None = None,
    ) -> None:
        self.fault = fault
        self.camera = camera
        super().__init__(who, what, asked="a frame", seconds=seconds, hint=hint)
