"""The quantities of the sensitivity study as a table: the scene, the sensors and the stated
calibration at a value. Scenes are members of the family `ideal` with one thing changed; members,
noise and calibration errors are the same at every value.

`contrast=0.12` names such scenes as a family is named. A calibration error has a size in pixels of
the principal point; every other parameter is wrong by what moves a picture about as far.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from bench.config import ConfigError, did_you_mean
from detector.calibration import Calibration
from instruments.world.draws import Draw, udder
from instruments.world.objects import make_object
from instruments.world.phantom import Phantom, PlatePose, Teat
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor
from instruments.world.setups import EYES_MM, Situation, apart, collisions
from instruments.world.shading import Lighting, Paint
from instruments.world.situations import situation
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
    """One quantity: ``set_up`` gives the scene of a value and a member's seed, ``optics`` the
    sensors, ``stated`` the detectors' calibration. ``thermal``: with the limit of nomination.
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
class Varied:
    """A quantity at a value."""

    quantity: Quantity
    value: float

    @property
    def family(self) -> str:
        """What its scenes are called."""
        return f"{self.quantity.name}{AT}{self.value:g}"

    def renderer(self, usual: Renderer, seed: int) -> Renderer:
        """The cameras of ``usual``, made with ``seed``, with the sensors of this value."""
        sensors = Optics(usual.left.readout.sensor, usual.thermal.readout.sensor)
        wanted = self.quantity.optics(self.value, sensors)
        return usual if wanted == sensors else _with_sensors(usual, seed, wanted)


def varied(family: str) -> Varied | None:
    """None for the name of a family. Raises ConfigError for a quantity that isn't known."""
    name, at, value = family.partition(AT)
    return Varied(chosen([name])[0], float(value)) if at else None


@lru_cache(1)
def _with_sensors(usual: Renderer, seed: int, wanted: Optics) -> Renderer:
    return Renderer(usual.cameras, seed, wanted.optical, wanted.thermal, usual.depth)


AT = "="
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
            "Noise of the optical pixels that light doesn't bring; shot noise comes on top. 0.4 is"
            " the emulated rig's.",
            (0.4, 1.0, 2.0, 4.0, 8.0, 16.0),
            plain,
            optics=_noisy,
            logarithmic=True,
        ),
        Quantity(
            "calibration",
            "calibration error (px of the principal points)",
            "Standard deviation of each principal point that detectors are given; the stereo turn"
            " is off by as many pixels' angle about each axis, the baseline by"
            f" {BASELINE_MM_PER_PX:g} mm a pixel along each. The thesis states 1.2 px, 3 mrad and"
            " 0.2 mm, as three standard deviations.",
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
            "Fresh noise of the thermal pixels; 0.1 K is the emulated rig's. Teats are some 8 to 16"
            " K warmer than the room.",
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
