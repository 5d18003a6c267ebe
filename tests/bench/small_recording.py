"""A recording of five frame sets of small flat pictures with two teats in each: for what is done with
answers, not for finding anything.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bench.rig.loading import RIGS
from tests.bench.small_cameras import smaller

SIZES = {"left": (256, 340), "right": (256, 340), "thermal": (120, 160)}
ENDS_MM = [[-160.0, 205.0, 136.0], [-80.0, 270.0, 134.0]]


def write_recording(folder: Path, *, whole: bool = False) -> Path:
    """Write it into ``folder``: two frames of the situation calm, three of windy; ``whole``: with
    all pixels of the shipped cameras.
    """
    (folder / "frames").mkdir(parents=True)
    calibration = (RIGS / "calibration.toml").read_text(encoding="utf-8")
    calibration, many = (calibration, 4) if whole else (smaller(calibration), 1)
    (folder / "calibration.toml").write_text(calibration, encoding="utf-8")
    lines = ["frame,situation,teat,x_mm,y_mm,z_mm,visible"]
    for number in range(5):
        frame = folder / "frames" / f"{number:04d}"
        frame.mkdir()
        for name, (height, width) in SIZES.items():
            picture = np.full((many * height, many * width), 40 * number, np.uint8)
            cv2.imwrite(str(frame / f"{name}.png"), picture)
        situation = "calm" if number < 2 else "windy"
        lines += [
            f"{frame.name},{situation},{i},{x},{y},{z},1" for i, (x, y, z) in enumerate(ENDS_MM, 1)
        ]
    (folder / "truth.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
