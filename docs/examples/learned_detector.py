"""A learned teat detector: two small networks, run by ONNX Runtime on the processor.

`find` sees a picture at a quarter of its size, and the thermal picture laid over it; it gives a map
of where teat ends are. `place` sees 64 x 64 pixels at full size around such a place, and gives the
end to a part of a pixel. Ends of the left and the right picture are matched by the calibration.
`learned_training.py` makes both networks. Needs: pip install onnxruntime

    with bench.open_detector(Learned()) as detector: ...

In an installed package, name `Learned` under the entry points `teatbench.detectors`; then every
command knows it. It is an example, not a rival of fused.
"""

import hashlib
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from detector import Calibration, Detection, Frames, Teat, homogeneous, trained_on_of, triangulate

HERE = Path(__file__).parent
SMALLER, CROP_PX = 4, 64  # of the picture that `find` sees; of what `place` sees
LEAST, MOST_ENDS, APART_PX = 0.3, 8, 4  # of the map: a peak's value, peaks, pixels between two
ROW_PX = 3.0  # left and right end are off their epipolar line by less
DEPTHS = (0.75, 1.35)  # of the working plane


class Learned:
    """Both networks, with what they say of their training."""

    name, device = "learned", "cpu"

    def __init__(self, folder: Path = HERE) -> None:
        files = [folder / f"learned.{part}.onnx" for part in ("find", "place")]
        self._find, self._place = (
            onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
            for path in files
        )
        whole = b"".join(path.read_bytes() for path in files)
        self.version = hashlib.sha256(whole).hexdigest()[:12]
        said = self._find.get_modelmeta().custom_metadata_map
        # the bench refuses to score it on that
        self.trained_on = trained_on_of(json.loads(said.get("trained_on", "{}")))

    @property
    def parameters(self) -> Mapping[str, Any]:
        """What changes an answer, beside the networks."""
        return {"least": LEAST, "row_px": ROW_PX, "depths": DEPTHS}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends in the world; none without a thermal picture in kelvin."""
        if frames.thermal_k is None:
            return Detection((), 0, "it needs the radiometric thermal picture")
        pictures = {"left": frames.left, "right": frames.right}
        left, right = (
            self.ends_px(grey, seen_small(grey, calibration, camera, frames.thermal_k))
            for camera, grey in pictures.items()
        )
        return Detection(tuple(map(Teat, matched(calibration, left, right))))

    def ends_px(self, grey: Any, seen: Any) -> list[Any]:
        """Teat ends in one picture, (column, row) each."""
        heat = self._find.run(None, {"seen": seen[None]})[0][0, 0]
        top = (heat >= cv2.dilate(heat, np.ones((2 * APART_PX + 1,) * 2))) & (heat > LEAST)
        peaks = sorted(np.argwhere(top).tolist(), key=lambda at: -heat[at[0], at[1]])[:MOST_ENDS]
        found = []
        for row, column in peaks:
            at = np.array([column, row]) * SMALLER + SMALLER // 2
            for _ in range(2):  # once more, with the end in the middle
                at = np.clip(np.rint(at), 0, (grey.shape[1] - 1, grey.shape[0] - 1)).astype(int)
                end_px = self._place.run(None, {"seen": crop(grey, *at)[None]})[0][0]
                at = at - CROP_PX // 2 + end_px
            found.append(at)
        return found


def seen_small(grey: Any, calibration: Calibration, camera: str, kelvin: Any) -> Any:
    """What `find` sees, (2, rows, columns): grey by its surroundings, and warmth."""
    rows, columns = grey.shape[0] // SMALLER, grey.shape[1] // SMALLER
    small = cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
    mean, square = (cv2.blur(one, (41, 41)) for one in (small, small * small))
    grey_part = (small - mean) / (np.sqrt(np.maximum(square - mean * mean, 0.0)) + 3.0)
    warmth = (thermal_over(calibration, camera, kelvin, rows, columns) - np.median(kelvin)) / 5.0
    return np.stack([np.clip(grey_part, -4.0, 4.0), np.clip(warmth, -1.0, 3.0)]).astype(np.float32)


def thermal_over(
    calibration: Calibration, camera: str, kelvin: Any, rows: int, columns: int
) -> Any:
    """The thermal picture as ``camera`` would see it on the working plane, smaller."""
    thermal, from_left = calibration.thermal, calibration.thermal_from_left
    assert thermal.lens is not None
    assert from_left is not None
    v, u = np.mgrid[:rows, :columns] * float(SMALLER) + (SMALLER - 1) / 2
    lens = calibration.left if camera == "left" else calibration.right
    points = plane_mm(calibration) * homogeneous(
        lens.normalize(np.column_stack([u.ravel(), v.ravel()]))
    )
    if camera == "right":
        points = calibration.right_from_left.inverse().apply(points)
    px = thermal.lens.project(from_left.apply(points))
    scale = thermal.sensor_size[0] / thermal.image_size[0]
    at: Any = ((px + 0.5) * scale - 0.5).astype(np.float32).reshape(rows, columns, 2)
    how: Any = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    return cv2.remap(kelvin.astype(np.float32), at[..., 0], at[..., 1], **how)


def plane_mm(calibration: Calibration) -> float:
    """The working plane's distance."""
    return calibration.homographies.plane_depth_mm or 1100.0


def crop(grey: Any, column: int, row: int) -> Any:
    """What `place` sees, (1, 64, 64); its first pixel is 32 left of and above this one."""
    half = CROP_PX // 2
    padded = cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REPLICATE)
    part = padded[row : row + CROP_PX, column : column + CROP_PX].astype(np.float32)
    return ((part - part.mean()) / (part.std() + 2.0))[None]


def matched(calibration: Calibration, left: list[Any], right: list[Any]) -> list[Any]:
    """Ends in world mm: pairs that fit both pictures and the working depth, the best first."""
    pairs = list(itertools.product(range(len(left)), range(len(right))))
    if not pairs:
        return []
    cameras = calibration.left, calibration.right
    given = np.array([left[i] for i, _ in pairs]), np.array([right[j] for _, j in pairs])
    points, _ = triangulate(*given, *cameras, calibration.right_from_left)
    off_px = 2.0 * np.abs(calibration.right.project(points) - given[1])[:, 1]
    depth = points[:, 2] / plane_mm(calibration)
    ends_mm, taken = calibration.world_from_right.apply(points), set[Any]()
    ends = []
    for number in np.argsort(off_px / ROW_PX + 4.0 * np.abs(depth - 1.0)).tolist():
        i, j = pairs[number]
        fits = off_px[number] < ROW_PX and DEPTHS[0] < depth[number] < DEPTHS[1]
        if fits and not {("left", i), ("right", j)} & taken:
            taken |= {("left", i), ("right", j)}
            ends.append(ends_mm[number])
    return ends
