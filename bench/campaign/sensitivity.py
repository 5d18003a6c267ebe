"""The sensitivity study: quantities and their values as a table, the scenes of each (a member of
the family `ideal` with one thing changed), what detectors find in them, and what no method could
beat. Members, noise and calibration errors are the same at every value.

The limit is Cramer and Rao's bound (Kay, Fundamentals of Statistical Signal Processing I, 3.9): an
edge of contrast C, blurred by sigma_b under white noise sigma_n, gives its place along the normal
with C^2 / (2 sqrt(pi) sigma_b sigma_n^2) a pixel of length; summed along the outline in both
pictures and carried to the world. For an upright teat it comes to Z^2 / (f B) times the noise of
the disparity. A calibration error has a size in pixels of the principal point; every other
parameter is wrong by what moves a picture about as far.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot

import cv2
import numpy as np
from scipy.special import ndtr, ndtri

from bench.campaign import chunk
from bench.campaign.chunk import Rows, Scene, run_scene
from bench.config import ConfigError, did_you_mean, read_text
from bench.rig.loading import LoadedRig
from bench.rig.scenes import warm
from detector.calibration import Calibration
from detector.geometry import Array
from detector.protocol import Detector
from instruments.world.draws import Draw, udder
from instruments.world.objects import make_object
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import FLANGE_HEIGHT_MM, Phantom, PlatePose, Teat
from instruments.world.scene import Renderer
from instruments.world.sensor import Image, OpticalSensor
from instruments.world.setups import EYES_MM, Situation, apart, collisions
from instruments.world.shading import Lighting, Paint
from instruments.world.situations import situation
from instruments.world.state import SceneState
from instruments.world.thermal_camera import ThermalSensor

SetUp = Callable[[float, int, Renderer], Situation]


@dataclass(frozen=True, slots=True)
class Optics:
    """The sensors behind the emulated lenses."""

    optical: OpticalSensor
    thermal: ThermalSensor


def same_optics(_value: float, usual: Optics) -> Optics:
    """The rig's own."""
    return usual


def true_calibration(_value: float, _seed: int, calibration: Calibration) -> Calibration:
    """The calibration that the scene is drawn by."""
    return calibration


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity. ``set_up`` gives the scene of a value and a member's seed, ``optics`` the
    sensors, ``told`` the calibration that detectors get. ``thermal``: with the limit of nomination.
    """

    name: str
    label: str
    about: str
    values: tuple[float, ...]
    set_up: SetUp
    optics: Callable[[float, Optics], Optics] = same_optics
    stated: Callable[[float, int, Calibration], Calibration] = true_calibration
    thermal: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Tally:
    """What one detector did at one value: distances of the ends it found, and counts that add."""

    distances_mm: tuple[float, ...] = ()
    false: int = 0
    failures: int = 0

    def __add__(self, other: Tally) -> Tally:
        distances = self.distances_mm + other.distances_mm
        return Tally(distances, self.false + other.false, self.failures + other.failures)


@dataclass(frozen=True, slots=True)
class Limit:
    """What physics allows at one value: error by pixel noise, depth error of a fixed disparity
    share (median), share of ends that a thermal picture can show (None where not asked).
    """

    median_mm: float
    p95_mm: float
    disparity_mm: float
    share: float | None


@dataclass(frozen=True, slots=True)
class Measured:
    """One value: ends that every camera sees, what each detector found, the limit."""

    value: float
    visible: int
    tallies: Mapping[str, Tally]
    limit: Limit | None


QUANTILES = (0.5, 0.95)
# what sub-pixel methods reach on real edges: 0.2 to 0.3 mm of depth on the thesis's geometry
DISPARITY_PX = 0.03
MEDIAN_OF_NORMAL = 0.6745  # of |e|, in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What stays the same: rig, detectors, the members' seeds, the seed of noise and cameras."""

    rig: LoadedRig
    detectors: Sequence[Detector]
    members: Sequence[int]
    seed: int


