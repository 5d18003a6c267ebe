"""The calibration file of a recording or a rig: TOML to `Calibration` and back.

One table says which keys a block has and how each is checked. The reader gathers every fault by
dotted key; a value is built only from a file without any.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import numpy as np

from detector.calibration.homographies import DEFAULT_PLANE_DEPTH_MM, derive_homographies
from detector.calibration.uncertainty import ParameterCovariance
from detector.calibration.values import (
    POLARITIES,
    Calibration,
    Homographies,
    Part,
    Polarity,
    Record,
    ThermalCamera,
)
from detector.geometry import Array, Camera, Motion

MEANING = {
    "stereo": "X_right = R(om) X_left + T",
    "thermal": "X_thermal = R(om) X_left + T",
    "world": "X_world = R(om) X_right + T",
}


def dump_calibration(calibration: Calibration | Part, heading: str = "") -> str:
    """The file's text, whole or a part; each line of `heading` becomes a comment. Numbers have 10
    significant digits, a covariance 12, to keep its sign.
    """
    part = calibration if isinstance(calibration, Part) else calibration.part
    lines = [f"# {line}".rstrip() for line in heading.splitlines()] + [""]
    for name, camera in (("left", part.left), ("right", part.right)):
        lines += (
            [f"[cameras.{name}]", *_lens_lines(camera.image_size, camera), ""] if camera else []
        )
    lines += _thermal_lines(part.thermal) if part.thermal else []
    poses = {
        "stereo": part.right_from_left,
        "thermal": part.thermal_from_left,
        "world": part.world_from_right,
    }
    for name, pose in poses.items():
        lines += (
            [f"[{name}]    # {MEANING[name]}", f"om = {_text(pose.om)}", f"T = {_text(pose.T)}", ""]
            if pose
            else []
        )
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
    depth = (
        [] if maps.plane_depth_mm is None else [f"plane_depth_mm = {_text(maps.plane_depth_mm)}"]
    )
    heading = (
        "[homography]    # un-mirrored thermal pixel -> optical pixel, right on one plane only"
    )
    return [heading, f"left = {_text(maps.left)}", f"right = {_text(maps.right)}", *depth]


def _covariance_lines(covariance: ParameterCovariance | None) -> list[str]:
    """The lower triangle, a row a line: px, rad and mm."""
    if covariance is None:
        return []
    names = ", ".join(f'"{owner} {name}"' for owner, name in covariance.names)
    rows = [
        f"  [{', '.join(_text(v, 12) for v in row[: at + 1])}],"
        for at, row in enumerate(covariance.matrix)
    ]
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
        lines += [
            "",
            f"[record.{key}]",
            *(f"{_quoted(name)} = {_quoted(value)}" for name, value in table.items()),
        ]
    return lines


def _quoted(text: str) -> str:
    """A TOML string: JSON's, with the delete character escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _lens_lines(image_size: tuple[int, int], lens: Camera | None) -> list[str]:
    given = (
        []
        if lens is None
        else [f"{name} = {_text(getattr(lens, name))}" for name in ("fc", "cc", "alpha_c", "kc")]
    )
    return [f"image_size = {list(image_size)}", *given]


def _text(value: Any, digits: int = 10) -> str:
    array = np.asarray(value, dtype=np.float64)
    return (
        repr(float(f"{array:.{digits}g}"))
        if array.ndim == 0
        else f"[{', '.join(_text(v, digits) for v in array)}]"
    )


