"""A frame set: what the cameras saw at one moment, and the one place where raw images become 8-bit
grey.

May not know where the images came from: camera, folder or scene.

A frame as one camera gave it, before anything was turned, scaled or called a temperature.
"""

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

    ``left``, ``right`` uint8 (h, w); ``thermal`` uint8 (h, w) as delivered, mirrored or not, or
    None; ``thermal_ck`` uint16 centi-kelvin at sensor resolution, un-mirrored, or None.
    ``exposed_s`` gives each camera's time of exposure on the bench's clock, ``identity`` who each
    camera is; both may lack cameras that don't say. Raises ValueError for another shape or type.
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
        """Apparent temperature in kelvin at sensor resolution, un-mirrored; None where the camera
        isn't radiometric.
        """
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
    """An 8-bit grey image of a raw one: colour (blue, green, red, perhaps alpha) to grey, 16 bits
    to 8.

    ``full_scale`` is the value of white in a 16-bit image: 65535, or 4095 for 12 bits kept in 16;
    values above it are white. Raises ValueError for anything that isn't an image of 8 or 16 bits.
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
    """``pixels`` uint8 or uint16, (h, w) or (h, w, 3) blue-green-red; ``bits`` of a pixel that
    carry signal, in the low end of its word; ``exposed_s`` on the bench's clock.
    """

    pixels: Pixels
    exposed_s: float
    bits: int = 8