def measure(bench: Bench, quantity: Quantity) -> Iterator[Measured]:
    """What every detector does at each value, one by one; cameras are made anew only for other
    sensors. Raises ConfigError for a scene that can't be set up before these cameras.
    """
    table = tomllib.loads(read_text(bench.rig.calibration_path))
    said = bench.rig.rig.emulation
    usual = Optics(said.optical.sensor(), said.thermal.sensor(table))
    optics, renderer = None, None
    for value in quantity.values:
        wanted = quantity.optics(value, usual)
        if renderer is None or wanted != optics:
            optics = wanted
            renderer = Renderer.from_calibration(
                table, bench.seed, optical=wanted.optical, thermal=wanted.thermal
            )
        yield _at(bench, quantity, value, renderer)


def _at(bench: Bench, quantity: Quantity, value: float, renderer: Renderer) -> Measured:
    tallies = {detector.name: Tally() for detector in bench.detectors}
    truth = bench.rig.calibration
    # by visible end: covariances (n, 3, 3), shifts (n, 3), depths a px (n,); by member: share
    bounds: list[tuple[Array, Array, Array]] = []
    shares: list[tuple[int, float]] = []
    for member in bench.members:
        try:
            found = quantity.set_up(value, member, renderer)
            stated = quantity.stated(value, member, truth)
            one = chunk.Bench(renderer, stated, bench.detectors, bench.seed)
            rows = run_scene(one, Scene(quantity.name, member), found)
        except ValueError as error:
            raise ConfigError.plain(
                f"{quantity.name} {value:g} can't be set up for member {member}: {error}; choose"
                " others by --first"
            ) from error
        for name, tally in _tallies(rows):
            tallies[name] += tally
        state = warm(found)
        seen = renderer.visible_ends(state).all(axis=1)
        teats, ends = np.flatnonzero(seen).tolist(), state.phantom.ends_mm
        if teats:
            depths = truth.depth_per_disparity_px_mm(ends[teats])
            covariances = end_covariances(renderer, state, teats)
            bounds.append((covariances, shifts_mm(truth, stated, ends[teats]), depths))
        if teats and quantity.thermal:
            shares.append((len(teats), nominated_share(renderer, state, teats)))
    if not bounds:
        return Measured(value, 0, tallies, None)
    covariances, shifts, depths = (np.concatenate(each) for each in zip(*bounds, strict=True))
    median, p95 = error_quantiles_mm(covariances, shifts, QUANTILES)
    disparity = MEDIAN_OF_NORMAL * DISPARITY_PX * float(np.median(depths))
    share = sum(n * one for n, one in shares) / len(shifts) if shares else None
    return Measured(value, len(shifts), tallies, Limit(median, p95, disparity, share))


def _tallies(rows: Rows) -> Iterator[tuple[str, Tally]]:
    """What each detector did in one scene."""
    for row in rows.scenes:
        distances = tuple(
            hypot(teat.x_mm or 0.0, teat.y_mm or 0.0, teat.z_mm or 0.0)
            for teat in rows.teats
            if teat.detector == row.detector and teat.status == "found"
        )
        yield row.detector, Tally(distances, row.false_teats, int(row.no_answer))


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


def miscalibrated(size_px: float, seed: int, calibration: Calibration) -> Calibration:
    """The calibration with errors of that size; the thermal camera keeps its place to the left."""
    chance = np.random.Generator(np.random.PCG64([seed, *b"miscalibration"]))
    drawn = chance.standard_normal(len(SPREAD_PER_PX))
    pair = calibration
    for ((owner, name), one), unit in zip(SPREAD_PER_PX.items(), drawn.tolist(), strict=True):
        pair = pair.moved(owner, name, size_px * one * unit)
    return replace(
        calibration, left=pair.left, right=pair.right, right_from_left=pair.right_from_left
    )


