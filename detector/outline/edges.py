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
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr

from detector.geometry import Array
from detector.outline import fast

Field = NDArray[np.float32]
_NEIGHBOURS = 7  # lines that may be taken together where one alone is too faint
# of an edge beyond doubt, and of one that may count: 7.7 and 4.2 standard deviations
CLEAR, LEAST_CLEAR = 60.0, 18.0
_DOUBT = 0.45  # neighbours share shadows and texture too: together they must be the clearer
_MOST_LIMB_PX = 0.8
_FINE = 0.05  # px, the grid on which the bases are blurred
# steps of a noise's standard deviation, and of the bases: products of both add up within 53 bits
_LEVELS, _BASES = 11, 2.0**24


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
        """Orthonormal bases (c * g, s) of what a step at each place may look like, without the
        level, which all have in common.
        """
        bases = np.stack([np.linalg.qr(self._shapes(place))[0][:, 1:] for place in self.places])
        rows = bases.transpose(2, 0, 1).reshape(-1, len(self.offsets))
        return np.ascontiguousarray(_rounded(rows, _BASES))

    @cached_property
    def flat(self) -> Array:
        """Orthonormal basis (c, s) of lines without an edge: a level and a slope."""
        columns = [np.ones_like(self.offsets), self.offsets]
        basis = np.linalg.qr(np.column_stack(columns))[0].T
        return np.ascontiguousarray(_rounded(basis, _BASES))

    @cached_property
    def pull(self) -> Field:
        """What a place (g,) costs for being far off."""
        return ((self.places / self.pull_px) ** 2).astype(np.float32)

    def _shapes(self, place: float) -> Array:
        """Columns: level, step; with ``limb`` the fall and the outer slope."""
        x = self.offsets - place
        step = ndtr(x / self.blur_px)
        columns = [np.ones_like(x), step]
        if self.limb:
            columns += [_blurred_root(-x, self.blur_px), x * step]
        return np.column_stack(columns)


def _rounded(values: Array, steps: Array | float) -> Array:
    """To whole ``steps`` a unit."""
    return np.asarray(np.rint(values * steps) / steps)


def _steps(noise: Array) -> Array:
    """Steps an intensity, powers of two."""
    return np.asarray(np.ldexp(1.0, 1 + _LEVELS - np.frexp(noise)[1]))


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
    if loops := fast.compiled():
        lines: Field = np.empty((len(middles_px), len(offsets_px)), dtype=np.float32)
        places = middles_px[None], normals[None], np.zeros(1, dtype=np.intp), 0, len(middles_px)
        sample_into(loops, lines, field, np.zeros(2), places, offsets_px)
        return lines
    rows, columns = field.shape
    middles = np.where(np.isnan(middles_px), -1e4, middles_px).astype(np.float32)
    directions = np.where(np.isnan(normals), 0.0, normals).astype(np.float32)
    along = offsets_px.astype(np.float32)
    x, y = (middles[:, i, None] + along * directions[:, i, None] for i in range(2))
    values = cv2.remap(field, x, y, cv2.INTER_CUBIC)
    first, last = (np.stack([x[:, end], y[:, end]]) for end in (0, -1))
    low, high = np.minimum(first, last), np.maximum(first, last)
    inside = ((low >= 1) & (high <= [[columns - 2], [rows - 2]])).all(axis=0)
    values[~inside] = np.nan
    return np.asarray(values, dtype=np.float32)


def sample_into(
    loops: ModuleType,
    lines: Field,
    field: Field,
    corner_px: Array,
    places: tuple[Array, Array, NDArray[np.intp], int, int],
    offsets_px: Array,
) -> None:
    """`sample` by compiled loops, into ``lines`` (n, s) of a field whose first pixel is at
    ``corner_px`` (2,). ``places``: middles and normals (., k, 2), which rows of these, and of each
    the first and how many.
    """
    rows, columns = field.shape
    x, y, inside = loops.places(*places, corner_px, offsets_px, rows, columns)
    cv2.remap(field, x, y, cv2.INTER_CUBIC, dst=lines)
    lines[~inside] = np.nan


