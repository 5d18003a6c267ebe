"""Joint robust fit of teats to the outlines in all pictures, for many starts at once.

Damped Gauss-Newton on edge distances along the outlines' normals, edges found anew at each step;
weak priors on size, lean, taper and height. Derivatives are closed forms.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from detector import outline as package
from detector.calibration import Calibration
from detector.geometry import Array, Camera, Motion
from detector.outline.edges import LEAST_CLEAR, Field, Profile, find_edges, sample
from detector.outline.model import (
    COUNT,
    HEIGHT,
    LEAN_X,
    LEAN_Z,
    RADIUS,
    Outline,
    Rows,
    axes,
    numbers_of,
)
from detector.outline.prior import Prior, disparities_px


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
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
    # (24,): `model.numbers_of`, and the first pixel's place
    numbers: Array = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        numbers = numbers_of(self.camera, self.camera_from_teats)
        object.__setattr__(self, "numbers", np.concatenate([numbers, self.corner_px]))


@dataclass(frozen=True, slots=True, eq=False)
class OutlineEdges(Rows):
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
    def empty(cls, m: int, n: int, views: tuple[CameraView, ...]) -> OutlineEdges:
        """Of m outlines of n points, before anything is looked at; Jacobians are zero."""
        k = len(views) * n
        offset, sd, clarity, limb, unlike = np.empty((5, m, k))
        floor = np.empty((m, k))
        floor[:] = np.repeat([view.floor_px for view in views], n)
        pixels, normals = np.empty((2, m, k, 2))
        jacobian = np.zeros((m, k, COUNT))
        return cls(offset, sd, clarity, floor, jacobian, pixels, normals, limb, unlike)


def look(
    teats: Array,
    views: tuple[CameraView, ...],
    outline: Outline,
    *,
    fine: bool,
    slopes_too: bool = True,
    known: OutlineEdges | None = None,
    which: NDArray[np.intp] | None = None,
) -> OutlineEdges:
    """Edges about teats (m, 8); their Jacobian is zero unless asked for. With ``known`` edges about
    teats nearby: anew of teats ``which`` in ``views``, which are the first of the known ones', into
    the known ones' arrays; the Jacobian stays.
    """
    m, n = len(teats), len(outline.part)
    rows = slice(None) if which is None else which  # a slice copies nothing
    which = np.arange(m) if which is None else which
    seen = OutlineEdges.empty(m, n, views) if known is None else known
    cameras = np.array([view.numbers for view in views])
    teats = np.ascontiguousarray(teats[which])
    package.kernels.outlines(
        teats, cameras, (outline.along_mm, outline.over_end), slopes_too and known is None,
        which, (seen.pixels_px, seen.normals, seen.jacobian),
    )  # fmt: skip
    first = 0
    for profile, group in groupby(views, lambda view: view.fine if fine else view.rough):
        alike, start = list(group), first
        lines = np.empty((len(alike), len(teats) * n, len(profile.offsets)), dtype=np.float32)
        for view, of_view in zip(alike, lines, strict=True):
            at, first = slice(first, first + n), first + n
            middles = (seen.pixels_px[rows, at] - view.corner_px).reshape(-1, 2)
            normals = seen.normals[rows, at].reshape(-1, 2)
            sample(view.field, middles, normals, profile.offsets, of_view)
        given = lines.reshape(len(alike), len(teats), n, -1)
        noise = np.array([view.noise for view in alike])
        edges = seen.offset_px, seen.sd_px, seen.clarity, seen.limb_px, seen.unlike_px
        for of_all, found in zip(edges, find_edges(given, profile, noise), strict=True):
            of_all[rows, start:first] = found
    return seen


_DAMPING = 1e-4
_LIMITS = (  # of a step, and of teats after it: at least and at most
    np.array([4.0, 4.0, 30.0, 0.15, 0.15, 2.0, 0.05, 0.2]),
    np.array([-np.inf, -np.inf, -np.inf, -1.2, -1.2, 4.0, -0.25, 0.5]),
    np.array([np.inf, np.inf, np.inf, 1.2, 1.2, 25.0, 0.25, 2.0]),
)


def weights(seen: OutlineEdges, scale: float) -> Array:
    """Weights (m, k): by uncertainty, Cauchy beyond ``scale`` floors, zero with hardly an edge."""
    variance = seen.sd_px**2 + seen.floor_px**2
    off = seen.offset_px / np.sqrt(variance + (scale * seen.floor_px) ** 2)
    # a slope that isn't known is so in all eight numbers
    known = np.isfinite(off + seen.jacobian[..., 0])
    usable = known & (seen.clarity > LEAST_CLEAR)
    return np.where(usable, 1.0 / (variance * (1.0 + off**2)), 0.0)


def squares(jacobian: Array, offset: Array, weight: Array) -> tuple[Array, Array]:
    """Matrices (m, 8, 8) and right sides (m, 8) of least squares."""
    H, b = np.zeros((len(weight), COUNT, COUNT)), np.zeros((len(weight), COUNT))
    package.kernels.squares(jacobian, offset, weight, H, b)
    return H, b


def information(seen: OutlineEdges, weight: Array, sure: Array) -> Array:
    """Matrices (m, 8, 8) of the least-squares step, with the priors' `usual` inverse variances
    (8,), or (m, 8).
    """
    H, _ = squares(seen.jacobian, seen.offset_px, weight)
    return np.asarray(H + sure[..., None] * np.eye(COUNT))


@cache
def usual(prior: Prior) -> tuple[Array, Array]:
    """Means and inverse variances (8,) of a teat's numbers."""
    mean = np.array([0, 0, 0, 0, 0, prior.radius_mm, 0, 1])
    sds = (prior.lean_sd, prior.lean_sd, prior.radius_sd_mm, prior.taper_sd, prior.height_sd)
    return mean, np.array([1e-8, 1e-8, 1e-8, *(sd**-2 for sd in sds)])


def step(teats: Array, seen: OutlineEdges, weight: Array, prior: Prior) -> Array:
    """Teats (m, 8) after one damped step, no longer than makes sense."""
    moved = np.empty(teats.shape)
    package.kernels.step(
        np.ascontiguousarray(teats), seen.jacobian, seen.offset_px, weight, *usual(prior),
        _DAMPING, _LIMITS, moved,
    )  # fmt: skip
    return moved


def upright(ends_mm: Array, calibration: Calibration, beside_px: Array, prior: Prior) -> Array:
    """Upright teats (k, d, 8) of the usual size: their ends at ``ends_mm`` (k, 3), the fits' frame,
    and by disparities ``beside_px`` (d,) in front of and behind them.
    """
    px = disparities_px(ends_mm, calibration)[:, None]
    teats = np.zeros((len(ends_mm), len(beside_px), COUNT))
    teats[..., :3] = ends_mm[:, None] * (px / (px + beside_px))[..., None]
    teats[..., 1] += prior.radius_mm
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
