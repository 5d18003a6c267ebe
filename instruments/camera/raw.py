"""A frame as one camera gave it, before anything was turned, scaled or called a temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """``pixels`` uint8 or uint16, (h, w) or (h, w, 3) blue-green-red; ``bits`` of a pixel that carry signal, in the low end of its word;
    ``exposed_s`` on the bench's clock."""

    pixels: Pixels
    exposed_s: float
    bits: int = 8
