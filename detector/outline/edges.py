"""Sub-pixel edges along short lines across an outline, their uncertainty, and the shift by limb
darkening.

At each place on a fine grid a step is fitted in closed form: two levels, a slope outside, and
inside a fall of brightness with the square root of depth, as near a round matt body's limb. The
least residual wins.

A step alone is precise but too far inside where brightness falls; with the fall it is right but
imprecise. Their difference is shared by neighbours and pictures, so its mean corrects the precise
edges and hardly moves disparity; where it is large, each line's own gets a growing share.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from detector import outline as package
from detector.geometry import Array

Field = NDArray[np.float32]
_NEIGHBOURS = 7  # lines that may be taken together where one alone is too faint
CLEAR = 60.0  # of an edge beyond doubt: 7.7 standard deviations
LEAST_CLEAR = 18.0  # of an edge that may count: 4.2 standard deviations
_DOUBT = 0.45  # neighbours share shadows and texture too: together they must be the clearer
_MOST_LIMB_PX = 0.8
_LIMB_NEIGHBOURS = 9  # points along an outline that are lit alike: some 20 mm
# how far one line's own may be from that of its neighbours (standard deviation), as a share of it
_UNLIKE = 0.5
_PLAIN_PX = 0.02  # standard deviation of a step's place without a fall of brightness
_SHADED_PX = 0.06  # the same with one
_LIGHT = np.array([_MOST_LIMB_PX, _LIMB_NEIGHBOURS, _UNLIKE, _PLAIN_PX, _SHADED_PX])
_FINE = 0.05  # px, the grid on which the bases are blurred


@dataclass(frozen=True)
class Profile:
    """Samples ``reach_px`` to either side, ``step_px`` apart; edges up to ``search_px`` away on
    ``grid_px``. ``blur_px``: an edge's standard deviation; ``limb``: with a fall inside and a slope
    outside.
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
    def rows(self) -> Array:
        """Orthonormal bases (c * g + 1, s) of what a step at each place may look like, without the
        level, which all have in common; and of lines without an edge, a slope.
        """
        bases = np.stack([np.linalg.qr(self._shapes(place))[0][:, 1:] for place in self.places])
        rows = bases.transpose(2, 0, 1).reshape(-1, len(self.offsets))
        return np.vstack([rows, self.offsets / np.linalg.norm(self.offsets)])

    @cached_property
    def pull(self) -> Field:
        """What a place (g,) costs for being far off."""
        return ((self.places / self.pull_px) ** 2).astype(np.float32)

    def _shapes(self, place: float) -> Array:
        """Columns: level, step; with ``limb`` the fall and the outer slope."""
        x = self.offsets - place
        step = scipy.special.ndtr(x / self.blur_px)
        columns = [np.ones_like(x), step]
        if self.limb:
            columns += [_blurred_root(-x, self.blur_px), x * step]
        return np.column_stack(columns)


def _blurred_root(depth: Array, blur: float) -> Array:
    """sqrt(max(depth, 0)) after a Gaussian blur."""
    t = np.arange(-4 * blur, 4 * blur + _FINE / 2, _FINE)
    weight = np.exp(-0.5 * (t / blur) ** 2)
    return np.asarray(np.sqrt(np.clip(depth[:, None] - t, 0, None)) @ (weight / weight.sum()))


def sample(
    field: Field, middles_px: Array, normals: Array, offsets_px: Array, into: Field | None = None
) -> Field:
    """Intensities (n, s) at ``offsets_px`` along ``normals`` from ``middles_px``; NaN outside."""
    ways = np.stack([normals.T, middles_px.T], axis=-1, dtype=np.float32)
    steps = np.stack([offsets_px, np.ones_like(offsets_px)], dtype=np.float32)
    x, y = maps = ways @ steps
    last = np.array(field.shape[::-1])[:, None, None] - 2
    rims = maps[:, :, [0, -1]]
    inside = ((rims >= 1) & (rims <= last)).all(axis=(0, 2))
    lines = np.asarray(cv2.remap(field, x, y, cv2.INTER_CUBIC, dst=into), dtype=np.float32)
    lines[~inside] = np.nan
    return lines


def find_edges(lines: Field, profile: Profile, noise: Array) -> list[Array]:
    """The likeliest edge of each line (views, m, n, s): m outlines of n neighbouring lines, noise
    (views,): five arrays (m, views * n):
    ``offset_px`` outward (NaN: none); its standard deviation; ``clarity``: gain over a straight
    line, in residual variances (a chi-square); ``limb_px``: by how much brightness that falls
    towards the limb moved the edges hereabouts; ``unlike_px``: how much farther out a line's own
    would put its edge.

    A line without a clear edge is joined with its neighbours' residuals, and its edge counts less
    for what they share.
    """
    views, m, n, _ = lines.shape
    found = np.empty((3, 2 if profile.limb else 1, m, views, n))
    package.kernels.edges(
        lines, noise, profile.rows, (profile.places, profile.pull, profile.grid_px),
        (_NEIGHBOURS, CLEAR, _DOUBT), found,
    )  # fmt: skip
    beyond = np.isnan(lines[..., 0]).swapaxes(0, 1)
    found[0, 0, beyond], found[2, 0, beyond] = np.nan, 0.0
    light = np.zeros((2, m, views, n))
    if profile.limb:
        package.kernels.light_alike(found, _LIGHT, light)
    return [edge.reshape(m, views * n) for edge in (*found[:, 0], *light)]
