"""The thesis's detector: its stages in published order.

What would have stopped the original gives no teats and a reason. The world is reached by the
calibration's rigid motion. One switch: the calibration's homographies, or those of section 3.2.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration, Homographies
from detector.calibration import thesis_rig as printed
from detector.geometry import Array, triangulate
from detector.protocol import Detection, Frames, Stage, Teat
from detector.thesis import lines
from detector.thesis.optical import RefinedEnd, nominate, refine
from detector.thesis.parameters import ThesisParameters
from detector.thesis.thermal import (
    Grey,
    eight_bit,
    find_edges,
    order_filter,
    picture_from_kelvin,
    unmirror,
)

PUBLISHED_HOMOGRAPHIES = Homographies(
    np.array(printed.HOMOGRAPHY_LEFT), np.array(printed.HOMOGRAPHY_RIGHT), None
)


class _NoAnswer(Exception):  # noqa: N818 (ends a detection early, caught in `detect`; never seen by a caller)
    """Why this frame set gets no teats, and how many the stage that gave up counts as hidden."""

    def __init__(self, reason: str, hidden: int = 0) -> None:
        super().__init__(reason)
        self.hidden = hidden


@dataclass(frozen=True, slots=True)
class ThesisDetector:
    """Chapter 4 and appendix A of the thesis, with the published settings by default."""

    settings: ThesisParameters = field(default_factory=ThesisParameters)
    name: str = "thesis"  # in the registry

    @property
    def version(self) -> str:
        """Counted up when an answer on any frame set changes."""
        return "1"

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The settings by name."""
        return asdict(self.settings)

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends in the world frame, no covariances, and the trace of every stage reached."""
        trace: list[Stage] = []
        try:
            left = _optical(frames.left, calibration.left.image_size, "left")
            right = _optical(frames.right, calibration.right.image_size, "right")
            thermal = _thermal(frames, calibration)
            thermal_px, hidden = _find_in_thermal(thermal, self.settings, trace)
            teats, reason = _locate(left, right, thermal_px, calibration, self.settings, trace)
        except _NoAnswer as stop:
            return Detection((), stop.hidden, str(stop), tuple(trace))
        return Detection(teats, hidden, reason, tuple(trace))


def _optical(image: NDArray[Any], size: tuple[int, int], camera: str) -> Grey:
    try:
        picture = eight_bit(image)
    except ValueError as error:
        raise _NoAnswer(f"the {camera} picture {error}") from None
    _check_size(picture, size, camera)
    return picture


def _thermal(frames: Frames, calibration: Calibration) -> Grey:
    """The un-mirrored 8-bit thermal picture at the calibration's size."""
    camera = calibration.thermal
    try:
        if frames.thermal is not None:
            picture = eight_bit(frames.thermal)
            _check_size(picture, camera.image_size, "thermal")
            return unmirror(picture) if camera.mirrored else picture
        if frames.thermal_k is not None:
            _check_size(frames.thermal_k, camera.sensor_size, "radiometric thermal")
            return picture_from_kelvin(frames.thermal_k, camera.image_size)
    except ValueError as error:
        raise _NoAnswer(f"the thermal picture {error}") from None
    raise _NoAnswer("there is no thermal picture, and the thesis's method begins with one")


def _check_size(picture: NDArray[Any], size: tuple[int, int], camera: str) -> None:
    if picture.shape[:2] != (size[1], size[0]):
        given, wanted = (" x ".join(map(str, one)) for one in (picture.shape[1::-1], size))
        raise _NoAnswer(f"the {camera} picture is {given}, the calibration is for {wanted}")


