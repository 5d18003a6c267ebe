"""Joint robust fit of teats to the outlines in all pictures, for many starts at once.

Damped Gauss-Newton on edge distances along the outlines' normals, edges found anew at each step;
weak priors on size, lean, taper and height. Derivatives are closed forms.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, fields
from functools import cache
from itertools import groupby
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array, Camera, Motion
from detector.outline import fast
from detector.outline.edges import (
    LEAST_CLEAR,
    Edges,
    Field,
    LitEdges,
    Profile,
    find_edges,
    find_edges_into,
    lit_alike,
    sample,
    sample_into,
)
from detector.outline.model import (
    COUNT,
    HEIGHT,
    LEAN_X,
    LEAN_Z,
    RADIUS,
    STEP_MM,
    Outline,
    Rows,
    axes,
    outlines,
)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A picture's region as linear intensities, its first pixel's place, and its camera. ``rough``,
    ``fine``: profiles of edges; ``floor_px``: sd of edges beyond noise.
    """

    field: Field
    corner_px: Array  # (2,)
    noise: float
    camera: Camera
    camera_from_teats: Motion
    rough: Profile
    fine: Profile
    floor_px: float
    # fx, fy, cx, cy, k1, k2, p1, p2, k3, skew; the motion's matrix and translation: (22,)
    numbers: Array = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        camera, motion = self.camera, self.camera_from_teats
        numbers = np.concatenate([camera.lens, [camera.alpha_c], motion.R.ravel(), motion.T])
        object.__setattr__(self, "numbers", numbers)


@dataclass(frozen=True, slots=True)
class Prior:
    """Mean and sd of radius (mm); sd of lean (slope) and taper about 0, of height about 1."""

    radius_mm: float = 11.0
    radius_sd_mm: float = 1.7
    lean_sd: float = 0.2
    taper_sd: float = 0.006
    height_sd: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Seen(Rows):
    """Edges about the outlines of m teats, ``n`` points a view: (m, views * n) each."""

    offset_px: Array
    sd_px: Array
    clarity: Array
    floor_px: Array
    # (m, views * n, 8): how far the outline moves outward, px a unit of each parameter
    jacobian: Array
    pixels_px: Array  # (m, views * n, 2)
    normals: Array
    limb_px: Array  # by how much brightness that falls towards the limb moved the edges hereabouts
    unlike_px: Array  # how much farther out a line's own would put its edge

    @classmethod
    def empty(cls, m: int, n: int, views: tuple[View, ...]) -> Seen:
        """Of m outlines of n points, before anything is looked at; Jacobians are zero."""
        k = len(views) * n
        offset, sd, clarity, limb, unlike = np.empty((5, m, k))
        floor = np.empty((m, k))
        floor[:] = np.repeat([view.floor_px for view in views], n)
        pixels, normals = np.empty((2, m, k, 2))
        jacobian = np.zeros((m, k, COUNT))
        return cls(offset, sd, clarity, floor, jacobian, pixels, normals, limb, unlike)

    def copied(self) -> Seen:
        """The same, but for Jacobian and floor in arrays of its own."""
        kept = {"jacobian", "floor_px"}
        values = ((name, getattr(self, name)) for name in self.__slots__)
        return Seen(*(value if name in kept else value.copy() for name, value in values))


def look(
    teats: Array,
    views: tuple[View, ...],
    outline: Outline,
    *,
    fine: bool,
    slopes_too: bool = True,
    known: Seen | None = None,
    which: NDArray[np.intp] | None = None,
) -> Seen:
    """Edges about teats (m, 8); their Jacobian is zero unless asked for. With ``known`` edges about
    teats nearby: anew of teats ``which`` in ``views``, which are the first of the known ones'; the
    rest and the Jacobian are those known.
    """
    n = len(outline.part)
    if loops := fast.compiled():
        return _look(loops, teats, views, outline, fine, slopes_too, known, which)
    some = teats if which is None else teats[which]
    cameras = [(view.camera, view.camera_from_teats) for view in views]
    pixels, normals, slopes = outlines(
        some, cameras, outline, slopes_too=slopes_too and known is None
    )
    profiles = [view.fine if fine else view.rough for view in views]
    found, first = list[LitEdges](), 0
    for profile, alike in groupby(profiles):  # both optical pictures together
        at = slice(first, first := first + len(list(alike)))
        found.append(lit_alike(_edges(views[at], profile, pixels[at], normals[at])))
    offset, sd, clarity, limb, unlike = (
        np.concatenate([getattr(edges, f.name) for edges in found]) for f in fields(LitEdges)
    )
    floor = np.broadcast_to(np.array([v.floor_px for v in views])[:, None, None], offset.shape)
    values = (offset, sd, clarity, floor, slopes, pixels, normals, limb, unlike)
    seen = Seen(*(a.swapaxes(0, 1).reshape(len(some), -1, *a.shape[3:]) for a in values))
    if known is None:
        return seen
    changed = known.copied()
    for name in set(Seen.__slots__) - {"jacobian", "floor_px"}:
        getattr(changed, name)[which, : len(views) * n] = getattr(seen, name)
    return changed


