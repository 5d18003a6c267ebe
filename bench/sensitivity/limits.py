"""What no method could beat: the information that edges hold about an end's place, and the heat that a thermal picture holds of a teat.

Strategy: Cramer and Rao's bound (Kay, Fundamentals of Statistical Signal Processing I, 3.9). An edge of contrast C, blurred by a
Gaussian of sigma_b and seen under white noise sigma_n, tells of its place along its normal with C^2 / (2 sqrt(pi) sigma_b sigma_n^2) for
each pixel of its length: the integral of the squared slope over the noise. Summed along the outline in both pictures, and carried to the
world by the derivatives of the projection, that is the information on where the end is, for one who knows the teat's shape, lean and
grey. For an upright teat it comes to Z^2 / (f B) times the noise of the disparity. May not know any detector.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm

from bench.sensitivity.outline import Outline, outline_of
from instruments.world.microbolometer import ThermalSensor
from instruments.world.optics import CameraModel, Floats
from instruments.world.scene import Renderer, SceneState
from instruments.world.sensor import OpticalSensor

PIXEL_VARIANCE = 1.0 / 12.0  # of a pixel's own width, px^2, and of rounding, DN^2
DRAWS = 4000
STEP_MM = 0.01


def edge_information(outline: Outline, sigma_px: float, noise_dn: Floats) -> Floats:
    """Fisher information (2, 2), 1/px^2, on a shift of an outline; ``noise_dn`` (n,) is the noise of the pixels along it."""
    contrast = outline.outside - outline.inside
    weight = contrast**2 / (2.0 * np.sqrt(np.pi) * sigma_px * noise_dn**2) * outline.length_px
    return np.asarray(np.einsum("n,ni,nj->ij", weight, outline.normal, outline.normal))


def noise_dn(sensor: OpticalSensor, grey_dn: Floats, gain: float) -> Floats:
    """Standard deviation (n,) of pixels of that grey level, DN: EMVA 1288's model, and the fixed pattern, which is noise to one frame."""
    k = sensor.gain_dn_per_e * gain
    signal_e = np.maximum(grey_dn - sensor.offset_dn, 0.0) / k
    electrons = signal_e + sensor.read_noise_e**2 + sensor.dsnu_e**2 + (sensor.prnu * signal_e) ** 2
    return np.asarray(np.sqrt(k**2 * electrons + PIXEL_VARIANCE))


def edge_sigma_px(sensor: OpticalSensor, depth_mm: float, focal_px: float) -> float:
    """Width of an edge: the lens's blur, what is out of focus, and the pixel's own width."""
    out_of_focus = float(sensor.focus.sigma_px(depth_mm, focal_px))
    return float(np.sqrt(sensor.blur_px**2 + out_of_focus**2 + PIXEL_VARIANCE))


def end_covariances(renderer: Renderer, state: SceneState, teats: Sequence[int]) -> Floats:
    """Least covariances (n, 3, 3) mm^2 of the ends of these teats, world axes, from both optical pictures as drawn without noise."""
    shadows = renderer.shadows(state)
    information = np.zeros((len(teats), 3, 3))
    for eye, camera in ((renderer.left, renderer.cameras[0]), (renderer.right, renderer.cameras[1])):
        picture, sensor = eye.expected(state, shadows), eye.readout.sensor
        for i, teat in enumerate(teats):
            end = state.phantom.ends_mm[teat]
            outline = outline_of(state.phantom, teat, camera, picture)
            depth = float(camera.camera_from_world(end[None])[0, 2])
            noise = noise_dn(sensor, 0.5 * (outline.inside + outline.outside), state.exposure.gain)
            seen = edge_information(outline, edge_sigma_px(sensor, depth, float(camera.fc.mean())), noise)
            slope = _pixels_per_mm(camera, end)
            information[i] += slope.T @ seen @ slope
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


def _pixels_per_mm(camera: CameraModel, point_mm: Floats) -> Floats:
    """How pixels move with a point, (2, 3)."""
    steps = STEP_MM * np.eye(3)
    return np.asarray((camera.project(point_mm + steps) - camera.project(point_mm - steps)).T / (2.0 * STEP_MM))


def error_quantiles_mm(covariances: Floats, shifts_mm: Floats, shares: Sequence[float]) -> tuple[float, ...]:
    """Quantiles of the distance |e| of normal errors with these covariances (n, 3, 3) and means (n, 3), all alike often; always the same
    draws.
    """
    units = np.random.Generator(np.random.PCG64(1288)).standard_normal((DRAWS, 3))
    errors = np.einsum("nij,dj->ndi", np.linalg.cholesky(covariances), units) + shifts_mm[:, None, :]
    return tuple(float(q) for q in np.quantile(np.linalg.norm(errors, axis=2), shares))


def nominated_share(renderer: Renderer, state: SceneState, teats: Sequence[int]) -> float:
    """Share of these teats that a matched filter finds in a thermal frame at one false alarm a frame (Neyman and Pearson).

    A teat that covers N pixels, dT warmer than the room, has a signal of dT sqrt(N) / sigma; one of as many places as there are pixels
    gets past the threshold by noise alone.
    """
    sensor, camera = renderer.thermal.readout.sensor, renderer.cameras[2]
    threshold = float(norm.isf(1.0 / (sensor.width_px * sensor.height_px)))
    signal = [_thermal_signal(sensor, camera, state, teat) for teat in teats]
    return float(np.mean(norm.sf(threshold - np.array(signal))))


def _thermal_signal(sensor: ThermalSensor, camera: CameraModel, state: SceneState, teat: int) -> float:
    shape, end = state.phantom.teats[teat].shape, state.phantom.ends_mm[teat]
    px_a_mm = float(camera.fc.mean()) * sensor.width_px / camera.width_px / float(camera.camera_from_world(end[None])[0, 2])
    pixels = 2.0 * shape.radius_mm * shape.length_mm * px_a_mm**2
    warmer_k = abs(state.teat_temps_c[teat] - state.ambient_c) * state.teat_paint.emissivity
    return float(warmer_k * np.sqrt(pixels) / np.hypot(sensor.netd_k, sensor.fixed_k))
