"""Where a picture's brightness steps along short lines across an outline, to a small part of a
pixel, and how sure that is.

Strategy: linear intensities are sampled along each normal with cubic interpolation. For each place
on a fine grid the best step there is fitted in closed form: an inner and an outer level, a slope
outside, and inside the fall of brightness that a round matt body has near its limb, which goes with
the square root of the depth. The place with the least left over wins, refined by a parabola. The
strongest gradient alone would follow that fall instead of the outline. The module may not know
teats or cameras.

By how much the fall of brightness towards a body's limb moves its edges, told from both optical
pictures together.

Strategy: a step alone is found precisely, but where brightness falls towards the limb it is found
too far inside. A step with such a fall is found where it is, but far less precisely, since the fall
can stand in for a part of the shift. The difference between the two is the body's and the light's
doing, so that it is much the same in both pictures and for neighbours along the outline: averaged
over these it corrects the precise edges, and hardly moves the disparity between the pictures, on
which depth hangs. Where it is large, it isn't quite the same everywhere, and each line's own goes
in with a growing share. The module may not know teats or cameras.
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
    """Samples at ``reach_px`` to either side, ``step_px`` apart; edges are looked for up to
    ``search_px`` away, ``grid_px`` apart.

    ``blur_px``: the width (standard deviation) of an edge; ``limb``: whether brightness may rise
    with the square root inside, and lean outside.
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
        """Orthonormal basis (s, c) of what lines without an edge may look like: a level and a
        slope.
        """
        columns = [np.ones_like(self.offsets), self.offsets]
        return np.asarray(np.linalg.qr(np.column_stack(columns))[0])

    def _shapes(self, place: float) -> Array:
        """Columns: a level, a step (its height the second coefficient), and where ``limb``, the
        fall inside and the slope outside.
        """
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
    """One edge a line: ``offset_px`` outward of the middle, its standard deviation, and how clear
    it is; arrays of one shape.

    ``clarity``: by how much the step explains more than a straight line does, in variances of what
    it leaves over (a chi-square). An offset is NaN where there is none to be had. ``limb_px``: how
    much farther out the edge is than without a fall of brightness towards the limb; NaN where that
    edge is another one. ``limb_sd_px``: the noise of that (standard deviation), which is a part of
    the edge's.
    """

    offset_px: Array
    sd_px: Array
    clarity: Array
    limb_px: Array
    limb_sd_px: Array


def sample(field: Field, middles_px: Array, normals: Array, offsets_px: Array) -> Field:
    """Intensities (n, s) at ``offsets_px`` (s,) along ``normals`` (n, 2) from ``middles_px`` (n,
    2); NaN beyond the picture's edge.
    """
    rows, columns = field.shape
    middles, directions = (
        np.nan_to_num(middles_px, nan=-1e4).astype(np.float32),
        np.nan_to_num(normals).astype(np.float32),
    )
    along = offsets_px.astype(np.float32)
    x, y = (middles[:, i, None] + along * directions[:, i, None] for i in range(2))
    values = cv2.remap(field, x, y, cv2.INTER_CUBIC)
    ends = middles[:, None] + along[[0, -1], None] * directions[:, None]
    inside = np.all((ends >= 1) & (ends <= np.array([columns - 2, rows - 2])), axis=(1, 2))
    values[~inside] = np.nan
    return np.asarray(values, dtype=np.float32)


def find_edges(lines: Field, profile: Profile, noise: float) -> Edges:
    """The likeliest edge of each line (m, n, s) of m outlines of n neighbouring lines. ``noise``:
    standard deviation of an intensity.

    Where a line alone shows no clear edge, what its neighbours leave over is added to what it
    leaves over: along an outline the edge goes on. Such an edge is worth as much less as it shares
    with its neighbours.
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
    """The edge of each line from what steps (m * n, g) and a straight line (m * n,) leave over of
    it, or of it and its neighbours.

    Also which lines (m, n) are ``faint`` alone, unless that is known.
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
    """What is left over (sums of squares) of lines (n, s) by the best step at each place (n, g),
    without and with a limb, and by a straight line (n,).
    """
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
    """The place with the least left over (n, g), by a parabola; ``floor``: what noise alone leaves
    over of so many ``lines``.
    """
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
    """What the outlines (m, n) have in common of each line's ``own_px`` (views, m, n), which is NaN
    where it isn't known.
    """
    known = np.isfinite(own_px).sum(axis=0).astype(np.float64)
    total = np.nan_to_num(own_px).sum(axis=0)
    count = uniform_filter1d(known, _LIMB_NEIGHBOURS, axis=1, mode="nearest")
    return np.asarray(
        uniform_filter1d(total, _LIMB_NEIGHBOURS, axis=1, mode="nearest")
        / np.maximum(count, 0.5 / _LIMB_NEIGHBOURS)
    )


def own_share(shared_px: Array, own_sd_px: Array) -> Array:
    """What each line's own is worth in the best mean with the shared one, by how sure each is: 0 to
    1.

    ``own_sd_px``: by how much an edge's noise is the more for the fall of brightness.
    """
    unlike, noise = (_UNLIKE * shared_px) ** 2 + _PLAIN_PX**2, own_sd_px**2 + _SHADED_PX**2
    return np.asarray(unlike / (unlike + noise))
