"""The calibration file of a recording or a rig: TOML in, `Calibration` out.

Strategy: one table says which keys a block has and how each is checked; the reader walks it, gathers every fault there is, and builds the
value only from a file without any. What the file may leave out (a skew, a homography, a thermal lens) is decided in one place each.
The module may not know who reads a fault to whom: it gives dotted keys, not lines.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from detector.calibration import faults as check
from detector.calibration.faults import CalibrationError, Fault, Key, Wrong
from detector.calibration.plane import DEFAULT_PLANE_DEPTH_MM, derive_homographies
from detector.calibration.uncertainty import ParameterCovariance
from detector.calibration.values import POLARITIES, Calibration, Homographies, Part, Polarity, Record, ThermalCamera
from detector.geometry import Array, Camera, Motion

Check = Callable[[Any], Any]

_LENS: dict[str, Check] = {
    "fc": check.positive_numbers(2, "horizontal and vertical focal length in px"),
    "cc": check.numbers(2, "column and row of the principal point in px"),
    "alpha_c": check.number,
    "kc": check.numbers(5, "k1, k2, p1, p2, k3"),
}
_CAMERA: dict[str, Check] = {"image_size": check.size, **_LENS}
_POSE: dict[str, Check] = {"om": check.numbers(3, "a rotation vector in rad"), "T": check.numbers(3, "a translation in mm")}
_BLOCKS: dict[Key, dict[str, Check]] = {
    ("cameras", "left"): _CAMERA,
    ("cameras", "right"): _CAMERA,
    ("cameras", "thermal"): {**_CAMERA, "sensor_size": check.size, "mirrored": check.flag, "polarity": check.one_of(POLARITIES)},
    ("stereo",): _POSE,
    ("thermal",): _POSE,
    ("world",): _POSE,
    ("homography",): {"left": check.matrix, "right": check.matrix, "plane_depth_mm": check.positive},
    ("uncertainty",): {"parameters": check.parameters, "covariance": check.triangle},
    ("record",): {"made": check.day, "by": check.word, "with_what": check.word, "cameras": check.words, "inputs": check.words},
}
_OPTIONAL_BLOCKS = {("thermal",), ("homography",), ("uncertainty",), ("record",)}
_NEVER_REQUIRED = {"alpha_c", "plane_depth_mm"}


def load_calibration(path: Path) -> Calibration:
    """The calibration in a file of the recording format. Raises CalibrationError with every fault, and for a file that can't be read."""
    blocks = _checked(path, whole=True)
    try:
        return _build(blocks)
    except ValueError as error:  # no homography can be derived: the one thing that only shows once the parts are together
        raise CalibrationError(path, [Fault(("homography",) if ("homography",) in blocks.found else ("thermal",), str(error))]) from None


def load_part(path: Path) -> Part:
    """What a file of the same format holds that need not be whole: one step's result. Raises CalibrationError as `load_calibration`."""
    found = _checked(path, whole=False).found
    seen, maps = found.get(("cameras", "thermal")), found.get(("homography",), {})
    return Part(
        left=_camera(found["cameras", "left"]) if ("cameras", "left") in found else None,
        right=_camera(found["cameras", "right"]) if ("cameras", "right") in found else None,
        right_from_left=_motion(found["stereo",]) if ("stereo",) in found else None,
        thermal=_thermal(seen) if seen else None,
        thermal_from_left=_motion(found["thermal",]) if ("thermal",) in found else None,
        homographies=_given_maps(maps) if "left" in maps else None,
        world_from_right=_motion(found["world",]) if ("world",) in found else None,
        covariance=found.get(("uncertainty",), {}).get("matrix"),
        record=Record(**found["record",]) if ("record",) in found else None,
    )


def _checked(path: Path, *, whole: bool) -> _Blocks:
    """The file's blocks, every one checked. Raises CalibrationError with all faults."""
    text = _read(path)
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(path, [Fault((), f"not TOML: {error}")]) from None
    blocks = _Blocks(document, whole)
    blocks.check_all()
    if blocks.faults:
        raise CalibrationError(path, blocks.faults)
    return blocks


