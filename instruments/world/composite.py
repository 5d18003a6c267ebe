"""Lay partly covering surfaces over a background, each pixel in its own order of depth.

Two pieces of one object that meet in a pixel cover the larger of their shares; surfaces of different objects cover
independently. Objects whose depths don't mix are laid one after the other, far to near, which is the same and quicker.
May not know what the values mean: light and heat go the same way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world.optics import Floats
from instruments.world.solids import Bools, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """How one object looks to one camera, hidden or not: each pixel (n,) that it covers, once.

    ``share`` of the pixel's area, ``depth_mm``, ``value``: light, or emissivity. For heat, ``along`` says how far from one of the
    object's two temperatures to the other: from a teat's base to its end, from a board's light squares to its dark ones.
    """

    row: Ints
    column: Ints
    share: Floats
    depth_mm: Floats
    value: NDArray[Any]
    along: Floats | None = None

    def __len__(self) -> int:
        return len(self.share)


def lay_over(image: NDArray[Any], layers: Sequence[Layer], values: Sequence[NDArray[Any]], corner: tuple[int, int] = (0, 0)) -> None:
    """Lay objects with these ``values`` over ``image`` (h, w; contiguous floats) in place; its first pixel is at ``corner``."""
    flat, width = image.reshape(-1), image.shape[1]
    for together in _far_to_near(layers):
        pixels = [(layers[i].row - corner[0]) * width + layers[i].column - corner[1] for i in together]
        if len(together) == 1:
            pixel, share, value = pixels[0], layers[together[0]].share, values[together[0]]
            flat[pixel] += share * (value - flat[pixel])
        else:
            owner = np.repeat(np.arange(len(together)), [len(pixel) for pixel in pixels])
            share, depth = (np.concatenate([getattr(layers[i], name) for i in together]) for name in ("share", "depth_mm"))
            _lay_mixed(flat, np.concatenate(pixels), share, depth, owner, np.concatenate([values[i] for i in together]))


def _far_to_near(layers: Sequence[Layer]) -> Iterator[list[int]]:
    """Groups of layers whose depths don't reach into each other's, the farthest first."""
    spans = [(float(layer.depth_mm.max()), float(layer.depth_mm.min()), i) for i, layer in enumerate(layers) if len(layer)]
    group: list[int] = []
    nearest = np.inf
    for far, near, i in sorted(spans, reverse=True):
        if group and far < nearest:
            yield group
            group = []
        group.append(i)
        nearest = min(nearest, near) if len(group) > 1 else near
    if group:
        yield group


def _lay_mixed(image: NDArray[Any], pixel: Ints, share: Floats, depth: Floats, owner: Ints, value: NDArray[Any]) -> None:
    """Objects that mix in depth: pixels where only one shows go at once."""
    alone = np.bincount(pixel, minlength=len(image))[pixel] == 1
    image[pixel[alone]] += share[alone] * (value[alone] - image[pixel[alone]])
    shared = np.flatnonzero(~alone)
    if len(shared):
        stack = _stacked(pixel[shared], share[shared], depth[shared], owner[shared], value[shared])
        image[stack.pixel] = stack.light + stack.behind * image[stack.pixel]


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """Surfaces over one another in pixels (m,): their light, the share of the pixel seen past them, the nearest of each."""

    pixel: Ints
    light: Floats
    behind: Floats
    nearest: Ints


def _stacked(pixel: Ints, share: Floats, depth: Floats, owner: Ints, value: NDArray[Any]) -> _Stack:
    # One key orders by pixel, then depth: a third of the time of two, and fine to 1e-4 mm.
    order = np.argsort(pixel + depth / (1.0 + 2.0 * depth.max()))
    sorted_pixel = pixel[order]
    starts = _starts(sorted_pixel)
    place = np.cumsum(starts) - 1
    rank = np.arange(len(order)) - np.flatnonzero(starts)[place]
    nearest = order[starts]
    widest, last_owner = share[nearest], owner[nearest]
    light = widest * value[nearest]
    behind = np.ones(len(nearest))  # share of the pixel seen past all finished objects
    for step in range(1, int(rank.max(initial=0)) + 1):
        at = np.flatnonzero(rank == step)
        now, here = order[at], place[at]
        fresh = last_owner[here] != owner[now]
        behind[here] *= np.where(fresh, 1.0 - widest[here], 1.0)
        before = np.where(fresh, 0.0, widest[here])
        after = np.maximum(before, share[now])
        light[here] += behind[here] * (after - before) * value[now]
        widest[here], last_owner[here] = after, owner[now]
    return _Stack(sorted_pixel[starts], light, behind * (1.0 - widest), nearest)


def merged(row: Ints, column: Ints, share: Floats, depth_mm: Floats, value: NDArray[Any], along: Floats | None = None) -> Layer:
    """One object's layer from surfaces (n,) of which several may meet in a pixel."""
    if len(row) == 0:
        return Layer(row, column, share, depth_mm, value, along)
    left, top = int(column.min()), int(row.min())
    pixel = (row - top) * (int(column.max()) - left + 1) + column - left
    often = np.bincount(pixel)[pixel] > 1
    many = np.flatnonzero(often)
    if len(many) == 0:
        return Layer(row, column, share, depth_mm, value, along)
    once = np.flatnonzero(~often)
    stack = _stacked(pixel[many], share[many], depth_mm[many], np.zeros(len(many), dtype=np.intp), value[many])
    first = many[stack.nearest]
    keep = np.concatenate([once, first])
    covered = np.concatenate([share[once], 1.0 - stack.behind])
    mean = np.concatenate([value[once], stack.light / np.maximum(1.0 - stack.behind, 1e-12)])
    return Layer(row[keep], column[keep], covered, depth_mm[keep], mean.astype(value.dtype), None if along is None else along[keep])


def _starts(sorted_values: Ints) -> Bools:
    """True where a run of equal values begins."""
    starts = np.ones(len(sorted_values), dtype=np.bool_)
    starts[1:] = sorted_values[1:] != sorted_values[:-1]
    return starts
