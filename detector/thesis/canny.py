"""Matlab's `edge(picture, 'canny', [], sigma)` of 2009, when the thesis was written.

A Gaussian, then derivative-of-Gaussian filters of the same sigma (2011's blurs once and keeps this
as 'canny_old'), thresholds from a histogram of gradient lengths, ridges, hysteresis, one thinning.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

# kernels end where the Gaussian falls below this part of its peak, if their greatest reach lets
# them
_DIE_OFF = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """The edge mask (rows, columns) and thresholds as parts of the greatest gradient."""

    mask: Mask
    low: float
    high: float


def canny(
    picture: NDArray[np.uint8],
    sigma_px: float,
    reach_px: int,
    not_edges: float,
    bins: int,
    ratio: float,
) -> Edges:
    """Edges of a grey picture (rows, columns), automatic thresholds; none in a uniform one."""
    if picture.min() == picture.max():
        return Edges(np.zeros(picture.shape, dtype=np.bool_), 0.0, 0.0)
    gx, gy = gradient(picture, sigma_px, reach_px)
    length = np.asarray(cv2.magnitude(gx, gy), dtype=np.float32)
    length /= max(float(length.max()), float(np.finfo(np.float32).tiny))
    high = automatic_threshold(length, not_edges, bins)
    low = ratio * high
    weak = ridges(gx, gy, length, low)
    return Edges(thin_once(hysteresis(weak, weak & (length > high))), low, high)


def kernels(sigma_px: float, reach_px: int) -> tuple[Single, Single]:
    """A Gaussian of sum one and its slope kernel, (2 w + 1,) each, w at most reach_px. Correlation:
    brighter along the axis is positive.
    """
    t = np.arange(-reach_px, reach_px + 1, dtype=np.float64)
    t = t[(np.exp(-(t * t) / (2 * sigma_px**2)) > _DIE_OFF) | (np.abs(t) <= 1)]
    gauss = np.exp(-(t * t) / (2 * sigma_px**2))
    return (gauss / gauss.sum()).astype(np.float32), (t * gauss / (t * t * gauss).sum()).astype(
        np.float32
    )


def gradient(picture: NDArray[np.uint8], sigma_px: float, reach_px: int) -> tuple[Single, Single]:
    """Slopes along columns and rows, grey levels a px, smoothed twice; borders replicate."""
    gauss, slope = kernels(sigma_px, reach_px)
    border = cv2.BORDER_REPLICATE
    smooth = cv2.sepFilter2D(
        picture.astype(np.float32), cv2.CV_32F, gauss, gauss, borderType=border
    )
    gx = cv2.sepFilter2D(smooth, cv2.CV_32F, slope, gauss, borderType=border)
    gy = cv2.sepFilter2D(smooth, cv2.CV_32F, gauss, slope, borderType=border)
    return np.asarray(gx, dtype=np.float32), np.asarray(gy, dtype=np.float32)


def automatic_threshold(length: NDArray[np.floating], not_edges: float, bins: int) -> float:
    """Of lengths in 0..1: the upper end of the first bin below which more than `not_edges` of all
    pixels lie. As imhist, bin k of n is centred on k / (n - 1): the outermost bins are half as
    wide.
    """
    counts = np.bincount((length.ravel() * (bins - 1) + 0.5).astype(np.intp), minlength=bins)
    above = np.cumsum(counts) > not_edges * length.size
    return float(np.argmax(above) + 1) / bins


def ridges(gx: Single, gy: Single, length: Single, low: float) -> Mask:
    """Pixels above `low` with no longer gradient on either side across the edge; never the
    outermost. Neighbours are interpolated between the two pixels on the gradient's way.
    """
    keep = np.zeros(length.shape, dtype=np.bool_)
    rows, columns = np.nonzero(length[1:-1, 1:-1] > low)
    rows, columns = rows + 1, columns + 1
    u, v, here = gx[rows, columns], gy[rows, columns], length[rows, columns]
    steep = np.abs(v) > np.abs(u)
    along_x, along_y = np.sign(u).astype(np.intp), np.sign(v).astype(np.intp)
    # the diagonal neighbour's share; the gradient here is longer than low >= 0, so never 0 / 0
    share = np.minimum(np.abs(u), np.abs(v)) / np.maximum(np.abs(u), np.abs(v))
    straight_row, straight_column = np.where(steep, along_y, 0), np.where(steep, 0, along_x)
    ridge = np.ones(len(rows), dtype=np.bool_)
    for side in (1, -1):
        straight = length[rows + side * straight_row, columns + side * straight_column]
        diagonal = length[rows + side * along_y, columns + side * along_x]
        ridge &= here >= straight * (1 - share) + diagonal * share
    keep[rows[ridge], columns[ridge]] = True
    return keep


def hysteresis(weak: Mask, strong: Mask) -> Mask:
    """The 8-connected groups of weak pixels that hold a strong one."""
    count, labels = cv2.connectedComponents(weak.astype(np.uint8), connectivity=8)
    held = np.zeros(count, dtype=np.bool_)
    held[labels[strong]] = True
    held[0] = False
    return np.asarray(held[labels])


def thin_once(mask: Mask) -> Mask:
    """One pass of parallel thinning, as bwmorph(…, 'thin', 1) (Guo and Hall 1989; Lam, Lee and Suen
    1992).
    """
    return _half_step(_half_step(mask, first=True), first=False)


def _half_step(mask: Mask, *, first: bool) -> Mask:
    """Remove pixels that end and join nothing, south-east (first) or north-west."""
    padded = np.pad(mask, 1)
    rows, columns = np.nonzero(mask)
    # counter-clockwise from the east, as the papers number them: x1 = E, x2 = NE, ... x8 = SE
    around = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
    x = [padded[rows + 1 + dr, columns + 1 + dc] for dr, dc in around]
    crossings = sum((~x[i] & (x[i + 1] | x[(i + 2) % 8])).astype(np.intp) for i in (0, 2, 4, 6))
    pairs_a = sum((x[i] | x[i + 1]).astype(np.intp) for i in (0, 2, 4, 6))
    pairs_b = sum((x[i + 1] | x[(i + 2) % 8]).astype(np.intp) for i in (0, 2, 4, 6))
    fewest = np.minimum(pairs_a, pairs_b)
    side = (x[1] | x[2] | ~x[7]) & x[0] if first else (x[5] | x[6] | ~x[3]) & x[4]
    gone = (crossings == 1) & (fewest >= 2) & (fewest <= 3) & ~side
    result = mask.copy()
    result[rows[gone], columns[gone]] = False
    return result