def file_hash(path: Path) -> str:
    """SHA-256 of the file's bytes, hexadecimal: the calibration's identity in a report. Raises OSError where it can't be read."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@dataclass(slots=True)
class _Blocks:
    """The file's blocks while they are checked: values that passed, by block, and the faults so far."""

    document: Mapping[str, Any]
    whole: bool  # or a part, which may leave out any block
    found: dict[Key, dict[str, Any]] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)

    def check_all(self) -> None:
        self._check_names((), self.document, sorted({key[0] for key in _BLOCKS}), "block")
        cameras = self.document.get("cameras")
        if isinstance(cameras, dict):
            self._check_names(("cameras",), cameras, ["left", "right", "thermal"], "camera")
        for key in _BLOCKS:
            self._check_block(key)
        if self.whole:
            self._check_thermal()
        self._check_baseline()
        self._check_covariance()

    def _check_names(self, at: Key, table: Mapping[str, Any], allowed: list[str], what: str) -> None:
        self.faults += [Fault((*at, name), check.unknown(name, allowed, what)) for name in table if name not in allowed]

    def _check_block(self, key: Key) -> None:
        table: Any = self.document
        for name in key:
            table = table.get(name) if isinstance(table, dict) else None
        if table is None:
            if self.whole and key not in _OPTIONAL_BLOCKS:
                self.faults.append(Fault(key, f"missing block [{'.'.join(key)}]"))
            return
        if not isinstance(table, dict):
            self.faults.append(Fault(key, f"must be a block [{'.'.join(key)}] of keys, not a single value"))
            return
        checks = _BLOCKS[key]
        self._check_names(key, table, list(checks), "key")
        self.found[key] = {}
        for name, value in table.items():
            if name in checks:
                self._check_value((*key, name), value, checks[name])
        missing = [name for name in checks if name not in table and name not in _not_required(key)]
        self.faults += [Fault((*key, name), "missing") for name in missing]

    def _check_value(self, key: Key, value: Any, checked: Check) -> None:
        try:
            self.found[key[:-1]][key[-1]] = checked(value)
        except Wrong as wrong:
            self.faults.append(Fault(key, str(wrong)))

    def _check_thermal(self) -> None:
        """A thermal camera is calibrated (lens and pose), or not (neither); without it both homographies must be given."""
        camera, maps = self.document.get("cameras"), self.document.get("homography")
        camera = camera.get("thermal") if isinstance(camera, dict) else None
        if not isinstance(camera, dict):
            return
        lens, pose = any(name in camera for name in _LENS), "thermal" in self.document
        if lens:
            self.faults += [
                Fault(("cameras", "thermal", n), "missing, while other keys of the lens are given")
                for n in _LENS
                if n not in camera and n not in _NEVER_REQUIRED
            ]
        if lens and not pose:
            self.faults.append(Fault(("thermal",), "missing block [thermal] (om, T): cameras.thermal has a lens but no pose"))
        if pose and not lens:
            self.faults.append(Fault(("cameras", "thermal", "fc"), "missing (fc, cc, kc): there is a pose in [thermal] but no lens"))
        given = [name for name in ("left", "right") if isinstance(maps, dict) and name in maps]
        if len(given) == 1 or (not given and not (lens and pose)):
            why = "missing; both are needed" + ("" if lens and pose else " where the thermal camera has no pose")
            self.faults += [Fault(("homography", n), why) for n in ("left", "right") if n not in given]

    def _check_baseline(self) -> None:
        if self.found.get(("stereo",), {}).get("T") == (0.0, 0.0, 0.0):
            self.faults.append(Fault(("stereo", "T"), "must not be zero: two cameras in one place see no depth"))

    def _check_covariance(self) -> None:
        given = self.found.get(("uncertainty",), {})
        if len(given) == 2:
            try:
                given["matrix"] = ParameterCovariance(given["parameters"], _symmetric(given["covariance"]))
            except ValueError as error:
                self.faults.append(Fault(("uncertainty", "covariance"), str(error)))


def _symmetric(triangle: tuple[tuple[float, ...], ...]) -> Array:
    """The whole matrix of a lower triangle."""
    lower = np.zeros((len(triangle), len(triangle)))
    for at, row in enumerate(triangle):
        lower[at, : at + 1] = row
    return lower + np.tril(lower, -1).T


def _not_required(key: Key) -> set[str]:
    """Keys that a block may leave out here; `_check_thermal` says when the thermal ones are needed after all."""
    return _NEVER_REQUIRED | {("cameras", "thermal"): set(_LENS), ("homography",): {"left", "right"}}.get(key, set())


def _build(blocks: _Blocks) -> Calibration:
    found = blocks.found
    left, right, thermal = _camera(found["cameras", "left"]), _camera(found["cameras", "right"]), _thermal(found["cameras", "thermal"])
    right_from_left, thermal_from_left = _motion(found["stereo",]), _motion(found["thermal",]) if thermal.lens else None
    maps = found.get(("homography",), {})
    if "left" in maps:
        homographies = _given_maps(maps)
    else:
        # _check_thermal has made sure of lens and pose wherever a homography is missing
        depth_mm = maps.get("plane_depth_mm", DEFAULT_PLANE_DEPTH_MM)
        lens, pose = cast(Camera, thermal.lens), cast(Motion, thermal_from_left)
        homographies = derive_homographies(lens, left, right, pose, right_from_left, depth_mm)
    record = Record(**found["record",]) if ("record",) in found else None
    world_from_right, covariance = _motion(found["world",]), found.get(("uncertainty",), {}).get("matrix")
    return Calibration(left, right, thermal, right_from_left, thermal_from_left, world_from_right, homographies, covariance, record)


def _thermal(seen: Mapping[str, Any]) -> ThermalCamera:
    lens = _camera(seen) if "fc" in seen else None
    return ThermalCamera(seen["image_size"], seen["sensor_size"], seen["mirrored"], cast(Polarity, seen["polarity"]), lens)


def _given_maps(maps: Mapping[str, Any]) -> Homographies:
    return Homographies(np.array(maps["left"]), np.array(maps["right"]), maps.get("plane_depth_mm"))


def _camera(table: Mapping[str, Any]) -> Camera:
    return Camera(table["image_size"], table["fc"], table["cc"], table.get("alpha_c", 0.0), table["kc"])


def _motion(table: Mapping[str, Any]) -> Motion:
    return Motion.from_vectors(table["om"], table["T"])


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise CalibrationError(path, [Fault((), f"can't be read: {error.strerror or error}")]) from None
    except UnicodeDecodeError as error:
        raise CalibrationError(path, [Fault((), f"is not UTF-8 text: byte {error.start} is {error.object[error.start]:#04x}")]) from None
