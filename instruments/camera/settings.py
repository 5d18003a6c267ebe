"""A camera's settings and whether they took: a failure is an error unless it was a try."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from instruments.errors import DeviceError

Trigger = Literal["free", "software", "hardware"]
Value = bool | int | float | str
TOLERANCE = 0.02  # of a number's size: cameras round exposure and gain to steps of their own


@dataclass(frozen=True, slots=True)
class Settings:
    """None leaves the camera as it is. ``exposure`` in us (GenICam) or the backend's unit (OpenCV).

    ``features``: further GenICam features, set last in that order. ``trigger_source``: line of a
    hardware trigger. ``tries``: names that may fail, "all" for every one.
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


class ReadBack:
    """Collects what was asked and what is; raises for all that did not take at once."""

    def __init__(self, who: str, tries: frozenset[str]) -> None:
        self._who = who
        self._tries = tries
        self._wrong: list[str] = []
        self.notes: list[str] = []

    def compare(self, name: str, asked: object, seen: object) -> None:
        """Remember ``name`` where what is differs from what was asked."""
        if not same(asked, seen):
            self.refused(name, f"{name} asked {_shown(asked)}, is {_shown(seen)}")

    def refused(self, name: str, sentence: str) -> None:
        """Remember that ``name`` did not take; a fault, or a note where it was only a try."""
        tried = "all" in self._tries or name in self._tries
        (self.notes if tried else self._wrong).append(sentence)

    def finish(self) -> tuple[str, ...]:
        """The notes about tries. Raises DeviceError where anything else did not take."""
        if self._wrong:
            what = f"settings did not take: {'; '.join(self._wrong)}"
            hint = "Ask for what the camera offers, or name the setting in the rig file's try."
            raise DeviceError(self._who, what, hint=hint)
        return tuple(self.notes)


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