def _look(
    loops: ModuleType,
    teats: Array,
    views: tuple[View, ...],
    outline: Outline,
    fine: bool,
    slopes_too: bool,
    known: Seen | None,
    which: NDArray[np.intp] | None,
) -> Seen:
    """`look` by compiled loops."""
    m, n = len(teats), len(outline.part)
    which = np.arange(m) if which is None else which
    seen = known.copied() if known else Seen.empty(m, n, views)
    cameras = np.stack([view.numbers for view in views])
    teats = np.ascontiguousarray(teats[which])
    loops.outlines(
        teats, cameras, outline.along_mm, outline.over_end, STEP_MM, slopes_too and known is None,
        which, seen.pixels_px, seen.normals, seen.jacobian,
    )  # fmt: skip
    first = 0
    for profile, group in groupby(views, lambda view: view.fine if fine else view.rough):
        alike = list(group)
        lines = np.empty((len(alike), len(teats) * n, len(profile.offsets)), dtype=np.float32)
        for k, (view, one) in enumerate(zip(alike, lines, strict=True)):
            places = seen.pixels_px, seen.normals, which, first + k * n, n
            sample_into(loops, one, view.field, view.corner_px, places, profile.offsets)
        edges = seen.offset_px, seen.sd_px, seen.clarity, seen.limb_px, seen.unlike_px
        noise = np.array([view.noise for view in alike])
        given = lines.reshape(len(alike), len(teats), n, -1)
        find_edges_into(loops, given, profile, noise, which, first, edges)
        first += len(alike) * n
    return seen


def _edges(views: tuple[View, ...], profile: Profile, pixels: Array, normals: Array) -> Edges:
    """Edges (views, m, n) across outlines (views, m, n, 2) in views of one kind."""
    shape, s = pixels.shape[:3], len(profile.offsets)
    lines = np.concatenate(
        [
            sample(v.field, (p - v.corner_px).reshape(-1, 2), n.reshape(-1, 2), profile.offsets)
            for v, p, n in zip(views, pixels, normals, strict=True)
        ]
    )
    noise = np.repeat([view.noise for view in views], shape[1])
    found = find_edges(lines.reshape(-1, shape[2], s), profile, noise)
    return Edges(*(getattr(found, f.name).reshape(shape) for f in fields(found)))


_DAMPING = 1e-4
# of a step, and of teats after it
_LONGEST = np.array([4.0, 4.0, 30.0, 0.15, 0.15, 2.0, 0.05, 0.2])
_LEAST = np.array([-np.inf, -np.inf, -np.inf, -0.8, -0.8, 4.0, -0.25, 0.5])
_MOST = np.array([np.inf, np.inf, np.inf, 0.8, 0.8, 25.0, 0.25, 2.0])


def weights(seen: Seen, scale: float) -> Array:
    """Weights (m, k): by uncertainty, Cauchy beyond ``scale`` floors, zero with hardly an edge."""
    if loops := fast.compiled():
        found = loops.weights(
            seen.offset_px,
            seen.sd_px,
            seen.clarity,
            seen.floor_px,
            seen.jacobian,
            scale,
            LEAST_CLEAR,
        )
        return np.asarray(found)
    usable = np.isfinite(seen.offset_px + seen.jacobian.sum(axis=2)) & (seen.clarity > LEAST_CLEAR)
    variance = seen.sd_px**2 + seen.floor_px**2
    off = np.where(usable, seen.offset_px, 0.0) / np.sqrt(variance + (scale * seen.floor_px) ** 2)
    return np.where(usable, 1.0 / (variance * (1 + off**2)), 0.0)


