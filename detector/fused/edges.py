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
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr

from detector.geometry import Array

Field = NDArray[np.float32]
_NEIGHBOURS = 7  # lines that may be taken together where one alone is too faint
# of an edge beyond doubt, and of one that may count: 7.7 and 4.2 standard deviations
CLEAR, LEAST_CLEAR = 60.0, 18.0
_DOUBT = 0.45  # neighbours share shadows and texture too: together they must be the clearer
_MOST_LIMB_PX = 0.8
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
    def bases(self) -> Field:
        """Orthonormal bases (g, s, c) of what a step at each place may look like."""
        return np.stack([np.linalg.qr(self._shapes(place))[0] for place in self.places]).astype(
            np.float32
        )

    @cached_property
    def flat(self) -> Array:
        """Orthonormal basis (s, c) of lines without an edge: a level and a slope."""
        columns = [np.ones_like(self.offsets), self.offsets]
        return np.asarray(np.linalg.qr(np.column_stack(columns))[0])

    def _shapes(self, place: float) -> Array:
        """Columns: level, step; with ``limb`` the fall and the outer slope."""
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
    """One edge a line, arrays of one shape: ``offset_px`` outward (NaN: none), its standard
    deviation.

    ``clarity``: gain over a straight line, in residual variances (a chi-square). ``limb_px``: how
    much farther out the edge with a fall is, NaN where that is another edge; ``limb_sd_px``: its
    noise, a part of the edge's.
    """

    offset_px: Array
    sd_px: Array
    clarity: Array
    limb_px: Array
    limb_sd_px: Array


def sample(field: Field, middles_px: Array, normals: Array, offsets_px: Array) -> Field:
    """Intensities (n, s) at ``offsets_px`` along ``normals`` from ``middles_px``; NaN outside."""
    rows, columns = field.shape
    middles = np.nan_to_num(middles_px, nan=-1e4).astype(np.float32)
    directions = np.nan_to_num(normals).astype(np.float32)
    along = offsets_px.astype(np.float32)
    x, y = (middles[:, i, None] + along * directions[:, i, None] for i in range(2))
    values = cv2.remap(field, x, y, cv2.INTER_CUBIC)
    ends = middles[:, None] + along[[0, -1], None] * directions[:, None]
    inside = np.all((ends >= 1) & (ends <= np.array([columns - 2, rows - 2])), axis=(1, 2))
    values[~inside] = np.nan
    return np.asarray(values, dtype=np.float32)


def find_edges(lines: Field, profile: Profile, noise: float) -> Edges:
    """The likeliest edge of each line (m, n, s): m outlines of n neighbouring lines. ``noise``: an
    intensity's sd.

    A line without a clear edge is joined with its neighbours' residuals, and its edge counts less
    for what they share.
    """
    plain, shaded, straight = _left_over(lines.reshape(-1, lines.shape[2]), profile)
    usable = np.isfinite(lines[..., 0])
    found, faint = _alone_or_together(shaded, straight, lines.shape, profile, noise)
    clarity = np.where(usable, found.clarity, 0.0)
    if not profile.limb:
        return Edges(
            np.where(usable, found.offset_px, np.nan),
            found.sd_px,
            clarity,
            found.limb_px,
            found.limb_px,
        )
    bare, _ = _alone_or_together(plain, straight, lines.shape, profile, noise, faint)
    limb = np.where(usable, found.offset_px - bare.offset_px, np.nan)
    limb = np.where(np.abs(np.nan_to_num(limb, nan=9.0)) < _MOST_LIMB_PX, limb, np.nan)
    more = np.sqrt(np.maximum(found.sd_px**2 - bare.sd_px**2, 0.0))
    return Edges(np.where(usable, found.offset_px, np.nan), found.sd_px, clarity, limb, more)