Key = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong: the dotted key as a tuple, empty for the file as a whole, and a sentence."""

    key: Key
    message: str

    def __str__(self) -> str:
        return f"{'.'.join(self.key)}: {self.message}" if self.key else self.message


class CalibrationError(ValueError):
    """An unusable calibration file, with every fault in it."""

    def __init__(self, path: Path, faults: Sequence[Fault]) -> None:
        self.path = path
        self.faults = tuple(faults)
        count = f"{len(faults)} fault{'' if len(faults) == 1 else 's'}"
        super().__init__(
            "\n".join([f"calibration {path}: {count}", *(f"  {fault}" for fault in faults)])
        )


class Wrong(Exception):  # noqa: N818 (a check's verdict, caught by the reader; never seen by a caller)
    """A value that fails its check."""


def numbers(length: int, what: str) -> Callable[[Any], tuple[float, ...]]:
    """A check for an array of exactly `length` finite numbers."""

    def check(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list):
            raise Wrong(f"must be an array of {length} numbers ({what}), not {_kind(value)}")
        if len(value) != length:
            raise Wrong(f"must have {length} numbers ({what}), has {len(value)}")
        return tuple(number(v) for v in value)

    return check


def positive_numbers(length: int, what: str) -> Callable[[Any], tuple[float, ...]]:
    """A check for an array of exactly `length` numbers above zero."""
    plain = numbers(length, what)

    def check(value: Any) -> tuple[float, ...]:
        found = plain(value)
        if min(found) <= 0:
            raise Wrong(f"must be above zero ({what}), got {value}")
        return found

    return check


def number(value: Any) -> float:
    """A check for one finite number; true and false are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Wrong(f"must be a number, not {_kind(value)}")
    try:
        found = float(value)
    except OverflowError:
        raise Wrong("must be a finite number, this integer is too large for one") from None
    if not math.isfinite(found):
        raise Wrong(f"must be a finite number, not {value}")
    return found


def positive(value: Any) -> float:
    """A check for one number above zero."""
    if (found := number(value)) <= 0:
        raise Wrong(f"must be above zero, got {value}")
    return found


def size(value: Any) -> tuple[int, int]:
    """A check for [columns, rows]: two whole numbers from 1 to 65535."""
    if (
        not isinstance(value, list)
        or len(value) != 2
        or any(isinstance(v, bool) or not isinstance(v, int) for v in value)
    ):
        raise Wrong("must be [columns, rows], two whole numbers of pixels")
    if not all(1 <= v <= 65535 for v in value):
        raise Wrong(f"must be [columns, rows] of 1 to 65535 pixels, got {value}")
    return value[0], value[1]


def flag(value: Any) -> bool:
    """A check for true or false."""
    if not isinstance(value, bool):
        raise Wrong(f"must be true or false, not {_kind(value)}")
    return value


def one_of(allowed: Sequence[str]) -> Callable[[Any], str]:
    """A check for one of a few words."""

    def check(value: Any) -> str:
        if value in allowed and isinstance(value, str):
            return value
        near = get_close_matches(str(value), allowed, n=1)
        raise Wrong(
            f"must be one of {', '.join(map(repr, allowed))}, got {value!r}"
            + (f"; did you mean {near[0]!r}?" if near else "")
        )

    return check


def matrix(value: Any) -> tuple[tuple[float, ...], ...]:
    """A check for an invertible (3, 3) homography, as three rows of three numbers."""
    if not isinstance(value, list) or len(value) != 3:
        raise Wrong("must be three rows of three numbers")
    row = numbers(3, "a row of a homography")
    (a, b, c), (d, e, f), (g, h, i) = rows = tuple(row(r) for r in value)
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not (i > 0 and math.isfinite(determinant) and determinant > 0):
        raise Wrong(
            "must be a homography that neither mirrors nor flattens, its last entry above zero: "
            f"determinant {determinant:g}, last entry {i:g}"
        )
    return rows


def word(value: Any) -> str:
    """A check for a text."""
    if not isinstance(value, str):
        raise Wrong(f'must be a text in "quotes", not {_kind(value)}')
    return value


def day(value: Any) -> str:
    """A check for a date, year-month-day, as a text."""
    text = word(value)
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise Wrong(f'must be a day such as "2026-11-20", not {text!r}') from None


def words(value: Any) -> dict[str, str]:
    """A check for a table of texts."""
    if not isinstance(value, dict):
        raise Wrong(f'must be a table of texts, {{ name = "..." }}, not {_kind(value)}')
    return {name: word(text) for name, text in value.items()}


def parameters(value: Any) -> tuple[tuple[str, str], ...]:
    """A check for an array of "owner name"; a thermal pose's owner has two words."""
    if not isinstance(value, list) or not all(isinstance(v, str) and " " in v for v in value):
        raise Wrong('must be an array of names such as "left fx" or "stereo T1"')
    return tuple((v.rpartition(" ")[0], v.rpartition(" ")[2]) for v in value)


