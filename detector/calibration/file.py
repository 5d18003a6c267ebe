"""The calibration file of a recording or a rig: TOML to `Calibration` and back.

One table says which keys a block has and how each is checked. The reader gathers every fault by
dotted key; a value is built only from a file without any.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import date
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from detector.calibration.gate import lens_faults
from detector.calibration.homographies import DEFAULT_PLANE_DEPTH_MM, derive_homographies
from detector.calibration.values import (
    POLARITIES,
    Calibration,
    Homographies,
    ParameterCovariance,
    Part,
    Record,
    ThermalCamera,
)
from detector.geometry import Camera, Motion
from textfiles.documents import read_toml
from textfiles.text import TextError, plural, text_of

MEANING = {
    "stereo": "X_right = R(om) X_left + T",
    "thermal": "X_thermal = R(om) X_left + T",
    "world": "X_world = R(om) X_right + T",
    "depth": "X_depth = R(om) X_left + T",
    "homography": "un-mirrored thermal pixel -> optical pixel, right on one plane only",
    "uncertainty": "covariance of the fitted parameters, lower triangle",
}
CAMERAS = ("left", "right", "thermal", "depth")
POSES = {"stereo": "right_from_left", "thermal": "thermal_from_left", "depth": "depth_from_left"}
POSES["world"] = "world_from_right"
LENS_KEYS = ("fc", "cc", "alpha_c", "kc")
THERMAL_KEYS = ("image_size", "sensor_size", "mirrored", "polarity")


def dump_calibration(calibration: Calibration | Part, heading: str = "") -> str:
    """The file's text; ``heading`` becomes comments. 10 significant digits, a covariance 12."""
    part = calibration if isinstance(calibration, Part) else calibration.part
    lines = [f"# {line}".rstrip() for line in heading.splitlines()]
    for name, block in _blocks(part).items():
        meaning = f"    # {MEANING[name]}" if name in MEANING else ""
        lines += ["", f"[{name}]{meaning}", *(f"{key} = {_toml(v)}" for key, v in block.items())]
        if name == "uncertainty" and part.covariance:
            rows = enumerate(part.covariance.matrix, 1)
            lines += ["covariance = [", *(f"  {_toml(row[:n], 12)}," for n, row in rows), "]"]
    return "\n".join(lines) + "\n"


def _blocks(part: Part) -> dict[str, Mapping[str, Any]]:
    blocks: dict[str, Mapping[str, Any]] = {}
    for name in CAMERAS:
        camera: Camera | ThermalCamera | None = getattr(part, name)
        lens = camera.lens if isinstance(camera, ThermalCamera) else camera
        if camera:
            block = {"image_size": camera.image_size}
            block |= {key: getattr(lens, key) for key in LENS_KEYS if lens}
            form = THERMAL_KEYS[1:] if isinstance(camera, ThermalCamera) else ()
            blocks[f"cameras.{name}"] = block | {key: getattr(camera, key) for key in form}
    for name, attribute in POSES.items():
        if pose := getattr(part, attribute):
            blocks[name] = {"om": pose.om, "T": pose.T}
    if part.hanging:
        blocks["world"] = {**blocks["world"], "teats": "hanging"}
    if maps := part.homographies:
        depth = {} if maps.plane_depth_mm is None else {"plane_depth_mm": maps.plane_depth_mm}
        blocks["homography"] = {"left": maps.left, "right": maps.right, **depth}
    if part.covariance:
        blocks["uncertainty"] = {"parameters": [" ".join(n) for n in part.covariance.names]}
    if part.record:
        record = asdict(part.record)
        tables = {f"record.{name}": record.pop(name) for name in ("cameras", "inputs")}
        blocks["record"] = record
        for name, table in tables.items():
            blocks[name] = {_toml(key): value for key, value in table.items()}
    return blocks


def _toml(value: Any, digits: int = 10) -> str:
    if isinstance(value, str):  # a TOML string: JSON's, with the delete character escaped
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool | int):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(f"{value:.{digits}g}"))
    return f"[{', '.join(_toml(each, digits) for each in value)}]"


Key = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class KeyFault:
    """One thing wrong: the dotted key as a tuple, empty for the file as a whole, and a sentence."""

    key: Key
    message: str

    def __str__(self) -> str:
        return f"{'.'.join(self.key)}: {self.message}" if self.key else self.message


class CalibrationError(ValueError):
    """An unusable calibration file, with every fault in it."""

    def __init__(self, path: Path, faults: Sequence[KeyFault]) -> None:
        self.path = path
        self.faults = tuple(faults)
        head = f"calibration {path}: {plural(len(faults), 'fault')}"
        super().__init__("\n  ".join([head, *map(str, faults)]))


class _InvalidValueError(Exception):
    """A value that fails its check."""


