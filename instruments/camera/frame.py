"""Frames: raw as a camera gave them, and a frame set of 8-bit grey pictures and temperatures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
CentiKelvin = NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Images of the left, right and thermal camera.

    ``left``, ``right``, ``thermal`` (as delivered, or None) uint8 (h, w); ``thermal_ck`` uint16 (h,
    w) centi-kelvin, sensor's grid, un-mirrored, or None. ``exposed_s``: time on the bench's clock
    by camera, ``identity`` by camera; both may lack some. Raises ValueError.
    """

    left: Grey
    right: Grey
    thermal: Grey | None = None
    thermal_ck: CentiKelvin | None = None
    exposed_s: Mapping[str, float] = field(default_factory=dict)
    identity: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check("left", self.left, np.uint8)
        _check("right", self.right, np.uint8)
        if self.thermal is not None:
            _check("thermal", self.thermal, np.uint8)
        if self.thermal_ck is not None:
            _check("thermal_ck", self.thermal_ck, np.uint16)

    @property
    def thermal_k(self) -> NDArray[np.float64] | None:
        """Apparent temperature in kelvin, sensor's grid, un-mirrored; None if not radiometric."""
        return None if self.thermal_ck is None else self.thermal_ck / 100.0


def _check(name: str, image: Any, dtype: type[np.generic]) -> None:
    wanted = f"a frame set's {name} must be an array (height, width) of {np.dtype(dtype)}"
    if not isinstance(image, np.ndarray):
        raise ValueError(f"{wanted}, is a {type(image).__name__}")
    if image.dtype != dtype or image.ndim != 2 or image.size == 0:
        raise ValueError(
            f"{wanted}, is {image.shape} of {image.dtype}; `grey8` makes 8-bit grey of raw images"
        )


def grey8(image: NDArray[Any], full_scale: int = 65535) -> Grey:
    """An 8-bit grey image of a raw one of 8 or 16 bits, grey or blue, green, red, perhaps alpha.

    ``full_scale`` is white in a 16-bit image, 4095 for 12 bits in 16; higher values are white too.
    Raises ValueError.
    """
    if (
        image.ndim not in (2, 3)
        or image.size == 0
        or (image.ndim == 3 and image.shape[2] not in (1, 3, 4))
    ):
        raise ValueError(
            f"an image must be (height, width) with one, three or four channels, is {image.shape}"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"an image must have 8 or 16 bits, is {image.dtype}")
    if image.ndim == 3:
        codes = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
        image = (
            np.asarray(cv2.cvtColor(image, codes[image.shape[2]]))
            if image.shape[2] in codes
            else image[:, :, 0]
        )
    if image.dtype == np.uint16:
        return np.clip(np.rint(image * (255.0 / full_scale)), 0.0, 255.0).astype(np.uint8)
    return np.ascontiguousarray(image, dtype=np.uint8)


Pixels = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """``pixels`` uint8 or uint16, (h, w) or (h, w, 3) blue-green-red; ``bits`` of signal in the low
    end of a word; ``exposed_s`` on the bench's clock.
    """

    pixels: Pixels
    exposed_s: float
    bits: int = 8