def triangle(value: Any) -> tuple[tuple[float, ...], ...]:
    """A check for the lower triangle of a symmetric matrix: rows of 1, 2, 3 ... numbers."""
    if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
        raise Wrong(f"must be an array of rows, not {_kind(value)}")
    if any(len(row) != n for n, row in enumerate(value, 1)):
        raise Wrong("must be a lower triangle: rows of 1, 2, 3 ... numbers")
    return tuple(tuple(number(v) for v in row) for row in value)


def unknown(key: str, allowed: Sequence[str], what: str) -> str:
    """What to say about a key that nothing knows, with the nearest one that exists."""
    near = get_close_matches(key, allowed, n=1)
    return (
        f"unknown {what}; did you mean {near[0]!r}?"
        if near
        else f"unknown {what}; there are: {', '.join(allowed)}"
    )


def _kind(value: Any) -> str:
    names = {
        bool: "true or false",
        int: "a number",
        float: "a number",
        str: "text",
        list: "an array",
        dict: "a table",
    }
    return names.get(type(value), type(value).__name__)


Check = Callable[[Any], Any]

_LENS: dict[str, Check] = {
    "fc": positive_numbers(2, "horizontal and vertical focal length in px"),
    "cc": numbers(2, "column and row of the principal point in px"),
    "alpha_c": number,
    "kc": numbers(5, "k1, k2, p1, p2, k3"),
}
_CAMERA: dict[str, Check] = {"image_size": size, **_LENS}
_POSE: dict[str, Check] = {
    "om": numbers(3, "a rotation vector in rad"),
    "T": numbers(3, "a translation in mm"),
}
_BLOCKS: dict[Key, dict[str, Check]] = {
    ("cameras", "left"): _CAMERA,
    ("cameras", "right"): _CAMERA,
    ("cameras", "thermal"): {
        **_CAMERA,
        "sensor_size": size,
        "mirrored": flag,
        "polarity": one_of(POLARITIES),
    },
    ("stereo",): _POSE,
    ("thermal",): _POSE,
    ("world",): _POSE,
    ("homography",): {"left": matrix, "right": matrix, "plane_depth_mm": positive},
    ("uncertainty",): {"parameters": parameters, "covariance": triangle},
    ("record",): {"made": day, "by": word, "with_what": word, "cameras": words, "inputs": words},
}
_OPTIONAL_BLOCKS = {("thermal",), ("homography",), ("uncertainty",), ("record",)}
_NEVER_REQUIRED = {"alpha_c", "plane_depth_mm"}


def load_calibration(path: Path) -> Calibration:
    """The calibration in a file. Raises CalibrationError with every fault."""
    blocks = _checked(path, whole=True)
    try:
        return _build(blocks)
    # no homography can be derived: the one thing that only shows once the parts are together
    except ValueError as error:
        raise CalibrationError(
            path,
            [
                Fault(
                    ("homography",) if ("homography",) in blocks.found else ("thermal",), str(error)
                )
            ],
        ) from None


