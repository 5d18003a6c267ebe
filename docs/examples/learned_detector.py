"""A learned teat detector: two small networks, run by ONNX Runtime on the processor.

`find` sees a picture at a quarter of its size, and the thermal picture laid over it; it gives a map
of where teat ends are. `place` sees 64 x 64 pixels at full size around such a place, and gives the
end to a part of a pixel. Ends of the left and the right picture are matched by the calibration. The
program of the same name with _train at its end makes both networks out of a recording.

Usage: python3 mine.py mine.find.onnx mine.place.onnx (both files in the command, so that they count
as parts of the detector's version). Needs: pip install onnxruntime numpy opencv-python-headless
"""

import itertools
import json
import sys
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

SMALLER, CROP_PX = 4, 64  # of the picture that `find` sees; of what `place` sees
LEAST, MOST_ENDS, APART_PX = 0.3, 8, 4  # of the map: a peak's value, peaks, pixels between two
ROW_PX = 3.0  # left and right end are off their epipolar line by less
DEPTHS = (0.75, 1.35)  # of the calibration's working plane


class Rig:
    """The calibration as OpenCV takes it. X_right = R X_left + T, and so on; mm."""

    def __init__(self, path: str) -> None:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
        self.cameras = {}
        for name, one in table["cameras"].items():
            K = np.array(
                [
                    [one["fc"][0], one["alpha_c"] * one["fc"][0], one["cc"][0]],
                    [0.0, one["fc"][1], one["cc"][1]],
                    [0.0, 0.0, 1.0],
                ]
            )
            self.cameras[name] = K, np.array(one["kc"])
        self.stereo, self.thermal, self.world = (
            (cv2.Rodrigues(np.array(table[name]["om"]))[0], np.array(table[name]["T"]))
            for name in ("stereo", "thermal", "world")
        )
        thermal = table["cameras"]["thermal"]
        self.thermal_scale = thermal["sensor_size"][0] / thermal["image_size"][0]
        self.depth_mm = table.get("homography", {}).get("plane_depth_mm", 1100.0)
        self._maps: dict[tuple[str, int, int], Any] = {}

    def rays(self, camera: str, px: Any) -> Any:
        """Pixels (n, 2) in the plane at distance 1, without distortion, (n, 2)."""
        return cv2.undistortPoints(
            np.reshape(px, (-1, 1, 2)).astype(np.float64), *self.cameras[camera]
        )[:, 0]

    def thermal_over(self, camera: str, kelvin: Any, rows: int, columns: int) -> Any:
        """The thermal picture as ``camera`` would see it on the working plane, smaller."""
        key = (camera, rows, columns)
        if key not in self._maps:
            v, u = np.mgrid[:rows, :columns] * float(SMALLER) + (SMALLER - 1) / 2
            rays = self.rays(camera, np.column_stack([u.ravel(), v.ravel()]))
            points = self.depth_mm * np.column_stack([rays, np.ones(len(rays))])
            if camera == "right":
                points = (points - self.stereo[1]) @ self.stereo[0]
            R, T = self.thermal
            px, _ = cv2.projectPoints(points, cv2.Rodrigues(R)[0], T, *self.cameras["thermal"])
            px = ((px + 0.5) * self.thermal_scale - 0.5).astype(np.float32)
            self._maps[key] = px[:, 0, 0].reshape(rows, -1), px[:, 0, 1].reshape(rows, -1)
        warm, (columns_px, rows_px) = kelvin.astype(np.float32), self._maps[key]
        how: Any = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
        return cv2.remap(warm, columns_px, rows_px, **how)

    def world_mm(self, left_px: Any, right_px: Any) -> tuple[Any, float, float]:
        """An end in world mm, its depth before the right camera, and how far off its row it is."""
        (R, T), rays = self.stereo, [self.rays("left", left_px)[0], self.rays("right", right_px)[0]]
        point = cv2.triangulatePoints(np.eye(3, 4), np.column_stack([R, T]), *rays)[:, 0]
        right = R @ (point[:3] / point[3]) + T
        off_px = (right[1] / right[2] - rays[1][1]) * self.cameras["right"][0][1, 1] * 2.0
        return self.world[0] @ right + self.world[1], float(right[2]), abs(float(off_px))


