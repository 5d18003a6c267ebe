"""What an answer must be before it is scored: an answer is taken whole or not at all. May not know which detector gave it.

A detector may be anyone's: nothing of its answer is believed before it was looked at, for it goes into record, scores and report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from detector.protocol import Detection, DetectionFailure, Stage, Teat
from reports.sanitize import sanitized

WORKING_VOLUME_MM = 2000.0  # no teat of any rig is further from the table's origin along an axis
MOST_TEATS = 16  # four, and what else a detector may take for one; each costs the scorer time
LONGEST_REASON = 500
LEAST_SD_MM, MOST_SD_MM = 1e-6, 1e6  # beyond, figures made of it are no longer numbers
MOST_STAGES, LONGEST_NAME, MOST_PICTURE_PX = 64, 60, 8192  # what a run keeps of the trace of one answer
_SYMMETRY = 1e-6  # of the greatest entry: six printed digits
_PIXELS = ("left_px", "right_px", "thermal_px")


def checked(detection: Any) -> Detection:
    """The answer as it may be used. Raises DetectionFailure that says which part of it can't be."""
    if not isinstance(detection, Detection):
        raise DetectionFailure(f"its answer is a {type(detection).__name__}, not a Detection")
    hidden = detection.hidden
    if isinstance(hidden, bool) or not isinstance(hidden, int | np.integer) or not 0 <= hidden <= MOST_TEATS:
        raise DetectionFailure(f"its answer counts {hidden!r} teats as hidden; a whole number from 0 to {MOST_TEATS} is asked for")
    if not isinstance(detection.teats, tuple | list):
        raise DetectionFailure(f"the teats of its answer are a {type(detection.teats).__name__}, not a tuple of Teat")
    if len(detection.teats) > MOST_TEATS:
        raise DetectionFailure(f"its answer has {len(detection.teats)} teats; {MOST_TEATS} are taken at most")
    teats = tuple(_teat(number, teat) for number, teat in enumerate(detection.teats, 1))
    trace, lost = _trace(detection.trace)
    reason = "; ".join(one_line(str(part)) for part in (detection.reason, lost) if part is not None)[:LONGEST_REASON]
    return Detection(teats, int(hidden), reason or None, trace)


def one_line(text: str) -> str:
    """Another's words on one line."""
    return sanitized(" ".join(text.split()))


def _teat(number: int, teat: Any) -> Teat:
    if not isinstance(teat, Teat):
        raise DetectionFailure(f"teat {number} of its answer is a {type(teat).__name__}, not a Teat")
    seen = {
        name: None if getattr(teat, name) is None else _numbers(getattr(teat, name), (2,), f"{name} of teat {number}", "two finite numbers")
        for name in _PIXELS
    }
    point = _numbers(teat.world_mm, (3,), f"teat {number} of its answer", "three finite numbers")
    if np.abs(point).max() > WORKING_VOLUME_MM:
        where = ", ".join(f"{value:.4g}" for value in point)
        raise DetectionFailure(f"teat {number} of its answer is at ({where}) mm, outside of the working volume")
    spread = None if teat.covariance_mm2 is None else _covariance(number, teat.covariance_mm2)
    return replace(teat, world_mm=point, covariance_mm2=spread, **seen)


def _covariance(number: int, given: Any) -> Any:
    what = f"the covariance of teat {number}"
    matrix = _numbers(given, (3, 3), what, "3 x 3 finite numbers")
    if np.abs(matrix - matrix.T).max() > _SYMMETRY * np.abs(matrix).max():
        raise DetectionFailure(f"{what} is not symmetric")
    if np.abs(matrix).max() > MOST_SD_MM**2:
        raise DetectionFailure(f"{what} has an entry of {np.abs(matrix).max():.3g} mm2; at most {MOST_SD_MM**2:g} are taken")
    matrix = 0.5 * (matrix + matrix.T)
    least = float(np.linalg.eigvalsh(matrix).min())
    if least <= 0.0:
        raise DetectionFailure(f"{what} is not positive definite")
    if least < LEAST_SD_MM**2:
        raise DetectionFailure(f"{what} claims a standard deviation of {np.sqrt(least):.3g} mm; at least {LEAST_SD_MM:g} mm are taken")
    return matrix


def _numbers(given: Any, shape: tuple[int, ...], what: str, wanted: str) -> Any:
    try:
        found = np.ma.asarray(given) if isinstance(given, np.ma.MaskedArray) else np.asarray(given)
    except (TypeError, ValueError, OverflowError):
        raise DetectionFailure(f"{what} is {_short(given)}, not {wanted}") from None
    if found.shape != shape or found.dtype.kind not in "iuf" or np.ma.is_masked(found) or not np.isfinite(found).all():
        raise DetectionFailure(f"{what} is {_short(found.tolist())}, not {wanted}")
    return np.array(found, dtype=np.float64)


def _trace(trace: Any) -> tuple[tuple[Stage, ...], str | None]:
    """The stages that the record can hold; a trace is only for the reader, so what is wrong with it costs nobody an answer."""
    stages = trace if isinstance(trace, tuple | list) else (trace,)
    kept = {stage.name.casefold().replace(" ", "-"): stage for stage in reversed(stages[:MOST_STAGES]) if _holds(stage)}
    lost = len(stages) - len(kept)
    why = "a stage has a plain name of its own, and arrays of numbers or text by name"
    return tuple(reversed(kept.values())), f"{lost} of its stages can't be kept: {why}" if lost else None


def _holds(stage: Any) -> bool:
    if not isinstance(stage, Stage) or not isinstance(stage.name, str) or not isinstance(stage.data, Mapping):
        return False
    plain = stage.name.replace(" ", "").replace("-", "").isalnum() and len(stage.name) <= LONGEST_NAME
    return plain and all(isinstance(key, str) and key.isprintable() and _keeps(value) for key, value in stage.data.items())


def _keeps(value: Any) -> bool:
    """Whether record and report can show an array: a mask becomes a picture, text stands on a page."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufU":
        return False
    if value.dtype.kind == "U":
        return all(text.isprintable() for text in value.ravel().tolist())
    return value.dtype.kind != "b" or value.ndim != 2 or 0 < min(value.shape) <= max(value.shape) <= MOST_PICTURE_PX


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
