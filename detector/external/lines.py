"""JSON lines between the bench and an external detector.

After a `GarbledLine` nothing can be trusted; `BadAnswer` is only that answer. Figures are checked
where all detectors' answers are.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from detector.calibration import Calibration
from detector.geometry import Array
from detector.protocol import (
    CamerasOff,
    Context,
    Detection,
    Detector,
    Teat,
    TrainedOn,
    Visit,
    trained_on_of,
)
from textfiles.text import short

READY = {"ready": True}
PICTURES = ("left", "right", "thermal", "thermal_radiometric", "depth", "depth_amplitude")
_SHOWN = 80


class GarbledLine(ValueError):  # noqa: N818 - the line is garbled
    """Not a line of this protocol."""


class BadAnswer(ValueError):  # noqa: N818 - the answer is bad
    """An answer whose values can't be right."""


@dataclass(frozen=True, slots=True)
class Ready:
    """What the child's first line says beside that it is ready."""

    trained_on: TrainedOn = field(default_factory=dict)
    device: str = ""


def ready_line(detector: Detector) -> bytes:
    """The first line, as a detector in Python gives it."""
    said = {name: given for name in Ready.__slots__ if (given := getattr(detector, name, None))}
    return _line({**READY, **said})


def request_line(
    frame: str, pictures: Mapping[str, Path], calibration: Path, context: Context | None = None
) -> bytes:
    """The request: frame's name, paths of its pictures, calibration, the cow's history if any."""
    paths = {name: str(pictures[name]) for name in PICTURES if name in pictures}
    more = {} if context is None else {"context": asdict(context)}
    return _line({"frame": frame, **paths, "calibration": str(calibration), **more})


def context_in(asked: Mapping[str, Any]) -> Context | None:
    """The history in a request, None without."""
    if (given := asked.get("context")) is None:
        return None
    visits = tuple(
        Visit(
            one["hours_ago"],
            one["hours_since_milking"],
            tuple(one["teats"]),
            np.array(one["ends_mm"], dtype=np.float64).reshape(-1, 3),
            np.array(one["covariances_mm2"], dtype=np.float64).reshape(-1, 3, 3),
        )
        for one in given["visits"]
    )
    cameras = given.get("cameras")
    off = None if cameras is None else CamerasOff(**cameras)
    return Context(given["hours_since_milking"], given["days_in_milk"], visits, off)


def answer_line(frame: str, detection: Detection) -> bytes:
    """An answer, as a detector in Python gives it."""
    teats, predicted = (
        [{"world_mm": t.world_mm, "covariance_mm2": t.covariance_mm2} for t in some]
        for some in (detection.teats, detection.predicted)
    )
    answer = {"frame": frame, "teats": teats} | ({"predicted": predicted} if predicted else {})
    return _line({**answer, "hidden": detection.hidden, "reason": detection.reason})


def check_ready(line: bytes) -> Ready:
    """Raises GarbledLine where the child's first line isn't the one that says it is ready."""
    wanted = f"its first line must be {json.dumps(READY)}"
    try:
        said = _object(line)
    except GarbledLine as fault:
        raise GarbledLine(f"{wanted}, but {fault}") from None
    if said.get("ready") is not True:
        raise GarbledLine(f'{wanted}, is "{shown(line)}"')
    device = said.get("device", "")
    if not isinstance(device, str):
        raise GarbledLine(f'"device" of its first line is {json.dumps(device)[:_SHOWN]}, not text')
    try:
        return Ready(trained_on_of(said.get("trained_on", {})), device)
    except ValueError as fault:
        raise GarbledLine(f"{fault}, in its first line") from None


def parse_answer(line: bytes, frame: str, calibration: Calibration) -> Detection:
    """The answer on ``frame``: teats "world_mm" [x, y, z], or "left_px" and "right_px" [column,
    row].

    Pixels are triangulated, unknown keys ignored. Raises GarbledLine for no answer on this
    frame, BadAnswer for bad values.
    """
    answer = _object(line)
    if answer.get("frame") != frame:
        hint = "; a frame's name is text" if str(answer.get("frame")) == frame else ""
        raise GarbledLine(f'it was asked about frame "{frame}" and answered "{shown(line)}"{hint}')
    teats, hidden, reason = answer.get("teats"), answer.get("hidden", 0), answer.get("reason")
    if not isinstance(teats, list):
        raise BadAnswer('its answer has no list "teats"; an empty list says that there are none')
    if isinstance(hidden, bool) or not isinstance(hidden, int):
        seen = json.dumps(hidden)[:_SHOWN]
        raise BadAnswer(f'"hidden" of its answer is {seen}, not a whole number')
    if reason is not None and not isinstance(reason, str):
        raise BadAnswer(f'"reason" of its answer is {json.dumps(reason)[:_SHOWN]}, not text')
    predicted = answer.get("predicted", [])
    if not isinstance(predicted, list):
        raise BadAnswer('"predicted" of its answer is no list')
    found, unseen = (
        tuple(_teat(number, teat, calibration) for number, teat in enumerate(some, 1))
        for some in (teats, predicted)
    )
    return Detection(found, hidden, reason, predicted=unseen)


def shown(line: bytes) -> str:
    """A line for a sentence: its beginning."""
    return short(line.decode("utf-8", errors="replace").strip(), _SHOWN)


def _object(line: bytes) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):  # neither JSON nor UTF-8, or nested without end
        raise GarbledLine(f'its line is not JSON: "{shown(line)}"') from None
    if not isinstance(found, dict):
        raise GarbledLine(f'its line is no JSON object: "{shown(line)}"')
    return found


_SHAPES = {"world_mm": (3,), "covariance_mm2": (3, 3), "left_px": (2,), "right_px": (2,)}


def _teat(number: int, given: Any, calibration: Calibration) -> Teat:
    who, pair = f"teat {number} of its answer", '"left_px" and "right_px"'
    if not isinstance(given, dict):
        raise BadAnswer(f'{who} is no object with "world_mm", or {pair}')
    world_mm, spread, left, right = (
        None if given.get(name) is None
        else _numbers(given[name], shape, f'"{name}" of teat {number}')
        for name, shape in _SHAPES.items()
    )  # fmt: skip
    if world_mm is None:
        if left is None or right is None:
            raise BadAnswer(f'{who} has neither "world_mm" nor both of {pair}')
        with np.errstate(all="ignore"):  # pixels may be anywhere; what comes of them is looked at
            world_mm = calibration.place(left[None], right[None])[0]
        if not np.isfinite(world_mm).all():
            seen = f'"left_px" {left.tolist()} and "right_px" {right.tolist()} of teat {number}'
            raise BadAnswer(f"{seen} lead to no point in space")
    return Teat(world_mm, spread, left, right)


def _numbers(given: Any, shape: tuple[int, ...], what: str) -> Array:
    try:
        found = np.array(given)
        if found.shape == shape and found.dtype.kind in "iuf":
            return found.astype(np.float64)
    except ValueError:  # rows of different lengths
        pass
    sizes = " x ".join(map(str, shape))
    raise BadAnswer(f"{what} of its answer is {json.dumps(given)[:_SHOWN]}, not {sizes} numbers")


def _line(message: Mapping[str, Any]) -> bytes:
    text = json.dumps(message, ensure_ascii=False, default=lambda each: np.asarray(each).tolist())
    return text.encode() + b"\n"