def _find_in_thermal(picture: Grey, p: ThesisParameters, trace: list[Stage]) -> tuple[Array, int]:
    """Thermal teat ends (n, 2) px, at least one, and how many are hidden (4.1.1 to 4.1.7)."""

    def reached(stage: str, **data: Any) -> None:
        trace.append(Stage(stage, data))

    reached("thermal", picture=picture)
    edges = find_edges(picture, p)
    reached("edges", mask=edges.mask, thresholds=np.array([edges.low, edges.high]))
    verticals = order_filter(edges.mask, p.vertical_domain)
    horizontals = order_filter(edges.mask, p.horizontal_domain)
    reached("verticals", mask=verticals)
    reached("horizontals", mask=horizontals)
    ends = lines.vertical_ends(verticals, p)
    reached("vertical ends", points_px=ends)
    if len(ends) == 0:
        what = f"no vertical line of {p.vertical_least_points} points"
        raise _NoAnswer(f"the thermal picture shows {what}", p.teat_count)
    centre = lines.window_centre(ends)
    if p.window_outside == "refuse" and not lines.window_fits(picture.shape, centre, p):
        what = f"the window around column {centre[0]}, row {centre[1]}"
        raise _NoAnswer(f"{what} leaves the thermal picture", p.teat_count)
    middles = lines.horizontal_middles(horizontals, centre, p)
    reached("horizontal middles", points_px=middles, window_centre_px=np.array(centre, np.float64))
    if len(middles) == 0:
        what = "no short horizontal line near the ends of the vertical ones"
        raise _NoAnswer(f"the thermal picture shows {what}", p.teat_count)
    teats_px, hidden = lines.teat_ends(middles, p)
    reached("teat ends", points_px=teats_px)
    if len(teats_px) == 0:
        what = f"no horizontal line lies within {p.teat_row_tolerance_px} rows of their mean"
        raise _NoAnswer(what, p.teat_count)
    return teats_px, hidden


def _locate(
    left: Grey,
    right: Grey,
    thermal_px: Array,
    calibration: Calibration,
    p: ThesisParameters,
    trace: list[Stage],
) -> tuple[tuple[Teat, ...], str | None]:
    """Thermal teat ends (n, 2) to world teats, and what was left out (4.2, 4.3, 3.2.1.2, 3.3.2)."""
    maps = _homographies(calibration, p)
    nominated = nominate(maps.left, thermal_px), nominate(maps.right, thermal_px)
    trace.append(Stage("nominations", {"left_px": nominated[0], "right_px": nominated[1]}))
    refined = {
        side: [refine(picture, px, p) for px in ends]
        for (side, picture), ends in zip((("left", left), ("right", right)), nominated, strict=True)
    }
    seen = {
        name: {side: np.array([getattr(r, name) for r in found]) for side, found in refined.items()}
        for name in RefinedEnd.__slots__
    }
    bright = {f"{side}_bright": mask for side, mask in seen["bright"].items()}
    trace.append(Stage("regions", {**seen["region"], **bright}))
    moved = {f"{side}_moved": each for side, each in seen["moved"].items()}
    left_px, right_px = seen["end_px"].values()
    trace.append(Stage("ends", {"left_px": left_px, "right_px": right_px, **moved}))
    right_mm, gap_mm = triangulate(
        left_px, right_px, calibration.left, calibration.right, calibration.right_from_left
    )
    world_mm = calibration.world_from_right.apply(right_mm)
    found = {"right_mm": right_mm, "gap_mm": gap_mm, "world_mm": world_mm}
    trace.append(Stage("triangulation", found))
    usable = _inside(left_px, left) & _inside(right_px, right) & np.isfinite(world_mm).all(axis=1)
    rows = zip(world_mm, left_px, right_px, thermal_px, usable, strict=True)
    teats = tuple(Teat(world, None, *pixels) for world, *pixels, kept in rows if kept)
    lost = int(np.count_nonzero(~usable))
    reason = f"{lost} of {len(usable)} nominated teats lie outside of an optical picture"
    return teats, reason if lost else None


def _homographies(calibration: Calibration, p: ThesisParameters) -> Homographies:
    if p.homographies == "calibration":
        return calibration.homographies
    cameras = calibration.thermal, calibration.left, calibration.right
    sizes = tuple(camera.image_size for camera in cameras)
    if sizes != (printed.THERMAL_IMAGE_SIZE, printed.IMAGE_SIZE, printed.IMAGE_SIZE):
        what = "pictures of 640 x 480 and 1360 x 1024, not for the calibration's"
        raise _NoAnswer(f"the published homographies are for {what}", p.teat_count)
    return PUBLISHED_HOMOGRAPHIES


def _inside(points_px: Array, picture: Grey) -> NDArray[np.bool_]:
    """Which points (n, 2) lie on the picture."""
    beyond = np.array(picture.shape[::-1]) - 0.5
    with np.errstate(invalid="ignore"):
        return np.asarray(np.all((points_px >= -0.5) & (points_px < beyond), axis=1))


# the printed homographies are right at 1168 mm, some 6 px off at the teats
published_homography = partial(
    ThesisDetector, ThesisParameters(homographies="published"), "thesis-published-homography"
)
