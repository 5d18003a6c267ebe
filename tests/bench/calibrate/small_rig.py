"""The emulated rig with optical cameras of half the size, for fast calibrations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bench.rig.loading import RIGS
from detector.calibration import Calibration, dump_calibration, load_calibration
from detector.geometry import Camera


def small_calibration() -> Calibration:
    """The emulated rig's, for these cameras."""
    whole = load_calibration(RIGS / "calibration.toml")
    return replace(whole, left=_half(whole.left), right=_half(whole.right))


def write_rig(folder: Path, *more: str, operator: str = "emulator:") -> Path:
    """The rig's file with its calibration beside it; ``more`` are lines of TOML at its end."""
    # those of the large cameras: derived anew when read
    part = replace(small_calibration().part, homographies=None)
    (folder / "calibration.toml").write_text(dump_calibration(part), encoding="utf-8")
    text = (
        (RIGS / "emulated.toml")
        .read_text(encoding="utf-8")
        .replace('[operator]\nurl = "emulator:"', f'[operator]\nurl = "{operator}"')
    )
    path = folder / "small.toml"
    path.write_text("\n".join([text, *more]), encoding="utf-8")
    return path


def _half(camera: Camera) -> Camera:
    columns, rows = camera.image_size
    fx, fy = camera.fc
    u, v = camera.cc
    return replace(
        camera,
        image_size=(columns // 2, rows // 2),
        fc=(fx / 2, fy / 2),
        cc=((u + 0.5) / 2 - 0.5, (v + 0.5) / 2 - 0.5),
    )
