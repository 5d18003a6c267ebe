"""A teat's outline as a camera sees it: where its edge runs in the picture, which way it faces, and the grey levels on both sides.

From the scene's own solids and its noise-free picture; no detector's code. May not know what is made of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from instruments.world.noise import Image
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import FLANGE_HEIGHT_MM, Phantom

BESIDE_PX = 3.0  # past the blurred edge, still within the narrowest teat
STEP_MM = 1.0
CAP_STEPS = 32


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Pieces of an outline: ``normal`` (n, 2) outwards, unit, ``length_px`` (n,), grey levels ``inside`` and ``outside`` (n,) in DN,
    and how far below the rounded end's middle each piece lies, ``below_mm`` (n,), 0 on the end.
    """

    normal: Floats
    length_px: Floats
    inside: Floats
    outside: Floats
    below_mm: Floats


def outline_of(phantom: Phantom, teat: int, camera: CameraModel, picture: Image) -> Outline:
    """The outline of teat number ``teat``: both sides down to the flange and the round of the end. ``picture`` is free of noise."""
    points, outward, below = _pieces(phantom, teat, camera)
    at = camera.project(points)
    normal = camera.project(points + 0.01 * outward) - at
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    along = np.linalg.norm(np.diff(at, axis=0), axis=1)
    length = 0.5 * (np.concatenate([[0.0], along]) + np.concatenate([along, [0.0]]))
    inside, outside = (_grey(picture, at + side * BESIDE_PX * normal) for side in (-1.0, 1.0))
    known = np.isfinite(inside) & np.isfinite(outside)
    return Outline(normal[known], length[known], inside[known], outside[known], below[known])


def _pieces(phantom: Phantom, teat: int, camera: CameraModel) -> tuple[Floats, Floats, Floats]:
    """Points (n, 3) mm up one side, over the end and down the other, the way (n, 3) each faces, and how far below the end's middle."""
    end, axis = phantom.ends_mm[teat], phantom.axes[teat]
    shape = phantom.teats[teat].shape
    middle = end - shape.radius_mm * axis
    view = middle - camera.centre_mm
    across = np.cross(axis, view)
    across /= np.linalg.norm(across)
    up = np.cross(view, across)
    up *= np.sign(up @ axis) / np.linalg.norm(up)
    down = np.arange(0.0, shape.length_mm - shape.radius_mm - FLANGE_HEIGHT_MM, STEP_MM)
    turn = np.linspace(0.0, np.pi, CAP_STEPS)[1:-1]
    cap = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up
    outward = np.concatenate([np.tile(across, (len(down), 1)), cap, np.tile(-across, (len(down), 1))])
    below = np.concatenate([down[::-1], np.zeros(len(cap)), down])
    return middle - below[:, None] * axis + shape.radius_mm * outward, outward, below


def _grey(picture: Image, at: Floats) -> Floats:
    """Grey levels (n,) at pixels (n, 2), bilinear; NaN off the picture."""
    x, y = (at[:, i].astype(np.float32)[None, :] for i in (0, 1))
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))[0], np.float64)