def _alone_or_together(
    left: Field,
    straight: Field,
    shape: tuple[int, ...],
    profile: Profile,
    noise: float,
    faint: NDArray[np.bool_] | None = None,
) -> tuple[Edges, NDArray[np.bool_]]:
    """Edges from residuals of steps (m * n, g) and straight lines (m * n,), alone or with
    neighbours; and which lines (m, n) are ``faint`` alone, unless given.
    """
    outlines = shape[:2]
    floor = np.float32(shape[2] * noise**2)
    alone = _likeliest(left, straight, floor, profile)
    values = [a.reshape(outlines) for a in (alone.offset_px, alone.sd_px, alone.clarity)]
    faint = values[2] < CLEAR if faint is None else faint
    some = np.flatnonzero(faint.any(axis=1))
    if len(some):
        total, shared = (_summed(a.reshape(*outlines, -1)[some]) for a in (left, straight))
        many = _likeliest(total, shared[:, 0], _NEIGHBOURS * floor, profile, _NEIGHBOURS)
        known = (
            many.offset_px,
            np.sqrt(_NEIGHBOURS) * many.sd_px,
            np.minimum(_DOUBT * many.clarity, 0.9 * CLEAR),
        )
        for value, of_many in zip(values, known, strict=True):
            value[some] = np.where(faint[some], of_many.reshape(len(some), -1), value[some])
    none = np.zeros(outlines)
    return Edges(values[0], values[1], values[2], none, none), faint


def _summed(values: Field) -> Field:
    """Values (m, n, g) of neighbouring lines added up, as (m * n, g)."""
    total = uniform_filter1d(values, _NEIGHBOURS, axis=1, mode="nearest") * np.float32(_NEIGHBOURS)
    return np.asarray(total.reshape(-1, values.shape[2]))


def _left_over(lines: Field, profile: Profile) -> tuple[Field, Field, Field]:
    """Residual sums of squares of lines (n, s): steps (n, g) without, with limb; straight (n,)."""
    y = np.where(np.isnan(lines), np.float32(0), lines)
    y -= y.mean(axis=1, keepdims=True)
    energy = np.einsum("ns,ns->n", y, y)
    g, s, c = profile.bases.shape
    along = (y @ profile.bases.transpose(1, 0, 2).reshape(s, g * c)).reshape(-1, g, c)
    along *= along
    plain = energy[:, None] - along[..., 0] - along[..., 1]
    shaded = plain - along[..., 2] - along[..., 3] if profile.limb else plain
    straight = energy - ((y @ profile.flat.astype(np.float32)) ** 2).sum(axis=1)
    return np.maximum(plain, 0), np.maximum(shaded, 0), np.maximum(straight, np.float32(1e-6))


def _likeliest(
    left: Field, straight: Field, floor: np.float32, profile: Profile, lines: int = 1
) -> Edges:
    """Place of least residual (n, g), by a parabola; ``floor``: by noise alone, of ``lines``."""
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
    none = np.zeros(len(left))
    return Edges(
        offset, np.sqrt(2.0 / bend) * profile.grid_px, np.where(interior, clarity, 0.0), none, none
    )


_LIMB_NEIGHBOURS = 9  # points along an outline that are lit alike: some 20 mm
# how far one line's own may be from that of its neighbours (standard deviation), as a share of it
_UNLIKE = 0.5
# how sure a step is found without a fall of brightness and with one (standard deviation)
_PLAIN_PX, _SHADED_PX = 0.02, 0.06


def shared_limb(own_px: Array) -> Array:
    """What outlines (m, n) share of ``own_px`` (views, m, n), NaN where unknown."""
    known = np.isfinite(own_px).sum(axis=0).astype(np.float64)
    total = np.nan_to_num(own_px).sum(axis=0)
    count = uniform_filter1d(known, _LIMB_NEIGHBOURS, axis=1, mode="nearest")
    return np.asarray(
        uniform_filter1d(total, _LIMB_NEIGHBOURS, axis=1, mode="nearest")
        / np.maximum(count, 0.5 / _LIMB_NEIGHBOURS)
    )


def own_share(shared_px: Array, own_sd_px: Array) -> Array:
    """Share 0 to 1 of each line's own in its weighted mean with the shared one. ``own_sd_px``: the
    extra noise of an edge by the fall of brightness.
    """
    unlike, noise = (_UNLIKE * shared_px) ** 2 + _PLAIN_PX**2, own_sd_px**2 + _SHADED_PX**2
    return np.asarray(unlike / (unlike + noise))
