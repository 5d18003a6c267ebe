"""A camera's settings and whether they took: a failure is an error unless it was a try."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from instruments.errors import DeviceError

Trigger = Literal["free", "software", "hardware"]
Value = bool | int | float | str
AUTOMATIC = "automatic functions are on"
UNSEEN_SIZE = "a change of the picture size goes unnoticed"
TOLERANCE = 0.02  # of a number's size: cameras round exposure and gain to steps of their own


@dataclass(frozen=True, slots=True)
class Settings:
    """None leaves the camera as it is. ``exposure``: us (GenICam) or the backend's unit.
    ``features``: further GenICam features, set last. ``tries``: names that may fail, or "all".
    ``auto``: automatic functions stay on. ``counts``: 16 bits as the sensor gives them. ``ptp``:
    wait for its clock. ``shutter``: command before each capture.
    """

    resolution: tuple[int, int] | None = None
    pixel_format: str | None = None
    exposure: float | None = None
    gain: float | None = None
    fps: float | None = None
    features: Mapping[str, Value] = field(default_factory=dict)
    trigger: Trigger = "free"
    trigger_source: str = "Line0"
    tries: frozenset[str] = frozenset()
    auto: bool = False
    counts: bool = False
    ptp: bool = False
    shutter: str = ""
    shutter_s: float = 1.0
    depth: bool = False


def apply(
    who: str,
    settings: Settings,
    ways: Mapping[str, tuple[Callable[[Any], object], Callable[[], object]]],
    failures: tuple[type[Exception], ...] = (),
) -> tuple[str, ...]:
    """Write each setting and read it back by its ways; notes about tries. Raises DeviceError that
    names all that did not take.
    """
    asked = {name: getattr(settings, name, None) for name in ways} | dict(settings.features)
    taken, faults = [], []
    for name, (write, read) in ways.items():
        if asked[name] is None:
            continue
        try:
            write(asked[name])
            taken.append((name, read))
        except failures as error:
            faults.append((name, f"{name} was refused: {_message(error)}"))
    for name, read in taken:  # all set before any is read: one may change another
        try:
            if not same(asked[name], seen := read()):
                what = f"{name} asked {_shown(asked[name])}, is {_shown(seen)}"
                faults.append((name, what))
        except failures as error:
            faults.append((name, f"{name} can't be read back: {_message(error)}"))
    if wrong := [fault for name, fault in faults if not {"all", name} & settings.tries]:
        what = f"settings did not take: {'; '.join(wrong)}"
        hint = "Ask for what the camera offers, or name the setting in the rig file's try."
        raise DeviceError(who, what, hint=hint)
    return tuple(fault for _, fault in faults)


def hold_still(
    who: str, settings: Settings, functions: Mapping[str, Callable[[bool], str]]
) -> tuple[str, ...]:
    """Switch automatic functions off, unless ``settings`` allow them; notes about those that are
    on. Each of ``functions`` is called with whether to switch off, and gives its state, "" for off.
    Raises DeviceError.
    """
    on = [
        f"{name} {state}"
        for name, function in functions.items()
        if (state := function(not settings.auto))
    ]
    if on and not settings.auto:
        what = f"automatic functions can't be switched off: {', '.join(on)}"
        hint = "Switch them off by the maker's program; or auto = true in the rig file: then the"
        raise DeviceError(who, what, hint=f"{hint} report says that they are on.")
    return (f"{AUTOMATIC}: {', '.join(on)}",) if on else ()


def _message(error: Exception) -> str:
    return error.what if isinstance(error, DeviceError) else str(getattr(error, "message", error))


def same(asked: object, seen: object) -> bool:
    """Whether a setting took: numbers within 2 %, true and 1 alike, words without case."""
    if isinstance(asked, tuple) and isinstance(seen, tuple):
        return asked == seen
    if isinstance(asked, bool):
        return str(seen).lower() in (("true", "1", "on") if asked else ("false", "0", "off"))
    if isinstance(asked, int | float):
        try:
            return math.isclose(asked, float(str(seen)), rel_tol=TOLERANCE, abs_tol=1e-9)
        except ValueError:
            return False
    return str(asked).lower() == str(seen).strip().lower()


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return " x ".join(str(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
