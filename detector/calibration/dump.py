"""The text of a calibration file: what `file.load_calibration` reads back. The module may not know where it will be kept."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from detector.calibration.uncertainty import ParameterCovariance
from detector.calibration.values import Calibration, Homographies, Part, Record, ThermalCamera
from detector.geometry import Camera

MEANING = {"stereo": "X_right = R(om) X_left + T", "thermal": "X_thermal = R(om) X_left + T", "world": "X_world = R(om) X_right + T"}


def dump_calibration(calibration: Calibration | Part, heading: str = "") -> str:
    """The file's text; `load_calibration` reads a whole one back, `load_part` a part. Each line of `heading` becomes a comment at the top.

    Numbers are rounded to 10 significant digits, far beyond what any calibration holds; a covariance to 12, or it might lose its sign.
    """
    part = calibration if isinstance(calibration, Part) else calibration.part
    lines = [f"# {line}".rstrip() for line in heading.splitlines()] + [""]
    for name, camera in (("left", part.left), ("right", part.right)):
        lines += [f"[cameras.{name}]", *_lens_lines(camera.image_size, camera), ""] if camera else []
    lines += _thermal_lines(part.thermal) if part.thermal else []
    poses = {"stereo": part.right_from_left, "thermal": part.thermal_from_left, "world": part.world_from_right}
    for name, pose in poses.items():
        lines += [f"[{name}]    # {MEANING[name]}", f"om = {_text(pose.om)}", f"T = {_text(pose.T)}", ""] if pose else []
    lines += _homography_lines(part.homographies) if part.homographies else []
    lines += _covariance_lines(part.covariance) + _record_lines(part.record)
    return "\n".join(lines).rstrip("\n") + "\n"


def _thermal_lines(thermal: ThermalCamera) -> list[str]:
    return [
        "[cameras.thermal]",
        *_lens_lines(thermal.image_size, thermal.lens),
        f"sensor_size = {list(thermal.sensor_size)}",
        f"mirrored = {str(thermal.mirrored).lower()}",
        f'polarity = "{thermal.polarity}"',
        "",
    ]


def _homography_lines(maps: Homographies) -> list[str]:
    depth = [] if maps.plane_depth_mm is None else [f"plane_depth_mm = {_text(maps.plane_depth_mm)}"]
    heading = "[homography]    # un-mirrored thermal pixel -> optical pixel, right on one plane only"
    return [heading, f"left = {_text(maps.left)}", f"right = {_text(maps.right)}", *depth]


def _covariance_lines(covariance: ParameterCovariance | None) -> list[str]:
    """The lower triangle, a row a line: px, rad and mm."""
    if covariance is None:
        return []
    names = ", ".join(f'"{owner} {name}"' for owner, name in covariance.names)
    rows = [f"  [{', '.join(_text(v, 12) for v in row[: at + 1])}]," for at, row in enumerate(covariance.matrix)]
    return [
        "",
        "[uncertainty]    # covariance of the fitted parameters, lower triangle",
        f"parameters = [{names}]",
        "covariance = [",
        *rows,
        "]",
    ]


def _record_lines(record: Record | None) -> list[str]:
    if record is None:
        return []
    tables = {"cameras": record.cameras, "inputs": record.inputs}
    texts = {"made": record.made, "by": record.by, "with_what": record.with_what}
    lines = ["", "[record]", *(f"{key} = {_quoted(value)}" for key, value in texts.items())]
    for key, table in tables.items():
        lines += ["", f"[record.{key}]", *(f"{_quoted(name)} = {_quoted(value)}" for name, value in table.items())]
    return lines


def _quoted(text: str) -> str:
    """A basic string of TOML: JSON's escapes are among TOML's, all but the delete character's, which JSON leaves as it is."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _lens_lines(image_size: tuple[int, int], lens: Camera | None) -> list[str]:
    given = [] if lens is None else [f"{name} = {_text(getattr(lens, name))}" for name in ("fc", "cc", "alpha_c", "kc")]
    return [f"image_size = {list(image_size)}", *given]


def _text(value: Any, digits: int = 10) -> str:
    array = np.asarray(value, dtype=np.float64)
    return repr(float(f"{array:.{digits}g}")) if array.ndim == 0 else f"[{', '.join(_text(v, digits) for v in array)}]"
