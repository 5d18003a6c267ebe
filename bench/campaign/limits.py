"""What no method could beat in a scene.

Cramer and Rao's bound (Kay, Fundamentals of Statistical Signal Processing I, 3.9): an edge of
contrast C, blurred by sigma_b under white noise sigma_n, gives its place along the normal with
C^2 / (2 sqrt(pi) sigma_b sigma_n^2) a pixel of length; summed along the outline in both pictures
and carried to the world. For an upright teat it comes to Z^2 / (f B) times the noise of the
disparity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr, ndtri

from bench.campaign.quantities import Varied
from bench.rig.scenes import warm
from detector.calibration import Calibration
from detector.geometry import Array
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import FLANGE_HEIGHT_MM, Phantom
from instruments.world.scene import Renderer
from instruments.world.sensor import Image, OpticalSensor
from instruments.world.state import SceneState


@dataclass(frozen=True, slots=True)
class Limit:
    """What physics allows at one value: error by pixel noise, depth error of a fixed disparity
    share (median), share of ends that a thermal picture can show (None where not asked).
    """

    median_mm: float
    p95_mm: float
    disparity_mm: float
    share: float | None


QUANTILES = (0.5, 0.95)
# what sub-pixel methods reach on real edges: 0.2 to 0.3 mm of depth on the thesis's geometry
DISPARITY_PX = 0.03
MEDIAN_OF_NORMAL = 0.6745  # of |e|, in standard deviations


def limit_at(
    at: Varied, members: Sequence[int], usual: Renderer, seed: int, truth: Calibration
) -> tuple[int, Limit | None]:
    """How many ends of these members every camera sees, and their limit; ``seed`` is that of the
    cameras. Raises ValueError for a scene that can't be set up before them.
    """
    quantity, renderer = at.quantity, at.renderer(usual, seed)
    # by visible end: covariances (n, 3, 3), shifts (n, 3), depths a px (n,); by member: share
    bounds: list[tuple[Array, Array, Array]] = []
    shares: list[tuple[int, float]] = []
    for member in members:
        state = warm(quantity.set_up(at.value, member, renderer))
        stated = quantity.stated(at.value, member, truth)
        teats = np.flatnonzero(renderer.visible_ends(state).all(axis=1)).tolist()
        ends = state.phantom.ends_mm
        if teats:
            depths = truth.depth_per_disparity_px_mm(ends[teats])
            covariances = end_covariances(renderer, state, teats)
            bounds.append((covariances, shifts_mm(truth, stated, ends[teats]), depths))
        if teats and quantity.thermal:
            shares.append((len(teats), nominated_share(renderer, state, teats)))
    if not bounds:
        return 0, None
    covariances, shifts, depths = (np.concatenate(each) for each in zip(*bounds, strict=True))
    median, p95 = error_quantiles_mm(covariances, shifts, QUANTILES)
    disparity = MEDIAN_OF_NORMAL * DISPARITY_PX * float(np.median(depths))
    share = sum(n * one for n, one in shares) / len(shifts) if shares else None
    return len(shifts), Limit(median, p95, disparity, share)


def shifts_mm(calibration: Calibration, stated: Calibration, ends_mm: Array) -> Array:
    """How far (n, 3) exact pixels of the ends are triangulated off with the given calibration."""
    return stated.place(*calibration.project(ends_mm)) - ends_mm


BESIDE_PX = 3.0  # past the blurred edge, still within the narrowest teat
OUTLINE_STEP_MM = 1.0
CAP_STEPS = 32


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Pieces of an outline: ``normal`` (n, 2) unit, outwards; ``length_px``, grey ``inside`` and
    ``outside`` in DN, ``below_mm`` the rounded end's middle (0 on the end), all (n,).
    """

    normal: Floats
    length_px: Floats
    inside: Floats
    outside: Floats
    below_mm: Floats


def outline_of(phantom: Phantom, teat: int, camera: CameraModel, picture: Image) -> Outline:
    """The outline of teat number ``teat``, sides and end, from a ``picture`` without noise."""
    end, axis = phantom.ends_mm[teat], phantom.axes[teat]
    shape = phantom.teats[teat].shape
    middle = end - shape.radius_mm * axis
    view = middle - camera.centre_mm
    across = np.cross(axis, view)
    across /= np.linalg.norm(across)
    up = np.cross(view, across)
    up *= np.sign(up @ axis) / np.linalg.norm(up)
    down = np.arange(0.0, shape.length_mm - shape.radius_mm - FLANGE_HEIGHT_MM, OUTLINE_STEP_MM)
    turn = np.linspace(0.0, np.pi, CAP_STEPS)[1:-1]
    cap = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up
    side = np.tile(across, (len(down), 1))
    outward = np.concatenate([side, cap, -side])
    below = np.concatenate([down[::-1], np.zeros(len(cap)), down])
    points = middle - below[:, None] * axis + shape.radius_mm * outward
    at = camera.project(points)
    normal = camera.project(points + 0.01 * outward) - at
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    along = np.pad(np.linalg.norm(np.diff(at, axis=0), axis=1), 1)
    length = 0.5 * (along[1:] + along[:-1])
    inside, outside = (_grey(picture, at + way * BESIDE_PX * normal) for way in (-1.0, 1.0))
    known = np.isfinite(inside) & np.isfinite(outside)
    return Outline(normal[known], length[known], inside[known], outside[known], below[known])


