"""Where a picture's brightness steps along short lines across an outline, to a small part of a pixel, and how sure that is.

Strategy: linear intensities are sampled along each normal with cubic interpolation. For each place on a fine grid the best step there is
fitted in closed form: an inner and an outer level, a slope outside, and inside the fall of brightness that a round matt body has near its limb,
which goes with the square root of the depth. The place with the least left over wins, refined by a parabola. A line
through the strongest gradient would follow that fall instead of the outline. The module may not know teats or cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from detector.geometry import Array

Field = NDArray[np.float32]
_FINE = 0.05  # px, the grid on which the bases are blurred


@dataclass(frozen=True)
class Profile:
    """Samples at ``reach_px`` to either side, ``step_px`` apart; edges are looked for up to ``search_px`` away, ``grid_px`` apart.

    ``blur_px``: the width (standard deviation) of an edge; ``limb``: whether brightness may rise with the square root inside, and lean outside.
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
        return np.arange(-half, half + 1) * self.step_px

    @cached_property
    def places(self) -> Array:
        """Where edges (g,) are looked for along the outward normal, px."""
        half = round(self.search_px / self.grid_px)
        return np.arange(-half, half + 1) * self.grid_px

    @cached_property
    def bases(self) -> Array:
        """Orthonormal bases (g, s, c) of what a step at each place may look like."""
        return np.stack([np.linalg.qr(self._shapes(place))[0] for place in self.places])

    @cached_property
    def flat(self) -> Array:
        """Orthonormal basis (s, c) of what lines without an edge may look like: a level and a slope."""
        columns = [np.ones_like(self.offsets), self.offsets]
        return np.asarray(np.linalg.qr(np.column_stack(columns))[0])

    @cached_property
    def contrasts(self) -> Array:
        """Rows (g, s) that give the height of the step, outer less inner, at each place."""
        return np.stack([np.linalg.pinv(self._shapes(place))[1] for place in self.places])

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
    """One edge a line: ``offset_px`` (n,) outward of the middle, its standard deviation, and how much better it is than no edge.

    ``gain``: the share of what a straight line leaves over that the step explains. ``contrast``: outer less inner level. An offset is NaN where
    there is none to be had.
    """

    offset_px: Array
    sd_px: Array
    gain: Array
    contrast: Array


def sample(field: Field, middles_px: Array, normals: Array, offsets_px: Array) -> Array:
    """Intensities (n, s) at ``offsets_px`` (s,) along ``normals`` (n, 2) from ``middles_px`` (n, 2); NaN beyond the picture's edge."""
    at = middles_px[:, None, :] + offsets_px[None, :, None] * normals[:, None, :]
    maps = np.nan_to_num(at, nan=-1e4).astype(np.float32)
    rows, columns = field.shape
    values = cv2.remap(field, np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1]), cv2.INTER_CUBIC)
    inside = (at[..., 0] >= 1) & (at[..., 0] <= columns - 2) & (at[..., 1] >= 1) & (at[..., 1] <= rows - 2)
    return np.where(inside, values, np.nan)


def find_edges(lines: Array, profile: Profile, noise: float) -> Edges:
    """The likeliest edge of each line (n, s). ``noise``: standard deviation of an intensity."""
    usable = np.isfinite(lines).all(axis=1)
    y = np.where(usable[:, None], lines, 0.0)
    y = y - y.mean(axis=1, keepdims=True)
    energy = np.einsum("ns,ns->n", y, y)
    g, s, c = profile.bases.shape
    along = (y @ profile.bases.transpose(1, 0, 2).reshape(s, g * c)).reshape(-1, g, c)
    left = np.clip(energy[:, None] - np.einsum("ngc,ngc->ng", along, along), 0, None)
    straight = np.clip(energy - ((y @ profile.flat) ** 2).sum(axis=1), 1e-12, None)
    floor = s * noise**2
    scale = np.maximum(left.min(axis=1), floor) / s
    cost = left / scale[:, None] + (profile.places / profile.pull_px) ** 2
    best = np.argmin(cost, axis=1)
    inner = np.clip(best, 1, g - 2)
    rows = np.arange(len(y))
    before, here, after = (cost[rows, inner + d] for d in (-1, 0, 1))
    bend = np.clip(before - 2 * here + after, 1e-9, None)
    shift = np.clip(0.5 * (before - after) / bend, -1, 1)
    interior = (best > 0) & (best < g - 1) & usable
    offset = np.where(interior, profile.places[inner] + shift * profile.grid_px, np.nan)
    sd = np.sqrt(2.0 / bend) * profile.grid_px
    gain = 1 - (left[rows, best] + floor) / (straight + floor)
    contrast = np.einsum("ns,ns->n", y, profile.contrasts[best])
    return Edges(offset, sd, np.where(interior, gain, 0.0), contrast)