def normal_equations(teats: Array, seen: Seen, weight: Array, prior: Prior) -> tuple[Array, Array]:
    """Matrices (m, 8, 8) and right sides (m, 8) of the least-squares step, priors included."""
    if loops := fast.compiled():
        H, b = loops.squares(seen.jacobian, seen.offset_px, weight)
    else:
        j = np.where(weight[..., None] > 0, seen.jacobian, 0.0)
        r = np.where(weight > 0, seen.offset_px, 0.0)
        weighted = (j * weight[..., None]).transpose(0, 2, 1)
        H, b = weighted @ j, (weighted @ r[..., None])[..., 0]
    usual, sure = _usual(prior)
    return H + np.diag(sure), b + sure * np.where(sure > 1e-6, usual - teats, 0.0)


@cache
def _usual(prior: Prior) -> tuple[Array, Array]:
    """Means and inverse variances (8,) of a teat's numbers."""
    mean = np.array([0, 0, 0, 0, 0, prior.radius_mm, 0, 1])
    sds = (prior.lean_sd, prior.lean_sd, prior.radius_sd_mm, prior.taper_sd, prior.height_sd)
    return mean, np.array([1e-8, 1e-8, 1e-8, *(sd**-2 for sd in sds)])


def step(teats: Array, seen: Seen, weight: Array, prior: Prior) -> Array:
    """Teats (m, 8) after one damped step, no longer than makes sense."""
    if loops := fast.compiled():
        usual, sure = _usual(prior)
        moved = loops.step(
            np.ascontiguousarray(teats), seen.jacobian, seen.offset_px, weight, usual, sure,
            _DAMPING, _LONGEST, _LEAST, _MOST,
        )  # fmt: skip
        return np.asarray(moved)
    H, b = normal_equations(teats, seen, weight, prior)
    H = H + _DAMPING * np.einsum("mii->mi", H)[:, :, None] * np.eye(COUNT)
    change = np.linalg.solve(H, b[..., None])[..., 0]
    change *= 1 / np.maximum(1.0, np.abs(change / _LONGEST).max(axis=1, keepdims=True))
    moved = teats + np.nan_to_num(change)
    return np.asarray(np.minimum(np.maximum(moved, _LEAST), _MOST))


def upright(ends_mm: Array, calibration: Calibration, beside_px: Array, prior: Prior) -> Array:
    """Upright teats (k, d, 8) of the usual size, right camera's frame: their ends at ``ends_mm``
    (k, 3), and by disparities ``beside_px`` (d,) in front of and behind them.
    """
    fb = calibration.right.fc[0] * calibration.baseline_mm
    depth = fb / (fb / ends_mm[:, 2:3] + beside_px)
    down = calibration.world_from_right.R.T @ np.array([0.0, 0.0, -1.0])
    axis = down / np.linalg.norm(down)
    teats = np.zeros((len(ends_mm), len(beside_px), COUNT))
    ends = ends_mm[:, None] * (depth / ends_mm[:, 2:3])[..., None]
    teats[..., :3] = ends + prior.radius_mm * axis
    teats[..., LEAN_X], teats[..., LEAN_Z] = axis[0] / axis[1], axis[2] / axis[1]
    teats[..., RADIUS], teats[..., HEIGHT] = prior.radius_mm, 1.0
    return teats


def apex_jacobian(teats: Array) -> Array:
    """How the teat ends move with the parameters: (m, 3, 8)."""
    direction = axes(teats)
    length = np.sqrt(1 + teats[:, LEAN_X] ** 2 + teats[:, LEAN_Z] ** 2)
    J = np.zeros((len(teats), 3, COUNT))
    J[:, [0, 1, 2], [0, 1, 2]] = 1.0
    J[:, :, RADIUS] = -direction * teats[:, [HEIGHT]]
    J[:, :, HEIGHT] = -direction * teats[:, [RADIUS]]
    for column, axis in ((LEAN_X, 0), (LEAN_Z, 2)):
        turned = np.eye(3)[axis] - direction * direction[:, [axis]]
        J[:, :, column] = -(teats[:, RADIUS] * teats[:, HEIGHT])[:, None] * turned / length[:, None]
    return J