def seen_small(grey: Any, rig: Rig, camera: str, kelvin: Any) -> Any:
    """What `find` sees, (2, rows, columns): grey by its surroundings, and warmth."""
    rows, columns = grey.shape[0] // SMALLER, grey.shape[1] // SMALLER
    small = cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
    mean, square = (cv2.blur(one, (41, 41)) for one in (small, small * small))
    grey_part = (small - mean) / (np.sqrt(np.maximum(square - mean * mean, 0.0)) + 3.0)
    warmth = (rig.thermal_over(camera, kelvin, rows, columns) - np.median(kelvin)) / 5.0
    return np.stack([np.clip(grey_part, -4.0, 4.0), np.clip(warmth, -1.0, 3.0)]).astype(np.float32)


def crop(grey: Any, column: int, row: int) -> Any:
    """What `place` sees, (1, 64, 64); its first pixel is 32 left of and above this one."""
    half = CROP_PX // 2
    padded = cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REPLICATE)
    part = padded[row : row + CROP_PX, column : column + CROP_PX].astype(np.float32)
    return ((part - part.mean()) / (part.std() + 2.0))[None]


class Networks:
    """Both networks, with what they say of their training."""

    def __init__(self, find: str, place: str) -> None:
        self._find, self._place = (
            onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
            for path in (find, place)
        )
        self.said = self._find.get_modelmeta().custom_metadata_map

    def ends_px(self, grey: Any, rig: Rig, camera: str, kelvin: Any) -> list[Any]:
        """Teat ends in one picture, (column, row) each."""
        heat = self._find.run(None, {"seen": seen_small(grey, rig, camera, kelvin)[None]})[0][0, 0]
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


def matched(rig: Rig, left: list[Any], right: list[Any]) -> list[Any]:
    """Ends in world mm: pairs that fit both pictures and the working depth, the best first."""
    pairs = []
    for i, j in itertools.product(range(len(left)), range(len(right))):
        end, depth_mm, off_px = rig.world_mm(left[i], right[j])
        if off_px < ROW_PX and DEPTHS[0] < depth_mm / rig.depth_mm < DEPTHS[1]:
            pairs.append((off_px / ROW_PX + abs(depth_mm / rig.depth_mm - 1.0) * 4.0, i, j, end))
    taken: set[Any] = set()
    ends = []
    for _, i, j, end in sorted(pairs, key=lambda pair: pair[0]):
        if not {("left", i), ("right", j)} & taken:
            taken |= {("left", i), ("right", j)}
            ends.append(end)
    return ends


def find(asked: dict[str, str], networks: Networks, rig: Rig) -> dict[str, object]:
    """The answer to one question."""
    if "thermal_radiometric" not in asked:
        return {"teats": [], "reason": "it needs the radiometric thermal picture"}
    kelvin = read(asked["thermal_radiometric"]) / 100.0
    left, right = (
        networks.ends_px(read(asked[name]), rig, name, kelvin) for name in ("left", "right")
    )
    ends = matched(rig, left, right)
    return {"teats": [{"world_mm": end.tolist()} for end in ends]}


def read(path: str) -> Any:
    """A picture, from a path that may have any letters on Windows too."""
    return cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)


def main(find_onnx: str, place_onnx: str) -> None:
    networks, rig_of = Networks(find_onnx, place_onnx), lru_cache(1)(Rig)
    # what it was trained on is in the network's file: the bench refuses to score it on that
    trained_on = json.loads(networks.said.get("trained_on", "{}"))
    print(json.dumps({"ready": True, "device": "cpu", "trained_on": trained_on}), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        answer = find(asked, networks, rig_of(asked["calibration"]))
        print(json.dumps({"frame": asked["frame"], **answer}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