def find_edges(lines: Field, profile: Profile, noise: Array | float) -> Edges:
    """The likeliest edge of each line (m, n, s): m outlines of n neighbouring lines. ``noise``: an
    intensity's sd, (m,) or of all.

    A line without a clear edge is joined with its neighbours' residuals, and its edge counts less
    for what they share.
    """
    m, n, _ = lines.shape
    usable, noises = np.isfinite(lines[..., 0]), np.array(np.broadcast_to(noise, m), dtype=float)
    offset, sd, clarity = _alone_or_together(lines, noises, profile)
    found, sure = np.where(usable, offset[0], np.nan), np.where(usable, clarity[0], 0.0)
    if not profile.limb:
        none = np.zeros((m, n))
        return Edges(found, sd[0], sure, none, none)
    limb = found - offset[1]
    limb[~(np.abs(limb) < _MOST_LIMB_PX)] = np.nan
    more = np.sqrt(np.maximum(sd[0] ** 2 - sd[1] ** 2, 0.0))
    return Edges(found, sd[0], sure, limb, more)


def find_edges_into(
    loops: ModuleType,
    lines: Field,
    profile: Profile,
    noise: Array,
    which: NDArray[np.intp],
    first: int,
    edges: tuple[Array, ...],
) -> None:
    """`find_edges` and `lit_alike` by compiled loops, of lines (views, m, n, s) and noise (views,):
    into rows ``which`` (m,) of offsets and so on (., k), from column ``first`` on.
    """
    loops.edges(
        lines, noise, _steps(noise), profile.rows, profile.flat, profile.places, profile.pull,
        profile.grid_px, _NEIGHBOURS, CLEAR, _DOUBT, LIGHT, which, first, *edges,
    )  # fmt: skip


def _alone_or_together(lines: Field, noise: Array, profile: Profile) -> tuple[Array, Array, Array]:
    """Offset, standard deviation and clarity (k, m, n) by each model, of lines (m, n, s)."""
    m, n, s = lines.shape
    left, straight = _left_over(lines.reshape(-1, s), profile, np.repeat(_steps(noise), n))
    floor = np.repeat((s * noise**2).astype(np.float32), n)
    values = _likeliest(left, straight, floor, profile)
    faint = values[2][0].reshape(m, n) < CLEAR
    if faint.any():
        # sums of outlines with a faint line, and of these lines the edges
        some = faint.any(axis=1)
        of_lines, these = np.flatnonzero(faint), np.flatnonzero(faint[some])
        total = _summed(left.reshape(*left.shape[:2], m, n)[:, :, some])
        joint = total.reshape(*left.shape[:2], -1)[:, :, these]
        shared = _summed(straight.reshape(m, n)[some]).ravel()[these]
        least = _NEIGHBOURS * floor[of_lines]
        offset, sd, clarity = _likeliest(joint, shared, least, profile, _NEIGHBOURS)
        values[0][:, of_lines], values[1][:, of_lines] = offset, sd * np.sqrt(_NEIGHBOURS)
        values[2][:, of_lines] = np.minimum(_DOUBT * clarity, 0.9 * CLEAR)
    offset, sd, clarity = (a.reshape(-1, m, n) for a in values)
    return offset, sd, clarity


def _summed(values: Field) -> Field:
    """Values (..., n) of neighbouring lines added up."""
    total = uniform_filter1d(values, _NEIGHBOURS, mode="nearest")
    return np.asarray(total * np.float32(_NEIGHBOURS))


