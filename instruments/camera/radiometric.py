"""Thermal cameras that deliver temperatures as counts, by name: what makes them do so, and what a
count is. No such camera was at hand: what a row has is from the source that it names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from instruments.camera.settings import Value


@dataclass(frozen=True, slots=True)
class RadiometricProfile:
    """``kelvin_per_count``; ``features`` to be set; the command that closes the ``shutter``."""

    kelvin_per_count: float
    pixel_format: str
    source: str
    features: Mapping[str, Value] = field(default_factory=dict)
    shutter: str = ""


_LEPTON = "FLIR, Lepton software interface description, RAD TLinear resolution"
_BOSON = "inferred: FLIR, Boson radiometry application note, TLinear"
_AX5 = "FLIR support, temperature linear mode of Ax5; TemperatureLinearMode's word is inferred"
_A = "FLIR support, temperature linear mode of A3xx, A6xx, A50, A70, A400 and A700"


def _flir(
    kelvin_per_count: float, pixel_format: str, source: str, **features: Value
) -> RadiometricProfile:
    """Over GigE Vision."""
    return RadiometricProfile(
        kelvin_per_count, pixel_format, source, features=features, shutter="NUCAction"
    )


def _ax5(kelvin_per_count: float, resolution: str) -> RadiometricProfile:
    mode = {"TemperatureLinearMode": "On", "CMOSBitDepth": "bit14bit"}
    return _flir(kelvin_per_count, "Mono14", _AX5, **mode, TemperatureLinearResolution=resolution)


PROFILES: Mapping[str, RadiometricProfile] = {
    # over UVC (PureThermal): TLinear is set in the camera, by its maker's program
    "lepton": RadiometricProfile(0.01, "Y16", _LEPTON),
    "lepton-low-gain": RadiometricProfile(0.1, "Y16", _LEPTON),
    "boson": RadiometricProfile(0.01, "Y16", _BOSON),
    "flir-ax5": _ax5(0.04, "High"),
    "flir-ax5-low": _ax5(0.4, "Low"),
    "flir-a": _flir(0.01, "Mono16", _A, IRFormat="TemperatureLinear10mK"),
    "flir-a-100mk": _flir(0.1, "Mono16", _A, IRFormat="TemperatureLinear100mK"),
}