FAMILY = "ideal"
ATTEMPTS = 1000
CLEAR_MM = 4.0  # between teats as any camera sees them
FAR_BOARD_MM = 1250.0  # behind teats at 1.75 m
BOARD_ALBEDO, EVEN_LIGHT = 0.5, 2.2  # together a board at 0.7 of white
# the covered teat behind the covering one: near, so that all cameras see about the same of it
BEHIND_MM = 45.0
ARM_ABOVE_MM, ELBOW_MM, WRIST_MM = 15.0, 50.0, 32.0


def plain(_value: float, seed: int, _renderer: Renderer) -> Situation:
    """As drawn; what is varied isn't in the scene."""
    return situation(FAMILY, seed)


def at_range(range_m: float, seed: int, renderer: Renderer) -> Situation:
    """The phantom moved until its ends' mean is so far along the right camera's axis."""
    found = situation(FAMILY, seed)
    depth = renderer.cameras[1].camera_from_world(found.phantom.ends_mm)[:, 2]
    away = PlatePose(y_mm=float(1e3 * range_m - depth.mean()))
    backdrop = replace(found.backdrop, board_y_mm=FAR_BOARD_MM)
    return replace(found, phantom=found.phantom.moved(away), backdrop=backdrop)


def of_contrast(contrast: float, seed: int, _renderer: Renderer) -> Situation:
    """Teats darker than the board by this share of its grey, in light from everywhere."""
    found = situation(FAMILY, seed)
    board = replace(found.backdrop, board_albedo=BOARD_ALBEDO, board_texture=0.0)
    even = Lighting(lamps=(), ambient=EVEN_LIGHT)
    paint = Paint(BOARD_ALBEDO * (1.0 - contrast))
    return replace(found, backdrop=board, lighting=even, teat_paint=paint)


def leaning(lean_deg: float, seed: int, _renderer: Renderer) -> Situation:
    """Four teats that lean by this, each another way, none covering another."""
    found = situation(FAMILY, seed)
    for attempt in range(ATTEMPTS):
        phantom = udder(Draw("tilt", seed, attempt), lean_deg=(lean_deg, lean_deg))
        drawn = replace(found, phantom=phantom)
        if apart(phantom, EYES_MM) >= CLEAR_MM and not any(collisions(drawn)):
            return drawn
    raise ValueError(
        f"no udder whose teats lean by {lean_deg:g} degrees and stand apart was found in {ATTEMPTS}"
        " draws"
    )


def overlapping(share: float, seed: int, _renderer: Renderer) -> Situation:
    """Each far teat covered by a near one by this share of its width; below zero is a gap."""
    found = situation(FAMILY, seed)
    teats = found.phantom.teats
    outwards = (-1.0, 1.0)  # the two pairs move apart, not into each other
    covered = [_behind(teats[i], teats[i + 2], share, way) for i, way in enumerate(outwards)]
    near = [replace(teat, tilt_rad=(0.0, 0.0)) for teat in teats[:2]]
    return replace(found, phantom=Phantom((*near, *covered)))


def _behind(near: Teat, far: Teat, share: float, way: float) -> Teat:
    """The far teat upright behind the near one: bearings x / y from midway, radii as seen."""
    eye_x, eye_y, _ = EYES_MM[2]
    near_y = near.base_mm[1] - eye_y
    far_y = near_y + BEHIND_MM
    touching = near.shape.radius_mm / near_y + far.shape.radius_mm / far_y
    apart_by = touching - 2.0 * share * far.shape.radius_mm / far_y
    bearing = (near.base_mm[0] - eye_x) / near_y + way * apart_by
    base_mm = (float(eye_x + bearing * far_y), float(far_y + eye_y))
    return replace(far, base_mm=base_mm, tilt_rad=(0.0, 0.0))