def _left_over(lines: Field, profile: Profile, steps: Array) -> tuple[Field, Field]:
    """Residual sums of squares of lines (n, s): steps (k, g, n), with limb where the profile has
    it, and without; straight (n,). They are small differences of large sums, which are exact: no
    answer hangs on the order in which a processor adds. ``steps`` (n,) an intensity.
    """
    y = np.where(np.isnan(lines), 0.0, lines.astype(np.float64))
    y = _rounded(y - y.mean(axis=1, keepdims=True), steps[:, None])
    energy = np.einsum("ns,ns->n", y, y)
    along = (profile.rows @ y.T).reshape(-1, len(profile.places), len(y))
    along *= along
    level, slope = (profile.flat @ y.T) ** 2
    left = np.empty((1 + profile.limb, *along.shape[1:]), dtype=np.float32)
    rest = energy - level - along[0]
    np.maximum(rest, 0, out=left[-1], casting="same_kind")
    if profile.limb:
        np.maximum(rest - along[1] - along[2], 0, out=left[0], casting="same_kind")
    straight = energy - (level + slope)
    return left, np.maximum(straight, 1e-6).astype(np.float32)


def _likeliest(
    left: Field, straight: Field, floor: Field, profile: Profile, lines: int = 1
) -> tuple[Array, Array, Array]:
    """Offset (NaN: none), standard deviation and clarity (k, n) at the places of least residual
    (k, g, n), by a parabola; ``floor`` (n,): by noise alone, of ``lines``.
    """
    k, g, n = left.shape
    scale = np.maximum(left.min(axis=1), floor) / (len(profile.offsets) * lines)
    cost = left / scale[:, None]
    cost += profile.pull[:, None]
    best = np.argmin(cost, axis=1)
    inner = np.minimum(np.maximum(best, 1), g - 2)
    first = np.arange(k)[:, None] * (g * n) + np.arange(n)
    at, flat = first + inner * n, cost.ravel()
    before, here, after = (flat[at + d].astype(np.float64) for d in (-n, 0, n))
    bend = np.maximum(before - 2 * here + after, 1e-9)
    shift = np.minimum(np.maximum(0.5 * (before - after) / bend, -1), 1)
    interior = best == inner
    offset = np.where(interior, profile.places[inner] + shift * profile.grid_px, np.nan)
    clarity = ((straight - left.ravel()[first + best * n]) / scale).astype(np.float64)
    return offset, np.sqrt(2.0 / bend) * profile.grid_px, np.where(interior, clarity, 0.0)


_LIMB_NEIGHBOURS = 9  # points along an outline that are lit alike: some 20 mm
# how far one line's own may be from that of its neighbours (standard deviation), as a share of it
_UNLIKE = 0.5
# how sure a step is found without a fall of brightness and with one (standard deviation)
_PLAIN_PX, _SHADED_PX = 0.02, 0.06
LIGHT = np.array([_MOST_LIMB_PX, _LIMB_NEIGHBOURS, _UNLIKE, _PLAIN_PX, _SHADED_PX])


@dataclass(frozen=True)
class LitEdges:
    """Edges after `lit_alike`. ``limb_px``: by how much brightness that falls towards the limb
    moved the edges hereabouts; ``unlike_px``: how much farther out a line's own would put its edge.
    """

    offset_px: Array
    sd_px: Array
    clarity: Array
    limb_px: Array
    unlike_px: Array


def lit_alike(edges: Edges) -> LitEdges:
    """Edges (views, m, n) corrected by the outlines' common fall of brightness."""
    shared_px = shared_limb(edges.limb_px)
    own = own_share(shared_px, edges.limb_sd_px)
    known = np.isfinite(edges.limb_px)
    unlike = np.where(known, (1 - own) * (edges.limb_px - shared_px), 0.0)
    sd = np.sqrt(edges.sd_px**2 - np.where(known, (1 - own**2) * edges.limb_sd_px**2, 0.0))
    limb = np.broadcast_to(shared_px, sd.shape)
    return LitEdges(edges.offset_px - unlike, sd, edges.clarity, limb, unlike)


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
