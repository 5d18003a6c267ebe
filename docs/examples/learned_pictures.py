"""What the networks of `learned_detector.py` learn from: optical pictures of simulated scenes."""

from collections.abc import Sequence
from typing import Any

import learned_detector as detector
import numpy as np

import bench

PART, SPREAD_PX = 80, 1.2  # parts of a picture that `find` learns from; the width of a peak


class Pictures:
    """The optical pictures of scenes, as the networks see them, with their visible ends."""

    def __init__(self, families: Sequence[str], count: int, rng: Any, rig: str) -> None:
        self._rng, self.seen = rng, list[tuple[Any, Any, Any, Any]]()
        for family in families:
            for number in range(count):
                shot = bench.draw(family, number, rig=rig)
                frames, right = shot.frames, shot.calibration.world_from_right.inverse()
                ends = np.array([row.xyz_mm for row in shot.truth if row.visible]).reshape(-1, 3)
                ends = right.apply(ends)
                left = shot.calibration.right_from_left.inverse().apply(ends)
                self._add(shot, "left", frames.left, shot.calibration.left.project(left))
                self._add(shot, "right", frames.right, shot.calibration.right.project(ends))

    def _add(self, shot: Any, camera: str, grey: Any, ends_px: Any) -> None:
        kelvin = shot.frames.thermal_k
        small = detector.seen_small(grey, shot.calibration, camera, kelvin)
        y, x = np.mgrid[: small.shape[1], : small.shape[2]]
        heat = np.zeros(small.shape[1:], np.float32)
        for column, row in np.rint((ends_px - detector.SMALLER / 2 + 0.5) / detector.SMALLER):
            peak = np.exp(-0.5 * ((x - column) ** 2 + (y - row) ** 2) / SPREAD_PX**2)
            heat = np.maximum(heat, peak.astype(np.float32))
        self.seen.append((grey, small, heat, ends_px))

    def parts(self, size: int = 12) -> Any:
        """Parts of pictures for `find`, two of three with an end in them."""
        found = []
        for number in self._rng.integers(len(self.seen), size=size):
            _, small, heat, ends = self.seen[number]
            most = np.subtract(heat.shape[::-1], PART).clip(0)
            column, row = self._rng.integers(0, most + 1)
            if len(ends) and self._rng.random() < 0.67:
                at = ends[self._rng.integers(len(ends))] / detector.SMALLER
                at = at + self._rng.uniform(-35, 35, 2) - PART / 2
                column, row = np.clip(at, 0, most).astype(int)
            part = slice(row, row + PART), slice(column, column + PART)
            found.append((small[:, *part] * self._rng.uniform(0.8, 1.2), heat[part]))
        return [np.stack(one).astype(np.float32) for one in zip(*found, strict=True)]

    def crops(self, size: int = 48) -> Any:
        """Parts of pictures for `place`, with where the end is in them."""
        crops: list[Any] = []
        ends: list[Any] = []
        while len(crops) < size:
            grey, _, _, known = self.seen[self._rng.integers(len(self.seen))]
            if len(known):
                end = known[self._rng.integers(len(known))]
                at = np.rint(end + self._rng.uniform(-9, 9, 2)).astype(int)
                at = np.clip(at, 0, np.subtract(grey.shape[::-1], 1))
                crops.append(detector.crop(grey, *at))
                ends.append(end - at + detector.CROP_PX // 2)
        return np.stack(crops), np.array(ends, dtype=np.float32)
