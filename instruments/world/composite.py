"""Lay partly covering surfaces over a background, nearest first, each pixel in its own order of depth.

Two pieces of one object that meet in a pixel cover the larger of their shares; surfaces of different objects cover
independently. May not know what the values mean: light and heat go the same way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world.optics import Floats
from instruments.world.solids import Bools, Ints


def lay_over(image: NDArray[Any], pixel: Ints, share: Floats, depth: Floats, owner: Ints, value: NDArray[Any]) -> None:
    """Lay surfaces (n,) over ``image`` (flat, contiguous, floats) in place.

    ``pixel`` is the flat index of each surface's pixel, ``share`` the part of that pixel it covers, ``owner`` the object it
    belongs to; ``depth`` orders them.
    """
    alone = np.bincount(pixel, minlength=len(image))[pixel] == 1
    image[pixel[alone]] += share[alone] * (value[alone] - image[pixel[alone]])
    shared = np.flatnonzero(~alone)
    if len(shared):
        _lay_stacks(image, pixel[shared], share[shared], depth[shared], owner[shared], value[shared])


def _lay_stacks(image: NDArray[Any], pixel: Ints, share: Floats, depth: Floats, owner: Ints, value: NDArray[Any]) -> None:
    """The same where several surfaces meet in a pixel."""
    # One key orders by pixel, then depth: a third of the time of two, and fine to 1e-4 mm.
    order = np.argsort(pixel + depth / (1.0 + 2.0 * depth.max()))
    sorted_pixel = pixel[order]
    starts = _starts(sorted_pixel)
    touched, place = sorted_pixel[starts], np.cumsum(starts) - 1
    rank = np.arange(len(order)) - np.flatnonzero(starts)[place]
    nearest = order[starts]
    widest, last_owner = share[nearest], owner[nearest]
    light = widest * value[nearest]
    behind = np.ones(len(touched))  # share of the pixel seen past all finished objects
    for step in range(1, int(rank.max(initial=0)) + 1):
        at = np.flatnonzero(rank == step)
        now, here = order[at], place[at]
        fresh = last_owner[here] != owner[now]
        behind[here] *= np.where(fresh, 1.0 - widest[here], 1.0)
        before = np.where(fresh, 0.0, widest[here])
        after = np.maximum(before, share[now])
        light[here] += behind[here] * (after - before) * value[now]
        widest[here], last_owner[here] = after, owner[now]
    image[touched] = light + behind * (1.0 - widest) * image[touched]


def _starts(sorted_values: Ints) -> Bools:
    """True where a run of equal values begins."""
    starts = np.ones(len(sorted_values), dtype=np.bool_)
    starts[1:] = sorted_values[1:] != sorted_values[:-1]
    return starts
