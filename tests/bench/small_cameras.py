"""The shipped cameras with fewer pixels, of which drawing and reading take most of a test's time."""

from __future__ import annotations

import re
from pathlib import Path

from bench.rig.loading import RIGS

SMALLER = 4.0  # along each axis


def smaller(calibration: str, *, thermal: bool = True) -> str:
    """The same cameras with a quarter of the pixels along each axis, the optical ones alone or the
    thermal one too. Homographies are left out: reading derives them.
    """

    def scaled(found: re.Match[str]) -> str:
        values = [float(value) / SMALLER for value in found[2].split(",")]
        return f"{found[1]} = {[int(v) for v in values] if found[1].endswith('size') else values}"

    head = calibration if thermal else calibration[: calibration.index("[cameras.thermal]")]
    keys = r"^(image_size|fc|cc|sensor_size) = \[(.*)\]"
    text = re.sub(keys, scaled, head, flags=re.MULTILINE) + calibration[len(head) :]
    return re.sub(r"^(left|right) = \[\[.*\n", "", text, flags=re.MULTILINE)


def write_calibration(folder: Path, *, whole: bool = False, thermal: bool = False) -> Path:
    """The shipped cameras' calibration; unless ``whole`` as `smaller` makes it."""
    text = (RIGS / "calibration.toml").read_text(encoding="utf-8")
    path = folder / "calibration.toml"
    path.write_text(text if whole else smaller(text, thermal=thermal), encoding="utf-8")
    return path
