"""Where a picture's brightness steps along short lines across an outline, to a small part of a pixel, and how sure that is.

Strategy: linear intensities are sampled along each normal with cubic interpolation. For each place on a fine grid the best step there is
fitted in closed form: an inner and an outer level, a slope outside, and inside the fall of brightness that a round matt body has near
its limb, which goes with the square root of the depth. The place with the least left over wins, refined by a parabola. The strongest
gradient alone would follow that fall instead of the outline. The module may not know teats or cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr

from detector.geometry import Array

Field = NDArray[np.float32]
_NEIGHBOURS = 7  # lines that may be taken together where one alone is too faint
CLEAR, LEAST_CLEAR = 60.0, 18.0  # of an edge beyond doubt, and of one that may count: 7.7 and 4.2 standard deviations
_DOUBT = 0.45  # neighbours share shadows and texture too: together they must be the clearer
_FINE = 0.05  # px, the grid on which the bases are blurred


@dataclass(frozen=True)
class Profile:
    """Samples at ``reach_px`` to either side, ``step_px`` apart; edges are looked for up to ``search_px`` away,
    ``grid_px`` apart.

    ``blur_px``: the width (standard deviation) of an edge; ``limb``: whether brightness may rise with the square root inside,
    and lean outside.
    """

    reach_px: float
    step_px: float
    search_px: float
    grid_px: float
    blur_px: float
    limb: bool
    pull_px: float  # how far off an edge may easily be

    @cached_property
    def offsets(self) -> Array:
        """Where the samples (s,) lie along the outward normal, px."""
        half = round(self.reach_px / self.step_px)
        return np.arange(-half, half + 1, dtype=np.float64) * self.step_px

    @cached_property
    def places(self) -> Array:
        """Where edges (g,) are looked for along the outward normal, px."""
        half = round(self.search_px / self.grid_px)
        return np.arange(-half, half + 1, dtype=np.float64) * self.grid_px

    @cached_property
    def bases(self) -> Field:
        """Orthonormal bases (g, s, c) of what a step at each place may look like."""
        return np.stack([np.linalg.qr(self._shapes(place))[0] for place in self.places]).astype(np.float32)

    @cached_property
    def flat(self) -> Array:
        """Orthonormal basis (s, c) of what lines without an edge may look like: a level and a slope."""
        columns = [np.ones_like(self.offsets), self.offsets]
        return np.asarray(np.linalg.qr(np.column_stack(columns))[0])

    def _shapes(self, place: float) -> Array:
        """Columns: a level, a step (its height the second coefficient), and where ``limb``, the fall inside and the slope outside."""
        x = self.offsets - place
        step = ndtr(x / self.blur_px)
        columns = [np.ones_like(x), step]
        if self.limb:
            columns += [_blurred_root(-x, self.blur_px), x * step]
        return np.column_stack(columns)


def _blurred_root(depth: Array, blur: float) -> Array:
    """sqrt(max(depth, 0)) after a Gaussian blur."""
    t = np.arange(-4 * blur, 4 * blur + _FINE / 2, _FINE)
    weight = np.exp(-0.5 * (t / blur) ** 2)
    return np.asarray(np.sqrt(np.clip(depth[:, None] - t, 0, None)) @ (weight / weight.sum()))


@dataclass(frozen=True)
class Edges:
    """One edge a line: ``offset_px`` outward of the middle, its standard deviation, and how clear it is; arrays of one shape.

    ``clarity``: by how much the step explains more than a straight line does, in variances of what it leaves over (a chi-square).
    An offset is NaN where there is none to be had.
    """

    offset_px: Array
    sd_px: Array
    clarity: Array


def sample(field: Field, middles_px: Array, normals: Array, offsets_px: Array) -> Field:
    """Intensities (n, s) at ``offsets_px`` (s,) along ``normals`` (n, 2) from ``middles_px`` (n, 2); NaN beyond the picture's edge."""
    rows, columns = field.shape
    middles, directions = np.nan_to_num(middles_px, nan=-1e4).astype(np.float32), np.nan_to_num(normals).astype(np.float32)
    along = offsets_px.astype(np.float32)
    x, y = (middles[:, i, None] + along * directions[:, i, None] for i in range(2))
    values = cv2.remap(field, x, y, cv2.INTER_CUBIC)
    ends = middles[:, None] + along[[0, -1], None] * directions[:, None]
    inside = np.all((ends >= 1) & (ends <= np.array([columns - 2, rows - 2])), axis=(1, 2))
    values[~inside] = np.nan
    return np.asarray(values, dtype=np.float32)


