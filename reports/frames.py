"""Frames of a trial and what is drawn over them, as data: shapes in layers that can be switched
off.

Coordinates are pixels of the image file `src`: x right, y down, the first pixel's centre (0, 0).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from hashlib import sha256
from itertools import chain
from operator import attrgetter
from typing import Any, Literal, get_args

from reports.trust import PageError, address

LayerTone = Literal["truth", "nomination", "region", "point", "model", "spread", "other"]
LAYER_TONES: tuple[LayerTone, ...] = get_args(LayerTone)


@dataclass(frozen=True, slots=True)
class Circle:
    """A ring; `title` is what the pointer shows over it."""

    x_px: float
    y_px: float
    radius_px: float = 8.0
    title: str = ""


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Half axes `major_px` and `minor_px`; the first is `turn_deg` from x towards y."""

    x_px: float
    y_px: float
    major_px: float
    minor_px: float
    turn_deg: float
    title: str = ""


@dataclass(frozen=True, slots=True)
class Cross:
    """Two strokes that meet at (x, y); `turned` makes an X of the plus."""

    x_px: float
    y_px: float
    arm_px: float = 8.0
    turned: bool = False
    title: str = ""


@dataclass(frozen=True, slots=True)
class Rect:
    """Top left corner and size; pixels x to x + n - 1 start at x - 0.5 and are n wide."""

    x_px: float
    y_px: float
    width_px: float
    height_px: float
    title: str = ""


@dataclass(frozen=True, slots=True)
class Polyline:
    """Straight lines through `points_px`, (x, y) pairs; `closed` joins the last to the first."""

    points_px: tuple[tuple[float, float], ...]
    closed: bool = False
    title: str = ""


@dataclass(frozen=True, slots=True)
class Label:
    """A short text on the baseline y, `gap_px` right of x, or left of it where the view ends; its
    size follows the view, not the pixels.
    """

    x_px: float
    y_px: float
    text: str
    gap_px: float = 0.0


Shape = Circle | Ellipse | Cross | Rect | Polyline | Label
_NUMBERS: dict[type, Callable[[Any], Iterable[float]]] = {
    kind: attrgetter(*(one.name for one in fields(kind) if one.type is float))
    for kind in (Circle, Ellipse, Cross, Rect, Label)
} | {Polyline: lambda line: chain(*line.points_px)}


def places_of(detectors: Iterable[str]) -> dict[str, int]:
    """The place from 1 of each detector, which picks its colour and mark: by its name, so that it
    is the same on every page. Where two names share one, the later in the alphabet has the next.
    """
    names = dict.fromkeys(detectors)
    found: dict[str, int] = {}
    for name in sorted(names, key=lambda name: (name not in KNOWN_PLACES, name)):
        place = (
            KNOWN_PLACES.get(name)
            or 1 + int(sha256(name.encode()).hexdigest(), 16) % MOST_DETECTORS
        )
        while place in found.values() and len(found) < MOST_DETECTORS:
            place = place % MOST_DETECTORS + 1
        found[name] = place
    return {name: found[name] for name in names}


def answer_colour(who: int) -> str:
    """The colour over a picture of the detector at place `who`, from 1."""
    return ANSWER_COLOURS[(who - 1) % len(ANSWER_COLOURS)]


def strokes(mark: Shape) -> list[tuple[tuple[float, float], ...]]:
    """The lines of an answer's mark, for what draws on pixels."""
    match mark:
        case Cross(x, y, a, turned):
            b = a if turned else 0.0
            return [((x - a, y - b), (x + a, y + b)), ((x - b, y + a), (x + b, y - a))]
        case Rect(x, y, wide, high):
            corners = ((x, y), (x + wide, y), (x + wide, y + high), (x, y + high))
            return [(*corners, corners[0])]
        case Polyline(points, closed):
            return [(*points, points[0]) if closed else points]
    raise TypeError(f"{type(mark).__name__} is no mark of an answer")