def before_arm(gap_mm: float, seed: int, _renderer: Renderer) -> Situation:
    """A bare forearm level behind the ends, this far behind the farthest; side by turns."""
    found = situation(FAMILY, seed)
    ends = found.phantom.ends_mm
    farthest = max(
        hull.radius_b_mm + max(hull.a_mm[1], hull.b_mm[1])
        for hulls in found.phantom.teat_hulls()
        for hull in hulls
    )
    arm = make_object(
        "warm_arm",
        y_mm=farthest + gap_mm + ELBOW_MM,
        z_mm=float(ends[:, 2].mean()) + ARM_ABOVE_MM,
        elbow_radius_mm=ELBOW_MM,
        wrist_radius_mm=WRIST_MM,
        rise_deg=0.0,
        turn_deg=180.0 * (seed % 2),
    )
    return replace(found, objects=(arm,))


def _noisy(noise_dn: float, usual: Optics) -> Optics:
    noise_e = noise_dn / usual.optical.gain_dn_per_e
    return replace(usual, optical=replace(usual.optical, read_noise_e=noise_e))


def _warm_noise(netd_k: float, usual: Optics) -> Optics:
    return replace(usual, thermal=replace(usual.thermal, netd_k=netd_k))


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity(
            "pixel-noise",
            "read noise (grey levels)",
            "Noise of the optical pixels that light doesn't bring; shot noise comes on top.",
            (0.4, 1.0, 2.0, 4.0, 8.0, 16.0),
            plain,
            optics=_noisy,
            logarithmic=True,
        ),
        Quantity(
            "calibration",
            "calibration error (px of the principal points)",
            "Standard deviation of each principal point that detectors are told; the stereo turn"
            " is off by as many pixels' angle about each axis, the baseline by"
            f" {BASELINE_MM_PER_PX:g} mm a pixel along each.",
            (0.0, 0.1, 0.2, 0.3, 0.4, 0.5),
            plain,
            stated=miscalibrated,
        ),
        Quantity(
            "range",
            "range (m)",
            "Mean distance of the ends along the right camera's axis.",
            (1.0, 1.15, 1.3, 1.45, 1.6, 1.75),
            at_range,
        ),
        Quantity(
            "contrast",
            "contrast (share of the board's grey)",
            "How much darker the teats' sides are than the board, both in even light.",
            (0.03, 0.06, 0.12, 0.25, 0.5, 0.85),
            of_contrast,
            logarithmic=True,
        ),
        Quantity(
            "netd",
            "NETD (K)",
            "Fresh noise of the thermal pixels.",
            (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0),
            plain,
            optics=_warm_noise,
            thermal=True,
            logarithmic=True,
        ),
        Quantity(
            "tilt",
            "lean (degrees)",
            "Lean of every teat, each another way.",
            (0.0, 5.0, 10.0, 14.0, 18.0, 22.0),
            leaning,
        ),
        Quantity(
            "overlap",
            "covered share of a far teat's width",
            "Two pairs of teats, one 45 mm behind the other; below zero is a gap.",
            (-0.4, -0.1, 0.05, 0.2, 0.35, 0.5),
            overlapping,
        ),
        Quantity(
            "arm-gap",
            "gap to the arm (mm)",
            "From the farthest teat to a bare forearm behind the ends, at the elbow.",
            (10.0, 30.0, 60.0, 100.0, 180.0, 300.0),
            before_arm,
        ),
    )
}


def chosen(names: Sequence[str]) -> tuple[Quantity, ...]:
    """The quantities of these names, all for none. Raises ConfigError for one that isn't known."""
    for name in names:
        if name not in QUANTITIES:
            raise ConfigError.plain(
                f"there is no quantity {name!r}{did_you_mean(name, QUANTITIES)} (known:"
                f" {', '.join(QUANTITIES)})"
            )
    return tuple(QUANTITIES[name] for name in dict.fromkeys(names)) or tuple(QUANTITIES.values())
