"""The detectors that ship, by name. Strategy: a table of names, loaded only when one is created, so that listing them costs nothing.

The module may not import a detector at its top: `teatbench --help` reads this table.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from detector.protocol import Detector


@dataclass(frozen=True, slots=True)
class _Entry:
    description: str
    module: str
    attribute: str


_SHIPPED = {
    "thesis": _Entry(
        "the published algorithm, stage by stage: thermal edges, one homography, dark line in a 41 x 41 region",
        "detector.thesis.detector",
        "ThesisDetector",
    ),
}


class UnknownDetectorError(ValueError):
    """No detector has that name; the message lists those that exist."""


def available() -> dict[str, str]:
    """Name -> one line on what it is, of every detector that can be created."""
    return {name: entry.description for name, entry in _SHIPPED.items()}


def create(name: str) -> Detector:
    """A detector with its published settings. Raises UnknownDetectorError with the nearest name where there is no such detector."""
    entry = _SHIPPED.get(name)
    if entry is None:
        near = get_close_matches(name, _SHIPPED, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise UnknownDetectorError(f"no detector is called {name!r}{hint} There are: {', '.join(sorted(_SHIPPED))}.")
    return cast("Detector", getattr(import_module(entry.module), entry.attribute)())