def load_part(path: Path) -> Part:
    """A file of one step's result, which need not be whole. Raises CalibrationError."""
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
    """SHA-256 of the file in hex: the calibration's identity in a report. Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@dataclass(slots=True)
class _Blocks:
    """Checked values by block, and the faults so far."""

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

    def _check_names(
        self, at: Key, table: Mapping[str, Any], allowed: list[str], what: str
    ) -> None:
        self.faults += [
            Fault((*at, name), unknown(name, allowed, what))
            for name in table
            if name not in allowed
        ]

    def _check_block(self, key: Key) -> None:
        table: Any = self.document
        for name in key:
            table = table.get(name) if isinstance(table, dict) else None
        if table is None:
            if self.whole and key not in _OPTIONAL_BLOCKS:
                self.faults.append(Fault(key, f"missing block [{'.'.join(key)}]"))
            return
        if not isinstance(table, dict):
            self.faults.append(
                Fault(key, f"must be a block [{'.'.join(key)}] of keys, not a single value")
            )
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
        """Either lens and pose of the thermal camera, or both homographies."""
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
            self.faults.append(
                Fault(
                    ("thermal",),
                    "missing block [thermal] (om, T): cameras.thermal has a lens but no pose",
                )
            )
        if pose and not lens:
            self.faults.append(
                Fault(
                    ("cameras", "thermal", "fc"),
                    "missing (fc, cc, kc): there is a pose in [thermal] but no lens",
                )
            )
        given = [name for name in ("left", "right") if isinstance(maps, dict) and name in maps]
        if len(given) == 1 or (not given and not (lens and pose)):
            why = "missing; both are needed" + (
                "" if lens and pose else " where the thermal camera has no pose"
            )
            self.faults += [
                Fault(("homography", n), why) for n in ("left", "right") if n not in given
            ]

    def _check_baseline(self) -> None:
        if self.found.get(("stereo",), {}).get("T") == (0.0, 0.0, 0.0):
            self.faults.append(
                Fault(("stereo", "T"), "must not be zero: two cameras in one place see no depth")
            )

    def _check_covariance(self) -> None:
        given = self.found.get(("uncertainty",), {})
        if len(given) == 2:
            try:
                given["matrix"] = ParameterCovariance(
                    given["parameters"], _symmetric(given["covariance"])
                )
            except ValueError as error:
                self.faults.append(Fault(("uncertainty", "covariance"), str(error)))


def _symmetric(triangle: tuple[tuple[float, ...], ...]) -> Array:
    """The whole matrix of a lower triangle."""
    lower = np.zeros((len(triangle), len(triangle)))
    for at, row in enumerate(triangle):
        lower[at, : at + 1] = row
    return lower + np.tril(lower, -1).T


def _not_required(key: Key) -> set[str]:
    """Keys that a block may leave out; `_check_thermal` has the last word."""
    return _NEVER_REQUIRED | {
        ("cameras", "thermal"): set(_LENS),
        ("homography",): {"left", "right"},
    }.get(key, set())


def _build(blocks: _Blocks) -> Calibration:
    found = blocks.found
    left, right, thermal = (
        _camera(found["cameras", "left"]),
        _camera(found["cameras", "right"]),
        _thermal(found["cameras", "thermal"]),
    )
    right_from_left, thermal_from_left = (
        _motion(found["stereo",]),
        (_motion(found["thermal",]) if thermal.lens else None),
    )
    maps = found.get(("homography",), {})
    if "left" in maps:
        homographies = _given_maps(maps)
    else:
        # _check_thermal has made sure of lens and pose wherever a homography is missing
        depth_mm = maps.get("plane_depth_mm", DEFAULT_PLANE_DEPTH_MM)
        lens, pose = cast(Camera, thermal.lens), cast(Motion, thermal_from_left)
        homographies = derive_homographies(lens, left, right, pose, right_from_left, depth_mm)
    record = Record(**found["record",]) if ("record",) in found else None
    world_from_right, covariance = (
        _motion(found["world",]),
        found.get(("uncertainty",), {}).get("matrix"),
    )
    return Calibration(
        left,
        right,
        thermal,
        right_from_left,
        thermal_from_left,
        world_from_right,
        homographies,
        covariance,
        record,
    )


def _thermal(seen: Mapping[str, Any]) -> ThermalCamera:
    lens = _camera(seen) if "fc" in seen else None
    return ThermalCamera(
        seen["image_size"],
        seen["sensor_size"],
        seen["mirrored"],
        cast(Polarity, seen["polarity"]),
        lens,
    )


def _given_maps(maps: Mapping[str, Any]) -> Homographies:
    return Homographies(np.array(maps["left"]), np.array(maps["right"]), maps.get("plane_depth_mm"))


def _camera(table: Mapping[str, Any]) -> Camera:
    return Camera(
        table["image_size"], table["fc"], table["cc"], table.get("alpha_c", 0.0), table["kc"]
    )


def _motion(table: Mapping[str, Any]) -> Motion:
    return Motion.from_vectors(table["om"], table["T"])


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise CalibrationError(
            path, [Fault((), f"can't be read: {error.strerror or error}")]
        ) from None
    except UnicodeDecodeError as error:
        raise CalibrationError(
            path,
            [
                Fault(
                    (), f"is not UTF-8 text: byte {error.start} is {error.object[error.start]:#04x}"
                )
            ],
        ) from None