def find_edges(lines: Field, profile: Profile, noise: float) -> Edges:
    """The likeliest edge of each line (m, n, s) of m outlines of n neighbouring lines. ``noise``: standard deviation of an intensity.

    Where a line alone shows no clear edge, what its neighbours leave over is added to what it leaves over: along an outline the edge
    goes on. Such an edge is worth as much less as it shares with its neighbours.
    """
    left, straight = _left_over(lines.reshape(-1, lines.shape[2]), profile)
    floor = np.float32(lines.shape[2] * noise**2)
    alone = _likeliest(left, straight, floor, profile)
    shape = lines.shape[:2]
    total = uniform_filter1d(left.reshape(*shape, -1), _NEIGHBOURS, axis=1, mode="nearest").reshape(left.shape) * _NEIGHBOURS
    shared = uniform_filter1d(straight.reshape(shape), _NEIGHBOURS, axis=1, mode="nearest").ravel() * _NEIGHBOURS
    together = _likeliest(total, shared, _NEIGHBOURS * floor, profile, _NEIGHBOURS)
    faint = (alone.clarity < CLEAR).reshape(shape)
    spread = np.sqrt(_NEIGHBOURS)
    usable = np.isfinite(lines[..., 0])
    return Edges(
        np.where(usable, np.where(faint, together.offset_px.reshape(shape), alone.offset_px.reshape(shape)), np.nan),
        np.where(faint, spread * together.sd_px.reshape(shape), alone.sd_px.reshape(shape)),
        np.where(
            usable, np.where(faint, np.minimum(_DOUBT * together.clarity, 0.9 * CLEAR).reshape(shape), alone.clarity.reshape(shape)), 0.0
        ),
    )


def _left_over(lines: Field, profile: Profile) -> tuple[Field, Field]:
    """What the best step at each place (n, g), and what a straight line (n,), leave over of lines (n, s): sums of squares."""
    y = np.nan_to_num(lines, nan=0.0)
    y -= y.mean(axis=1, keepdims=True)
    energy = np.einsum("ns,ns->n", y, y)
    g, s, c = profile.bases.shape
    along = (y @ profile.bases.transpose(1, 0, 2).reshape(s, g * c)).reshape(-1, g, c)
    left = np.maximum(energy[:, None] - np.einsum("ngc,ngc->ng", along, along), 0)
    return left, np.maximum(energy - ((y @ profile.flat.astype(np.float32)) ** 2).sum(axis=1), np.float32(1e-6))


def _likeliest(left: Field, straight: Field, floor: np.float32, profile: Profile, lines: int = 1) -> Edges:
    """The place with the least left over (n, g), by a parabola; ``floor``: what noise alone leaves over of so many ``lines``."""
    g, s, _ = profile.bases.shape
    scale = np.maximum(left.min(axis=1), floor) / (s * lines)
    cost = left / scale[:, None] + ((profile.places / profile.pull_px) ** 2).astype(np.float32)
    best = np.argmin(cost, axis=1)
    inner = np.clip(best, 1, g - 2)
    rows = np.arange(len(left))
    before, here, after = (cost[rows, inner + d].astype(np.float64) for d in (-1, 0, 1))
    bend = np.maximum(before - 2 * here + after, 1e-9)
    shift = np.clip(0.5 * (before - after) / bend, -1, 1)
    interior = (best > 0) & (best < g - 1)
    offset = np.where(interior, profile.places[inner] + shift * profile.grid_px, np.nan)
    clarity = (straight - left[rows, best]) / scale
    return Edges(offset, np.sqrt(2.0 / bend) * profile.grid_px, np.where(interior, clarity, 0.0))