Check = Callable[[Any], Any]
_KINDS: dict[type, str] = {bool: "true or false", int: "a number", float: "a number"}
_KINDS |= {str: "text", list: "an array", dict: "a table"}


def _kind(value: Any) -> str:
    return _KINDS.get(type(value), type(value).__name__)


def _refuse(wrong: object, message: str) -> None:
    if wrong:
        raise _InvalidValueError(message)


def _of_kind(kind: type, wanted: str) -> Check:
    def check(value: Any) -> Any:
        _refuse(not isinstance(value, kind), f"must be {wanted}, not {_kind(value)}")
        return value

    return check


_word = _of_kind(str, 'a text in "quotes"')


def _number(value: Any) -> float:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    _refuse(not plain, f"must be a number, not {_kind(value)}")
    try:
        found = float(value)
    except OverflowError:
        raise _InvalidValueError(
            "must be a finite number, this integer is too large for one"
        ) from None
    _refuse(not math.isfinite(found), f"must be a finite number, not {value}")
    return found


def _positive(value: Any) -> float:
    found = _number(value)
    _refuse(found <= 0, f"must be above zero, got {value}")
    return found


def _numbers(length: int, what: str, *, positive: bool = False) -> Check:
    def check(value: Any) -> tuple[float, ...]:
        expected = f"{length} numbers ({what})"
        _refuse(type(value) is not list, f"must be an array of {expected}, not {_kind(value)}")
        _refuse(len(value) != length, f"must have {expected}, has {len(value)}")
        found = tuple(_number(v) for v in value)
        _refuse(positive and min(found) <= 0, f"must be above zero ({what}), got {value}")
        return found

    return check


def _size(value: Any) -> tuple[int, int]:
    whole = isinstance(value, list) and [type(v) for v in value] == [int, int]
    _refuse(not whole, "must be [columns, rows], two whole numbers of pixels")
    fits = all(1 <= v <= 65535 for v in value)
    _refuse(not fits, f"must be [columns, rows] of 1 to 65535 pixels, got {value}")
    return value[0], value[1]


