"""A recording of five frame sets of flat pictures with two teats in each: for what is done with
answers, not for finding anything.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np

from tests.conftest import ROOT

ENDS_MM = [[-160.0, 205.0, 136.0], [-80.0, 270.0, 134.0]]


def write_recording(folder: Path) -> Path:
    """Write it into ``folder``: two frames of the situation calm, three of windy."""
    (folder / "frames").mkdir(parents=True)
    shutil.copy(ROOT / "bench" / "rigs" / "calibration.toml", folder / "calibration.toml")
    lines = ["frame,situation,teat,x_mm,y_mm,z_mm,visible"]
    for number in range(5):
        frame = folder / "frames" / f"{number:04d}"
        frame.mkdir()
        for name, size in (
            ("left", (1024, 1360)),
            ("right", (1024, 1360)),
            ("thermal", (480, 640)),
        ):
            cv2.imwrite(str(frame / f"{name}.png"), np.full(size, 40 * number, np.uint8))
        situation = "calm" if number < 2 else "windy"
        lines += [
            f"{frame.name},{situation},{i},{x},{y},{z},1" for i, (x, y, z) in enumerate(ENDS_MM, 1)
        ]
    (folder / "truth.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
