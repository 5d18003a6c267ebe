"""The eight quantities and the values that each takes: a table. May not know how anything is measured."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import replace

from bench.config import ConfigError
from bench.sensitivity import miscalibration, scenes
from bench.sensitivity.values import Optics, Quantity


def _noisy(noise_dn: float, usual: Optics) -> Optics:
    return replace(usual, optical=replace(usual.optical, read_noise_e=noise_dn / usual.optical.gain_dn_per_e))


def _warm_noise(netd_k: float, usual: Optics) -> Optics:
    return replace(usual, thermal=replace(usual.thermal, netd_k=netd_k))


QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        Quantity(
            "pixel-noise", "read noise (grey levels)", "Noise of the optical pixels that light doesn't bring; shot noise comes on top.",
            (0.4, 1.0, 2.0, 4.0, 8.0, 16.0), scenes.plain, optics=_noisy, logarithmic=True,
        ),
        Quantity(
            "calibration", "calibration error (px of the principal points)",
            "Standard deviation of each principal point that detectors are told; the stereo turn is off by as many pixels' angle about "
            f"each axis, the baseline by {miscalibration.BASELINE_MM_PER_PX:g} mm a pixel along each.",
            (0.0, 0.1, 0.2, 0.3, 0.4, 0.5), scenes.plain, told=miscalibration.told,
        ),
        Quantity(
            "range", "range (m)", "Mean distance of the ends along the right camera's axis.",
            (1.0, 1.15, 1.3, 1.45, 1.6, 1.75), scenes.at_range,
        ),
        Quantity(
            "contrast", "contrast (share of the board's grey)", "How much darker the teats' sides are than the board, both in even light.",
            (0.03, 0.06, 0.12, 0.25, 0.5, 0.85), scenes.of_contrast, logarithmic=True,
        ),
        Quantity(
            "netd", "NETD (K)", "Fresh noise of the thermal pixels.",
            (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0), scenes.plain, optics=_warm_noise, thermal=True, logarithmic=True,
        ),
        Quantity("tilt", "lean (degrees)", "Lean of every teat, each another way.", (0.0, 5.0, 10.0, 14.0, 18.0, 22.0), scenes.leaning),
        Quantity(
            "overlap", "covered share of a far teat's width", "Two pairs of teats, one 45 mm behind the other; below zero is a gap.",
            (-0.4, -0.1, 0.05, 0.2, 0.35, 0.5), scenes.overlapping,
        ),
        Quantity(
            "arm-gap", "gap to the arm (mm)", "From the farthest teat to a bare forearm behind the ends, at the elbow.",
            (10.0, 30.0, 60.0, 100.0, 180.0, 300.0), scenes.before_arm,
        ),
    )
}  # fmt: skip


def chosen(names: Sequence[str]) -> tuple[Quantity, ...]:
    """The quantities of these names, all for none. Raises ConfigError for one that isn't known."""
    for name in names:
        if name not in QUANTITIES:
            close = difflib.get_close_matches(name, QUANTITIES, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise ConfigError.plain(f"there is no quantity {name!r}{hint} (known: {', '.join(QUANTITIES)})")
    return tuple(QUANTITIES[name] for name in dict.fromkeys(names)) or tuple(QUANTITIES.values())
