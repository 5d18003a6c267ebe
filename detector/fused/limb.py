"""By how much the fall of brightness towards a body's limb moves its edges, told from both optical pictures together.

Strategy: a step alone is found precisely, but where brightness falls towards the limb it is found too far inside. A step with such a fall
is found where it is, but far less precisely, since the fall can stand in for a part of the shift. The difference between the two is
the body's and the light's doing, so that it is much the same in both pictures and for neighbours along the outline: averaged over these it
corrects the precise edges, and hardly moves the disparity between the pictures, on which depth hangs. Where it is large, it isn't quite
the same everywhere, and each line's own goes in with a growing share. The module may not know teats or cameras.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from detector.geometry import Array

_NEIGHBOURS = 9  # points along an outline that are lit alike: some 20 mm
_UNLIKE = 0.5  # how far one line's own may be from that of its neighbours (standard deviation), as a share of it
_PLAIN_PX, _SHADED_PX = 0.02, 0.06  # how sure a step is found without a fall of brightness and with one (standard deviation)


def shared_limb(own_px: Array) -> Array:
    """What the outlines (m, n) have in common of each line's ``own_px`` (views, m, n), which is NaN where it isn't known."""
    known = np.isfinite(own_px).sum(axis=0).astype(np.float64)
    total = np.nan_to_num(own_px).sum(axis=0)
    count = uniform_filter1d(known, _NEIGHBOURS, axis=1, mode="nearest")
    return np.asarray(uniform_filter1d(total, _NEIGHBOURS, axis=1, mode="nearest") / np.maximum(count, 0.5 / _NEIGHBOURS))


def own_share(shared_px: Array, own_sd_px: Array) -> Array:
    """What each line's own is worth in the best mean with the shared one, by how sure each is: 0 to 1.

    ``own_sd_px``: by how much an edge's noise is the more for the fall of brightness.
    """
    unlike, noise = (_UNLIKE * shared_px) ** 2 + _PLAIN_PX**2, own_sd_px**2 + _SHADED_PX**2
    return np.asarray(unlike / (unlike + noise))