def _polarity(value: Any) -> Any:
    near = get_close_matches(str(value), POLARITIES, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    known = ", ".join(map(repr, POLARITIES))
    _refuse(value not in POLARITIES, f"must be one of {known}, got {value!r}{hint}")
    return value


def _matrix(value: Any) -> tuple[tuple[float, ...], ...]:
    three = isinstance(value, list) and len(value) == 3
    _refuse(not three, "must be three rows of three numbers")
    rows: tuple[tuple[float, ...], ...] = tuple(map(_numbers(3, "a row of a homography"), value))
    (a, b, c), (d, e, f), (g, h, i) = rows
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    wanted = "a homography that neither mirrors nor flattens, its last entry above zero"
    seen = f"determinant {determinant:g}, last entry {i:g}"
    _refuse(not (i > 0 and 0 < determinant < math.inf), f"must be {wanted}: {seen}")
    return rows


def _day(value: Any) -> str:
    text: str = _word(value)
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise _InvalidValueError(f'must be a day such as "2026-11-20", not {text!r}') from None


def _texts(value: Any) -> dict[str, str]:
    tables = _of_kind(dict, 'a table of texts, { name = "..." }')
    return {name: _word(text) for name, text in tables(value).items()}


def _parameters(value: Any) -> tuple[tuple[str, str], ...]:
    """ "owner name" each; a thermal pose's owner has two words."""
    named = isinstance(value, list) and all(isinstance(v, str) and " " in v for v in value)
    _refuse(not named, 'must be an array of names such as "left fx" or "stereo T1"')
    return tuple((v.rpartition(" ")[0], v.rpartition(" ")[2]) for v in value)


def _triangle(value: Any) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    rows = isinstance(value, list) and all(isinstance(row, list) for row in value)
    _refuse(not rows, f"must be an array of rows, not {_kind(value)}")
    uneven = any(len(row) != n for n, row in enumerate(value, 1))
    _refuse(uneven, "must be a lower triangle: rows of 1, 2, 3 ... numbers")
    lower = np.zeros((len(value), len(value)))
    for n, row in enumerate(value, 1):
        lower[n - 1, :n] = [_number(v) for v in row]
    return lower + np.tril(lower, -1).T


_CAMERA: dict[str, Check] = {
    "image_size": _size,
    "fc": _numbers(2, "horizontal and vertical focal length in px", positive=True),
    "cc": _numbers(2, "column and row of the principal point in px"),
    "alpha_c": _number,
    "kc": _numbers(5, "k1, k2, p1, p2, k3"),
}
_POSE: dict[str, Check] = {
    "om": _numbers(3, "a rotation vector in rad"),
    "T": _numbers(3, "a translation in mm"),
}
WAYS = ("standing", "hanging")


def _way(value: Any) -> bool:
    known = " or ".join(map(repr, WAYS))
    _refuse(value not in WAYS, f"must be {known}, got {value!r}")
    return bool(value == "hanging")


_BLOCKS: dict[Key, dict[str, Check]] = {
    ("cameras", "left"): _CAMERA,
    ("cameras", "right"): _CAMERA,
    ("cameras", "thermal"): {
        **_CAMERA,
        "sensor_size": _size,
        "mirrored": _of_kind(bool, "true or false"),
        "polarity": _polarity,
    },
    ("cameras", "depth"): _CAMERA,
    **{(name,): _POSE for name in POSES},
    ("world",): {**_POSE, "teats": _way},
    ("homography",): {"left": _matrix, "right": _matrix, "plane_depth_mm": _positive},
    ("uncertainty",): {"parameters": _parameters, "covariance": _triangle},
    ("record",): {"made": _day, "by": _word, "with_what": _word}
    | {"cameras": _texts, "inputs": _texts},
}
DEPTH: tuple[Key, ...] = ("cameras", "depth"), ("depth",)
_OPTIONAL_BLOCKS: set[Key] = {*DEPTH, ("thermal",), ("homography",), ("uncertainty",), ("record",)}
_NEVER_REQUIRED = {"alpha_c", "plane_depth_mm", "teats"}
# keys that a block may leave out; `_thermal_faults` decides
_NOT_REQUIRED = {("cameras", "thermal"): set(LENS_KEYS), ("homography",): {"left", "right"}}


def load_calibration(path: Path, *, doubtful: bool = False) -> Calibration:
    """The calibration in a file. Raises CalibrationError with every fault; ``doubtful`` leaves what
    is wrong with the pair (`gate.pair_faults`) to the caller.
    """
    return _whole(path, _read(path), doubtful=doubtful)


def check_text(path: Path, text: str, *, whole: bool) -> None:
    """Raise CalibrationError for a text that can't be read again from ``path``, as `load_part` or
    `load_calibration`.
    """
    try:
        document = read_toml(text)
    except TextError as error:
        raise CalibrationError(path, [KeyFault((), str(error))]) from None
    if whole:
        _whole(path, document)
    else:
        _checked(path, document, whole=False)


def _whole(path: Path, document: Mapping[str, Any], *, doubtful: bool = False) -> Calibration:
    found = _checked(path, document, whole=True)
    part = _part(found)
    if not doubtful and part.pair_faults:
        raise CalibrationError(path, [KeyFault(("stereo", "T"), f) for f in part.pair_faults])
    values: dict[str, Any] = {field.name: getattr(part, field.name) for field in fields(Part)}
    if part.homographies is None:
        cameras = values["thermal"].lens, values["left"], values["right"]
        poses = values["thermal_from_left"], values["right_from_left"]
        depth = found.get(("homography",), {}).get("plane_depth_mm", DEFAULT_PLANE_DEPTH_MM)
        try:
            values["homographies"] = derive_homographies(*cameras, *poses, depth)
        # the one thing that only shows once the parts are together
        except ValueError as error:
            at = ("homography",) if ("homography",) in found else ("thermal",)
            raise CalibrationError(path, [KeyFault(at, str(error))]) from None
    return Calibration(**values)


def load_part(path: Path) -> Part:
    """A file of one step's result, which need not be whole. Raises CalibrationError."""
    return _part(_checked(path, _read(path), whole=False))


def file_hash(path: Path) -> str:
    """SHA-256 of the file in hex: the calibration's identity in a report. Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _part(found: Mapping[Key, Mapping[str, Any]]) -> Part:

    def lens(name: str) -> Camera | None:
        block = found.get(("cameras", name), {})
        values = {key: block[key] for key in ("image_size", *LENS_KEYS) if key in block}
        return Camera(**values) if "fc" in block else None

    def motion(name: str) -> Motion | None:
        pose = found.get((name,))
        return Motion.from_vectors(pose["om"], pose["T"]) if pose else None

    seen, maps = found.get(("cameras", "thermal")), found.get(("homography",), {})
    form = {key: seen[key] for key in THERMAL_KEYS} if seen else {}
    return Part(
        left=lens("left"),
        right=lens("right"),
        thermal=ThermalCamera(**form, lens=lens("thermal")) if form else None,
        depth=lens("depth"),
        homographies=Homographies(**{"plane_depth_mm": None, **maps}) if "left" in maps else None,
        **{attribute: motion(name) for name, attribute in POSES.items()},
        covariance=found.get(("uncertainty",), {}).get("matrix"),
        record=Record(**found["record",]) if ("record",) in found else None,
        hanging=found.get(("world",), {}).get("teats", False),
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(text_of(path))
    except TextError as error:
        reason = str(error)
    except OSError as error:
        reason = f"can't be read: {error.strerror or error}"
    raise CalibrationError(path, [KeyFault((), reason)])


def _checked(path: Path, document: Mapping[str, Any], *, whole: bool) -> dict[Key, dict[str, Any]]:
    """The file's blocks, every one checked; a part may leave out any. Raises CalibrationError."""
    faults = _unknown((), document, sorted({key[0] for key in _BLOCKS}), "block")
    cameras = document.get("cameras")
    if isinstance(cameras, dict):
        faults += _unknown(("cameras",), cameras, [*CAMERAS], "camera")
    found: dict[Key, dict[str, Any]] = {}
    for key in _BLOCKS:
        table: Any = document
        for name in key:
            table = table.get(name) if isinstance(table, dict) else None
        dotted = ".".join(key)
        if isinstance(table, dict):
            found[key], wrong = _checked_block(key, table)
            faults += wrong
        elif table is not None:
            faults.append(KeyFault(key, f"must be a block [{dotted}] of keys, not a single value"))
        elif whole and key not in _OPTIONAL_BLOCKS:
            faults.append(KeyFault(key, f"missing block [{dotted}]"))
    faults += _faults_between(found)
    if whole and isinstance(cameras, dict) and isinstance(cameras.get("thermal"), dict):
        faults += _thermal_faults(cameras["thermal"], document)
    if faults:
        raise CalibrationError(path, faults)
    return found


def _unknown(at: Key, table: Mapping[str, Any], allowed: list[str], what: str) -> list[KeyFault]:
    faults = []
    for name in (name for name in table if name not in allowed):
        near = get_close_matches(name, allowed, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(allowed)}"
        faults.append(KeyFault((*at, name), f"unknown {what}; {hint}"))
    return faults


def _checked_block(key: Key, table: Mapping[str, Any]) -> tuple[dict[str, Any], list[KeyFault]]:
    checks, values = _BLOCKS[key], {}
    faults = _unknown(key, table, list(checks), "key")
    for name, value in table.items():
        if name in checks:
            try:
                values[name] = checks[name](value)
            except _InvalidValueError as wrong:
                faults.append(KeyFault((*key, name), str(wrong)))
    optional = _NEVER_REQUIRED | _NOT_REQUIRED.get(key, set())
    faults += [
        KeyFault((*key, n), "missing") for n in checks if n not in table and n not in optional
    ]
    return values, faults


def _thermal_faults(camera: Mapping[str, Any], document: Mapping[str, Any]) -> list[KeyFault]:
    """Either lens and pose of the thermal camera, or both homographies."""
    faults = []
    lens, pose = any(name in camera for name in LENS_KEYS), "thermal" in document
    if lens:
        faults += [
            KeyFault(("cameras", "thermal", n), "missing, while other keys of the lens are given")
            for n in LENS_KEYS
            if n not in camera and n not in _NEVER_REQUIRED
        ]
    if lens and not pose:
        why = "missing block [thermal] (om, T): cameras.thermal has a lens but no pose"
        faults.append(KeyFault(("thermal",), why))
    if pose and not lens:
        why = "missing (fc, cc, kc): there is a pose in [thermal] but no lens"
        faults.append(KeyFault(("cameras", "thermal", "fc"), why))
    maps = document.get("homography")
    absent = [n for n in ("left", "right") if not isinstance(maps, dict) or n not in maps]
    if len(absent) == 1 or (absent and not (lens and pose)):
        where = "" if lens and pose else " where the thermal camera has no pose"
        why = f"missing; both are needed{where}"
        faults += [KeyFault(("homography", n), why) for n in absent]
    return faults


def _faults_between(found: dict[Key, dict[str, Any]]) -> list[KeyFault]:
    """What only shows in several values; adds the matrix of the uncertainty."""
    why = "a depth camera has a lens and a pose"
    absent = [key for key in DEPTH if key not in found]
    faults = [
        KeyFault(key, f"missing block [{'.'.join(key)}]: {why}")
        for key in absent
        if len(absent) == 1
    ]
    if found.get(("stereo",), {}).get("T") == (0.0, 0.0, 0.0):
        why = "must not be zero: two cameras in one place see no depth"
        faults.append(KeyFault(("stereo", "T"), why))
    for key in (key for key in found if key[0] == "cameras"):
        block = {name: found[key].get(name) for name in ("image_size", *LENS_KEYS)}
        if None not in (block["image_size"], block["fc"], block["cc"], block["kc"]):
            lens = Camera(**{**block, "alpha_c": block["alpha_c"] or 0.0})  # type: ignore[arg-type]
            faults += [KeyFault((*key, name), message) for name, message in lens_faults(lens)]
    given = found.get(("uncertainty",), {})
    if len(given) == 2:
        try:
            given["matrix"] = ParameterCovariance(given["parameters"], given["covariance"])
        except ValueError as error:
            faults.append(KeyFault(("uncertainty", "covariance"), str(error)))
    return faults
