"""Raw frames to what a frame set holds, as declared for each camera: grey pictures or temperatures.

In this order: colour to grey, mirrored back, turned, flipped, then 16 bits to 8 and perhaps
inverted, or counts to centi-kelvin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from instruments.camera.frame import CentiKelvin, Grey, RawFrame, grey8

Channel = Literal["luma", "red", "green", "blue"]
Flip = Literal["none", "horizontal", "vertical", "both"]
Turn = Literal[0, 90, 180, 270]
_BGR = {"blue": 0, "green": 1, "red": 2}


@dataclass(frozen=True, slots=True)
class Radiometry:
    """Apparent temperature: ``kelvin_at_zero`` + ``kelvin_per_count`` x count (data sheet)."""

    kelvin_per_count: float
    kelvin_at_zero: float = 0.0


@dataclass(frozen=True, slots=True)
class Conversion:
    """What is done to each raw frame of one camera.

    ``grey``: a colour frame's channel, or its luma (BT.601); ``mirrored``: exchange left and right;
    ``turn_deg``: clockwise; ``white``: the count that becomes 255 (None: the format's);
    ``inverted``: black becomes white; with ``radiometry`` the frame is temperatures, without
    ``white`` or ``inverted``.
    """

    grey: Channel = "luma"
    mirrored: bool = False
    turn_deg: Turn = 0
    flip: Flip = "none"
    white: int | None = None
    inverted: bool = False
    radiometry: Radiometry | None = None

    def picture(self, raw: RawFrame) -> Grey:
        """The frame in 8-bit grey (h, w). Raises ValueError for an array that is no image."""
        image = grey8(self._upright(raw.pixels), full_scale=self.white or (1 << raw.bits) - 1)
        return np.ascontiguousarray(255 - image if self.inverted else image)

    def temperatures(self, raw: RawFrame) -> CentiKelvin:
        """Hundredths of a kelvin (h, w). Raises ValueError without radiometry, in colour, or
        outside 0 to 655 K.
        """
        if self.radiometry is None:
            raise ValueError("no radiometry is declared, so counts can't become temperatures")
        counts = self._upright(raw.pixels)
        if counts.ndim != 2:
            raise ValueError(f"temperatures come from a grey frame, this one is {counts.shape}")
        centikelvin = np.rint(
            100.0
            * (
                self.radiometry.kelvin_at_zero
                + self.radiometry.kelvin_per_count * counts.astype(np.float64)
            )
        )
        if centikelvin.min() < 0.0 or centikelvin.max() > 65535.0:
            span = f"{centikelvin.min() / 100:g} to {centikelvin.max() / 100:g} K"
            raise ValueError(
                f"counts {counts.min()} to {counts.max()} would be {span}: kelvin_per_count or"
                " kelvin_at_zero is wrong"
            )
        return np.ascontiguousarray(centikelvin.astype(np.uint16))

    def _upright(self, image: NDArray[Any]) -> NDArray[Any]:
        if image.ndim == 3 and self.grey in _BGR:
            image = image[:, :, _BGR[self.grey]]
        if self.mirrored:
            image = image[:, ::-1]
        image = np.rot90(image, k=-self.turn_deg // 90)
        if self.flip in ("horizontal", "both"):
            image = image[:, ::-1]
        if self.flip in ("vertical", "both"):
            image = image[::-1]
        return np.ascontiguousarray(image)
