"""Detectors by name: shipped, or of other packages (entry points ``teatbench.detectors``).

Loaded only when created, so `teatbench --help` stays fast. An entry point gives an object with
``detect(frame_set, calibration)``, its class, or a function that makes it. A broken one is reported
by name only.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from json import dumps, loads
from typing import TYPE_CHECKING, Any, cast

from textfiles.text import named

if TYPE_CHECKING:
    from detector.calibration import Calibration
    from detector.protocol import Context, Detection, Detector, Frames, TrainedOn

GROUP = "teatbench.detectors"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")  # it becomes a part of files' names
_PHRASES = ("device", "computed_by", "covariance_leaves_out")  # that the report quotes

# name: where what makes it is, and one line on it
SHIPPED = {
    "thesis": ("thesis.detector", "ThesisDetector"),
    "fused": ("fused.detector", "FusedDetector"),
    "thesis-published-homography": ("thesis.detector", "published_homography"),
    "depth": ("depth", "DepthDetector"),
}
_ABOUT = """\
the published algorithm, stage by stage: thermal edges, one homography, dark line in a\
 41 x 41 region
the bench's own: thermal nominates, optics localise, stereo decides
the thesis's with the homographies that it printed, not the calibration's at the teats' plane
a plain baseline on a depth camera's picture alone: what stands up narrow before something\
 farther
"""


class UnknownDetectorError(ValueError):
    """No detector has that name; the message lists those that exist."""


class BrokenDetectorError(ValueError):
    """A package's detector can't be loaded; says which package, and why."""


@dataclass(frozen=True, slots=True)
class PluginDetector:
    """An object of another package as a detector: what it doesn't say of itself is filled in."""

    name: str
    version: str
    parameters: Mapping[str, Any]
    inner: Any
    trained_on: TrainedOn = field(default_factory=dict)
    device: str = ""
    computed_by: str = ""
    covariance_leaves_out: str = ""

    def refuses(self, calibration: Calibration) -> str | None:
        """Why the object can't be used with such a rig, if it says so."""
        own = getattr(self.inner, "refuses", None)
        return cast("str | None", own(calibration)) if own else None

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """The object's own answer; the caller checks it."""
        return cast("Detection", self.inner.detect(frames, calibration))

    def detect_with(self, frames: Frames, calibration: Calibration, context: Context) -> Detection:
        """The same with a cow's history, for an object that can use it."""
        own = getattr(self.inner, "detect_with", None)
        found = own(frames, calibration, context) if own else self.detect(frames, calibration)
        return cast("Detection", found)


def available(plugs: Iterable[EntryPoint] | None = None) -> dict[str, str]:
    """Name -> one line on every detector; ``plugs``: entry points, by default the group's."""
    usable = [plug for plug in _plugs(plugs) if _NAME.fullmatch(plug.name)]
    others = {plug.name: f"from {_source(plug)}" for plug in reversed(usable)}
    return {**others, **dict(zip(SHIPPED, _ABOUT.splitlines(), strict=True))}


def broken(plugs: Iterable[EntryPoint] | None = None) -> dict[str, str]:
    """Name -> why it can't be used, of other packages' detectors, which are loaded for it."""
    found: dict[str, str] = {}
    seen: set[str] = set()
    for plug in _plugs(plugs):
        fault = None
        if not _NAME.fullmatch(plug.name):
            allowed = "letters, digits, dots, _ and - are allowed"
            fault = f"gives it a name that no file could bear: {allowed}"
        elif plug.name in SHIPPED:
            shipped = "which is the name of one that ships: it is left out"
            fault = f"brings a detector of this name, {shipped}"
        elif plug.name in seen:
            fault = "brings a second detector of this name: the first is used"
        if fault:
            found[plug.name] = f"{_source(plug)} {fault}"
        else:
            try:
                _plugged(plug)
            except BrokenDetectorError as error:
                found[plug.name] = str(error)
        seen.add(plug.name)
    return found


def create(name: str, plugs: Iterable[EntryPoint] | None = None) -> Detector:
    """A detector with its own settings. Raises UnknownDetectorError, BrokenDetectorError."""
    if name in SHIPPED:
        module, maker = SHIPPED[name]
        return cast("Detector", getattr(import_module(f"detector.{module}"), maker)())
    usable = (plug for plug in _plugs(plugs) if _NAME.fullmatch(plug.name))
    plug = next((plug for plug in usable if plug.name == name), None)
    if plug is None:
        known = sorted(available(plugs))
        near = get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        there = f"There are: {', '.join(known)}."
        raise UnknownDetectorError(f"no detector is called {name!r}{hint} {there}")
    return _plugged(plug)


def _plugs(plugs: Iterable[EntryPoint] | None) -> list[EntryPoint]:
    return list(entry_points(group=GROUP) if plugs is None else plugs)


def _plugged(plug: EntryPoint) -> PluginDetector:
    from detector.protocol import trained_on_of  # numpy: not for a list of names

    who = f"detector {plug.name!r} of {_source(plug)}"
    # another's code: it may fail in any way, and not every library's errors are Exceptions
    try:
        given = plug.load()
        made = given() if isinstance(given, type) or not hasattr(given, "detect") else given
        parameters = loads(dumps(dict(getattr(made, "parameters", {})), default=_plain))
        own = plug.dist.version if plug.dist else "unknown"
        version = _line(str(getattr(made, "version", None) or own))
        trained_on = trained_on_of(getattr(made, "trained_on", {}))
        phrases = {name: _line(str(getattr(made, name, None) or "")) for name in _PHRASES}
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise BrokenDetectorError(f"{who} can't be loaded: {_line(named(error))}") from error
    if not callable(getattr(made, "detect", None)):
        what = f"is a {type(made).__name__}, which has no detect(frame_set, calibration)"
        raise BrokenDetectorError(f"{who} {what}")
    return PluginDetector(plug.name, version, parameters, made, trained_on, **phrases)


def _source(plug: EntryPoint) -> str:
    package = f"{plug.dist.name} {plug.dist.version}" if plug.dist else "an unknown package"
    return f"{package} ({plug.value})"


def _plain(value: object) -> object:
    """What JSON has no word for: arrays as lists, else as text."""
    listed = getattr(value, "tolist", None)
    return listed() if callable(listed) else str(value)


def _line(text: str) -> str:
    """On one line, and such as a file takes."""
    return " ".join(text.split()).encode("utf-8", "replace").decode("utf-8")
