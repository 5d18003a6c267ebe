"""What no method could beat: the Fisher information of a teat's outline on its end, and the share
that a thermal picture can show; and calibrations with small errors.

Cramer and Rao's bound (Kay, Fundamentals of Statistical Signal Processing I, 3.9): an edge of
contrast C, blurred by sigma_b under white noise sigma_n, tells its place along the normal with C^2
/ (2 sqrt(pi) sigma_b sigma_n^2) a pixel of length; summed along the outline in both pictures and
carried to the world. For an upright teat it comes to Z^2 / (f B) times the noise of the disparity.

Calibration errors have one size, in pixels of the principal point; every other parameter is wrong
by what moves a picture about as far. They are drawn once a member and scaled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.stats import norm

from detector.calibration import Calibration
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import FLANGE_HEIGHT_MM, Phantom
from instruments.world.scene import Renderer
from instruments.world.sensor import Image, OpticalSensor
from instruments.world.state import SceneState

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
    points, outward, below = _pieces(phantom, teat, camera)
    at = camera.project(points)
    normal = camera.project(points + 0.01 * outward) - at
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    along = np.linalg.norm(np.diff(at, axis=0), axis=1)
    length = 0.5 * (np.concatenate([[0.0], along]) + np.concatenate([along, [0.0]]))
    inside, outside = (_grey(picture, at + side * BESIDE_PX * normal) for side in (-1.0, 1.0))
    known = np.isfinite(inside) & np.isfinite(outside)
    return Outline(normal[known], length[known], inside[known], outside[known], below[known])


def _pieces(phantom: Phantom, teat: int, camera: CameraModel) -> tuple[Floats, Floats, Floats]:
    """Points (n, 3) mm along the outline, normals (n, 3), how far below the end's middle."""
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
    return middle - below[:, None] * axis + shape.radius_mm * outward, outward, below


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
    for eye, camera in zip((renderer.left, renderer.right), renderer.cameras[:2], strict=True):
        picture, sensor = eye.expected(state, shadows), eye.readout.sensor
        for i, teat in enumerate(teats):
            end = state.phantom.ends_mm[teat]
            outline = outline_of(state.phantom, teat, camera, picture)
            depth = float(camera.camera_from_world(end[None])[0, 2])
            noise = noise_dn(sensor, 0.5 * (outline.inside + outline.outside), state.exposure.gain)
            sigma_px = edge_sigma_px(sensor, depth, float(camera.fc.mean()))
            seen = edge_information(outline, sigma_px, noise)
            slope = _pixels_per_mm(camera, end)
            information[i] += slope.T @ seen @ slope
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


def _pixels_per_mm(camera: CameraModel, point_mm: Floats) -> Floats:
    """How pixels move with a point, (2, 3)."""
    steps = GRADIENT_STEP_MM * np.eye(3)
    moved = camera.project(point_mm + steps) - camera.project(point_mm - steps)
    return np.asarray(moved.T / (2.0 * GRADIENT_STEP_MM))


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
    frame (Neyman and Pearson).

    A teat that covers N pixels, dT warmer than the room, has a signal of dT sqrt(N) / sigma; one of
    as many places as there are pixels gets past the threshold by noise alone.
    """
    sensor, camera = renderer.thermal.readout.sensor, renderer.cameras[2]
    threshold = float(norm.isf(1.0 / (sensor.width_px * sensor.height_px)))
    focal_px = float(camera.fc.mean()) * sensor.width_px / camera.width_px
    signals = []
    for teat in teats:
        shape, end = state.phantom.teats[teat].shape, state.phantom.ends_mm[teat]
        px_a_mm = focal_px / float(camera.camera_from_world(end[None])[0, 2])
        pixels = 2.0 * shape.radius_mm * shape.length_mm * px_a_mm**2
        warmer_k = abs(state.teat_temps_c[teat] - state.ambient_c) * state.teat_paint.emissivity
        signals.append(warmer_k * np.sqrt(pixels) / np.hypot(sensor.netd_k, sensor.fixed_k))
    return float(np.mean(norm.sf(threshold - np.array(signals))))


FOCAL_PX = 1290.0  # a turn by one pixel's angle, tables 3.1 and 3.2
BASELINE_MM_PER_PX = 0.4  # 0.2 mm at half a pixel: what section 3.2.1.2 prints as its uncertainty
_PRINCIPAL = tuple((camera, name) for camera in ("left", "right") for name in ("cx", "cy"))
_TURN = tuple(("stereo", f"om{i}") for i in (1, 2, 3))
_BASELINE = tuple(("stereo", f"T{i}") for i in (1, 2, 3))
SPREAD_PER_PX = {
    **dict.fromkeys(_PRINCIPAL, 1.0),
    **dict.fromkeys(_TURN, 1.0 / FOCAL_PX),
    **dict.fromkeys(_BASELINE, BASELINE_MM_PER_PX),
}


def told(size_px: float, seed: int, calibration: Calibration) -> Calibration:
    """The calibration with errors of that size; the thermal camera keeps its place to the left."""
    chance = np.random.Generator(np.random.PCG64([seed, *b"miscalibration"]))
    drawn = chance.standard_normal(len(SPREAD_PER_PX))
    pair = calibration
    for ((owner, name), one), unit in zip(SPREAD_PER_PX.items(), drawn.tolist(), strict=True):
        pair = pair.moved(owner, name, size_px * one * unit)
    return replace(
        calibration, left=pair.left, right=pair.right, right_from_left=pair.right_from_left
    )