def _grey(picture: Image, at: Floats) -> Floats:
    """Grey levels (n,) at pixels (n, 2), bilinear; NaN off the picture."""
    x, y = (at[:, i].astype(np.float32)[None, :] for i in (0, 1))
    grey = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderValue=float("nan"))
    return np.asarray(grey[0], np.float64)


PIXEL_VARIANCE = 1.0 / 12.0  # of a pixel's own width, px^2, and of rounding, DN^2
DRAWS = 4000
GRADIENT_STEP_MM = 0.01


def edge_information(outline: Outline, sigma_px: float, noise_dn: Floats) -> Floats:
    """Fisher information (2, 2), 1/px^2, on a shift; ``noise_dn`` (n,) along the outline."""
    contrast = outline.outside - outline.inside
    weight = contrast**2 / (2.0 * np.sqrt(np.pi) * sigma_px * noise_dn**2) * outline.length_px
    return np.asarray(np.einsum("n,ni,nj->ij", weight, outline.normal, outline.normal))


def noise_dn(sensor: OpticalSensor, grey_dn: Floats, gain: float) -> Floats:
    """Standard deviation (n,) of pixels of that grey, DN (EMVA 1288), with the fixed pattern."""
    k = sensor.gain_dn_per_e * gain
    signal_e = np.maximum(grey_dn - sensor.offset_dn, 0.0) / k
    electrons = signal_e + sensor.read_noise_e**2 + sensor.dsnu_e**2 + (sensor.prnu * signal_e) ** 2
    return np.asarray(np.sqrt(k**2 * electrons + PIXEL_VARIANCE))


def edge_sigma_px(sensor: OpticalSensor, depth_mm: float, focal_px: float) -> float:
    """Width of an edge: the lens's blur, what is out of focus, and the pixel's own width."""
    out_of_focus = float(sensor.focus.sigma_px(depth_mm, focal_px))
    return float(np.sqrt(sensor.blur_px**2 + out_of_focus**2 + PIXEL_VARIANCE))


def end_covariances(renderer: Renderer, state: SceneState, teats: Sequence[int]) -> Floats:
    """Least covariances (n, 3, 3) mm^2 of the ends, world axes, from both noise-free pictures."""
    shadows = renderer.shadows(state)
    information = np.zeros((len(teats), 3, 3))
    steps = GRADIENT_STEP_MM * np.eye(3)
    for eye, camera in zip((renderer.left, renderer.right), renderer.cameras[:2], strict=True):
        picture, sensor = eye.expected(state, shadows), eye.readout.sensor
        for i, teat in enumerate(teats):
            end = state.phantom.ends_mm[teat]
            outline = outline_of(state.phantom, teat, camera, picture)
            depth = float(camera.camera_from_world(end[None])[0, 2])
            noise = noise_dn(sensor, 0.5 * (outline.inside + outline.outside), state.exposure.gain)
            sigma_px = edge_sigma_px(sensor, depth, float(camera.fc.mean()))
            seen = edge_information(outline, sigma_px, noise)
            moved = camera.project(end + steps) - camera.project(end - steps)  # px, (3, 2)
            slope = moved.T / (2.0 * GRADIENT_STEP_MM)
            information[i] += slope.T @ seen @ slope
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


def error_quantiles_mm(
    covariances: Floats, shifts_mm: Floats, shares: Sequence[float]
) -> tuple[float, ...]:
    """Quantiles of |e| for normal errors of covariances (n, 3, 3), means (n, 3); fixed draws."""
    units = np.random.Generator(np.random.PCG64(1288)).standard_normal((DRAWS, 3))
    errors = np.einsum("nij,dj->ndi", np.linalg.cholesky(covariances), units)
    errors += shifts_mm[:, None, :]
    return tuple(float(q) for q in np.quantile(np.linalg.norm(errors, axis=2), shares))


def nominated_share(renderer: Renderer, state: SceneState, teats: Sequence[int]) -> float:
    """Share of these teats that a matched filter finds in a thermal frame at one false alarm a
    frame (Neyman and Pearson): N pixels, dT warmer than the room, have a signal of dT sqrt(N) /
    sigma.
    """
    sensor, camera = renderer.thermal.readout.sensor, renderer.cameras[2]
    threshold = -float(ndtri(1.0 / (sensor.width_px * sensor.height_px)))
    focal_px = float(camera.fc.mean()) * sensor.width_px / camera.width_px
    signals = []
    for teat in teats:
        shape, end = state.phantom.teats[teat].shape, state.phantom.ends_mm[teat]
        px_a_mm = focal_px / float(camera.camera_from_world(end[None])[0, 2])
        pixels = 2.0 * shape.radius_mm * shape.length_mm * px_a_mm**2
        warmer_k = abs(state.teat_temps_c[teat] - state.ambient_c) * state.teat_paint.emissivity
        signals.append(warmer_k * np.sqrt(pixels) / np.hypot(sensor.netd_k, sensor.fixed_k))
    return float(np.mean(ndtr(np.array(signals) - threshold)))
