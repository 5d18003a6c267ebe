"""A picture of what a person is to set up: the plan of the plate with the teats and what stands
around them, and the same as the left camera will see it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.files import png_bytes, write_synced
from bench.rig.loading import LoadedRig
from bench.rig.scenes import rig_renderer
from instruments.operators.operator import Arrangement
from instruments.world.objects import SceneObject, make_object
from instruments.world.optics import Floats
from instruments.world.phantom import FLANGE_RADIUS_MM, PIVOT_MM, Phantom
from instruments.world.setups import Situation

FOLDER = "set-up"  # in the run's folder
SIDE_PX, MARGIN_MM, GRID_MM = 720, 70.0, 50.0
WARM_C, ROOM_C = 33.0, 21.0  # of the picture only
PAPER, GRID, INK, TEAT, OTHER = 255, 225, 30, 90, 170
FONT, LINE = cv2.FONT_HERSHEY_SIMPLEX, cv2.LINE_AA

Grey = NDArray[np.uint8]


def write_set_up_picture(folder: Path, name: str, asked: Arrangement, rig: LoadedRig) -> Path:
    """Write it into the run's ``folder``, once; its path. Raises OSError, ValueError."""
    path = folder / FOLDER / f"{name}.png"
    if not path.is_file():
        write_synced(path, png_bytes(set_up_picture(asked, rig)))
    return path


def set_up_picture(asked: Arrangement, rig: LoadedRig) -> Grey:
    """Plan and left camera's view side by side. Raises ValueError for an unknown object."""
    phantom = asked.phantom.moved(asked.pose)
    around = asked.scene or Situation("", 0, "", phantom)
    things = (*around.objects, *(make_object(**table) for table in asked.objects))
    warm_c = (WARM_C,) * len(phantom.teats)
    state = around.state(warm_c, WARM_C, ROOM_C, phantom=phantom, objects=things)
    renderer = rig_renderer(rig, rig.rig.seed)
    camera = renderer.cameras[0]
    seen = renderer.left.expose(state, renderer.shadows(state), np.random.default_rng(0))
    view = np.asarray(seen).astype(np.uint8)
    share = SIDE_PX / view.shape[0]
    wide = round(view.shape[1] * share)
    view = np.asarray(cv2.resize(view, (wide, SIDE_PX), interpolation=cv2.INTER_AREA), np.uint8)
    for teat, (x, y) in zip(phantom.teats, camera.project(phantom.ends_mm).tolist(), strict=True):
        _label(view, teat.name, (share * x, share * y - 8.0), 0.6)
    _label(view, "left camera", (14.0, 28.0), 0.7, middle=False)
    return np.ascontiguousarray(np.hstack([plan_of(phantom, things), view]))


def plan_of(phantom: Phantom, things: Sequence[SceneObject]) -> Grey:
    """The table from above, x to the right and y (away from the cameras) up, a line each 50 mm."""
    hulls = [hull for thing in things for hull in thing.hulls]
    spots = [np.array([PIVOT_MM]), phantom.bases_mm[:, :2], phantom.ends_mm[:, :2]]
    spots += [np.array([hull.a_mm[:2], hull.b_mm[:2]]) for hull in hulls]
    points = np.concatenate(spots)
    low, high = points.min(axis=0) - MARGIN_MM, points.max(axis=0) + MARGIN_MM
    scale = SIDE_PX / float((high - low).max())
    start = (low + high) / 2 - SIDE_PX / scale / 2

    def px(xy: Floats | Sequence[float]) -> tuple[int, int]:
        x, y = (np.asarray(xy)[:2] - start) * scale
        return round(float(x)), round(SIDE_PX - float(y))

    image = np.full((SIDE_PX, SIDE_PX), PAPER, np.uint8)
    for axis in (0, 1):
        first = np.ceil(start[axis] / GRID_MM) * GRID_MM
        for value in np.arange(first, start[axis] + SIDE_PX / scale, GRID_MM):
            at = px((value, value))[axis]
            ends = ((at, 0), (at, SIDE_PX)) if axis == 0 else ((0, at), (SIDE_PX, at))
            cv2.line(image, *ends, GRID, 1)
            spot = (at + 3, SIDE_PX - 6) if axis == 0 else (3, at - 3)
            cv2.putText(image, f"{value:.0f}", spot, FONT, 0.35, 120, 1, LINE)
    for hull in hulls:
        a, b = px(hull.a_mm), px(hull.b_mm)
        for spot, radius in ((a, hull.radius_a_mm), (b, hull.radius_b_mm)):
            cv2.circle(image, spot, round(radius * scale), OTHER, -1, LINE)
        cv2.line(image, a, b, OTHER, round(2 * min(hull.radius_a_mm, hull.radius_b_mm) * scale))
    for thing in things:
        x, y = px(thing.hulls[0].a_mm)
        _label(image, thing.name.replace("_", " "), (float(x), float(y)), 0.45)
    for teat, base, end in zip(phantom.teats, phantom.bases_mm, phantom.ends_mm, strict=True):
        cv2.circle(image, px(base), round(FLANGE_RADIUS_MM * scale), INK, 1, LINE)
        cv2.circle(image, px(end), round(teat.shape.radius_mm * scale), TEAT, -1, LINE)
        if any(teat.tilt_rad):
            cv2.arrowedLine(image, px(base), px(end), INK, 2, LINE)
        x, y = px(base)
        _label(image, teat.name, (float(x), y - FLANGE_RADIUS_MM * scale - 6.0), 0.6)
        text = f"{base[0]:.0f}, {base[1]:.0f}"
        _label(image, text, (float(x), y + FLANGE_RADIUS_MM * scale + 14.0), 0.4)
    _label(image, "from above, mm; cameras below", (14.0, 28.0), 0.7, middle=False)
    return image


def _label(
    image: Grey, text: str, at: tuple[float, float], size: float, *, middle: bool = True
) -> None:
    """``text`` with its baseline at ``at``, dark on a bright edge."""
    if not np.isfinite(at).all():
        return
    (wide, _), _ = cv2.getTextSize(text, FONT, size, 2)
    spot = (round(at[0] - wide / 2 * middle), round(at[1]))
    for colour, thick in ((255, 5), (0, 1)):
        cv2.putText(image, text, spot, FONT, size, colour, thick, LINE)
