"""JSON lines between the bench and an external detector.

After a `Garbled` line nothing can be trusted; `BadAnswer` is only that answer. Figures are checked
where all detectors' answers are.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from detector.calibration import Calibration
from detector.geometry import Array, triangulate
from detector.protocol import Detection, Teat

READY = {"ready": True}
PICTURES = ("left", "right", "thermal", "thermal_radiometric")
_SHOWN = 80


class Garbled(ValueError):  # noqa: N818 - the line is garbled
    """Not a line of this protocol."""


class BadAnswer(ValueError):  # noqa: N818 - the answer is bad
    """An answer whose values can't be right."""


def request_line(frame: str, pictures: Mapping[str, Path], calibration: Path) -> bytes:
    """The request: the frame's name, paths of its pictures, and the calibration."""
    paths = {name: str(pictures[name]) for name in PICTURES if name in pictures}
    return _line({"frame": frame, **paths, "calibration": str(calibration)})


def answer_line(frame: str, detection: Detection) -> bytes:
    """An answer, as a detector in Python gives it."""
    teats = [
        {"world_mm": _plain(t.world_mm), "covariance_mm2": _plain(t.covariance_mm2)}
        for t in detection.teats
    ]
    return _line(
        {"frame": frame, "teats": teats, "hidden": detection.hidden, "reason": detection.reason}
    )


def check_ready(line: bytes) -> None:
    """Raises Garbled where the child's first line isn't the one that says it is ready."""
    wanted = f"its first line must be {json.dumps(READY)}"
    try:
        said = _object(line)
    except Garbled as fault:
        raise Garbled(f"{wanted}, but {fault}") from None
    if said.get("ready") is not True:
        raise Garbled(f'{wanted}, is "{shown(line)}"')


def parse_answer(line: bytes, frame: str, calibration: Calibration) -> Detection:
    """The answer on ``frame``: teats "world_mm" [x, y, z], or "left_px" and "right_px" [column,
    row].

    Pixels are triangulated, unknown keys ignored. Raises Garbled for no answer on this frame,
    BadAnswer for bad values.
    """
    answer = _object(line)
    if answer.get("frame") != frame:
        hint = "; a frame's name is text" if str(answer.get("frame")) == frame else ""
        raise Garbled(f'it was asked about frame "{frame}" and answered "{shown(line)}"{hint}')
    teats, hidden, reason = answer.get("teats"), answer.get("hidden", 0), answer.get("reason")
    if not isinstance(teats, list):
        raise BadAnswer('its answer has no list "teats"; an empty list says that there are none')
    if isinstance(hidden, bool) or not isinstance(hidden, int):
        raise BadAnswer(
            f'"hidden" of its answer is {json.dumps(hidden)[:_SHOWN]}, not a whole number'
        )
    if reason is not None and not isinstance(reason, str):
        raise BadAnswer(f'"reason" of its answer is {json.dumps(reason)[:_SHOWN]}, not text')
    return Detection(
        tuple(_teat(number, teat, calibration) for number, teat in enumerate(teats, 1)),
        hidden,
        reason,
    )


def shown(line: bytes) -> str:
    """A line for a sentence: its beginning."""
    text = line.decode("utf-8", errors="replace").strip()
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def _object(line: bytes) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):  # neither JSON nor UTF-8, or nested without end
        raise Garbled(f'its line is not JSON: "{shown(line)}"') from None
    if not isinstance(found, dict):
        raise Garbled(f'its line is no JSON object: "{shown(line)}"')
    return found


def _teat(number: int, given: Any, calibration: Calibration) -> Teat:
    if not isinstance(given, dict):
        raise BadAnswer(
            f'teat {number} of its answer is no object with "world_mm", or "left_px" and "right_px"'
        )
    covariance = given.get("covariance_mm2")
    spread = (
        None
        if covariance is None
        else _numbers(covariance, (3, 3), f'"covariance_mm2" of teat {number}')
    )
    left, right = (
        (
            None
            if given.get(name) is None
            else _numbers(given[name], (2,), f'"{name}" of teat {number}')
        )
        for name in ("left_px", "right_px")
    )
    if given.get("world_mm") is not None:
        return Teat(
            _numbers(given["world_mm"], (3,), f'"world_mm" of teat {number}'), spread, left, right
        )
    if left is None or right is None:
        raise BadAnswer(
            f'teat {number} of its answer has neither "world_mm" nor both of "left_px" and'
            ' "right_px"'
        )
    return Teat(_world_mm(number, left, right, calibration), spread, left, right)


def _world_mm(number: int, left: Array, right: Array, calibration: Calibration) -> Array:
    """Where the rays through two pixels (2,) pass each other, (3,) mm."""
    with np.errstate(all="ignore"):  # pixels may be anywhere; what comes of them is looked at
        in_right, _ = triangulate(
            left[None],
            right[None],
            calibration.left,
            calibration.right,
            calibration.right_from_left,
        )
        world: Array = calibration.world_from_right.apply(in_right)[0]
    if not np.isfinite(world).all():
        raise BadAnswer(
            f'"left_px" {left.tolist()} and "right_px" {right.tolist()} of teat {number} lead to no'
            " point in space"
        )
    return world


def _numbers(given: Any, shape: tuple[int, ...], what: str) -> Array:
    try:
        found = np.array(given)
        if found.shape == shape and found.dtype.kind in "iuf":
            return found.astype(np.float64)
    except ValueError:  # rows of different lengths
        pass
    sizes = " x ".join(map(str, shape))
    raise BadAnswer(f"{what} of its answer is {json.dumps(given)[:_SHOWN]}, not {sizes} numbers")


def _plain(value: Array | None) -> Any:
    return None if value is None else np.asarray(value).tolist()


def _line(message: Mapping[str, Any]) -> bytes:
    return json.dumps(message, ensure_ascii=False).encode() + b"\n"