def answer_mark(who: int, x_px: float, y_px: float, arm_px: float, title: str = "") -> Shape:
    """The mark of an answer of the detector at place `who`, from 1; an X without one."""
    x, y, a = x_px, y_px, arm_px
    match MARKS[(who - 1 + (who - 1) // len(MARKS)) % len(MARKS)] if who else "cross":
        case "square":
            return Rect(x - a, y - a, 2 * a, 2 * a, title)
        case "triangle":
            return Polyline(((x, y - 1.2 * a), (x + a, y + a), (x - a, y + a)), True, title)
        case "diamond":
            ends = ((x, y - 1.3 * a), (x + 1.3 * a, y), (x, y + 1.3 * a), (x - 1.3 * a, y))
            return Polyline(ends, True, title)
    return Cross(x, y, a, turned=True, title=title)


MARKS = ("cross", "square", "triangle", "diamond")
# over a picture, with a dark line about them: the truth, and answers by their detector's place
TRUTH_COLOUR, ANSWER_COLOURS = "#5dff8f", ("#7cc4ff", "#ffb454", "#e9a6ff", "#ffffff")
MOST_DETECTORS = len(MARKS) ** 2  # that marks and colours tell apart
KNOWN_PLACES = {"fused": 1, "thesis": 2}


@dataclass(frozen=True, slots=True)
class Overlay:
    """One layer: `tone` picks colour and switch, `name` is in the legend. `who`: the place of the
    detector whose it is (`places_of`), which picks the colour.
    """

    tone: LayerTone
    name: str
    shapes: tuple[Shape, ...]
    who: int = 0

    def __post_init__(self) -> None:
        for shape in self.shapes:
            if not all(map(math.isfinite, _NUMBERS[type(shape)](shape))):
                raise PageError(
                    f"overlay {self.name!r}: {shape} has a coordinate that is not finite; leave the"
                    " shape out"
                )


@dataclass(frozen=True, slots=True)
class ImageView:
    """An image file, or the part `view_box` (x, y, width, height); a click opens `original`.
    `width` and `height` are those that the overlays count in; `camera` says whose it is.
    `shown_as`: the browser exchanges the file's left and right, or black and white.
    """

    label: str
    src: str
    width: int
    height: int
    alt: str
    overlays: tuple[Overlay, ...] = ()
    view_box: tuple[int, int, int, int] | None = None
    original: str = ""
    shown_as: Literal["", "mirrored", "inverted"] = ""
    camera: str = ""

    def __post_init__(self) -> None:
        what = f"image {self.label!r}"
        for path in self.files:
            if path.startswith("#"):
                raise PageError(f"{what}: {path!r} is no file; give a path from the page's folder")
            address(path, what)
        if self.width <= 0 or self.height <= 0:
            raise PageError(f"{what}: {self.width} x {self.height} pixels; both must be above 0")
        x, y, width, height = self.shown
        inside = 0 <= x < x + width <= self.width and 0 <= y < y + height <= self.height
        if not inside:
            raise PageError(
                f"{what}: view_box {self.view_box} leaves the image of {self.width} x {self.height}"
                " pixels"
            )

    @property
    def files(self) -> tuple[str, str]:
        """What is shown, and what a click opens."""
        return self.src, self.original or self.src

    @property
    def shown(self) -> tuple[int, int, int, int]:
        """The part that is shown at first: (x, y, width, height) in pixels."""
        return self.view_box or (0, 0, self.width, self.height)


def layers(images: Iterable[ImageView]) -> dict[LayerTone, str]:
    """Tone and name of every layer, in LAYER_TONES order. Raises PageError for two names a tone."""
    names: dict[LayerTone, str] = {}
    for image in images:
        for overlay in image.overlays:
            known = names.setdefault(overlay.tone, overlay.name)
            if known != overlay.name:
                raise PageError(
                    f"image {image.label!r}: layer {overlay.tone!r} is called {overlay.name!r} here"
                    f" and {known!r} elsewhere"
                )
    return {tone: names[tone] for tone in LAYER_TONES if tone in names}
