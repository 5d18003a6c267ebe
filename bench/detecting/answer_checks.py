"""What an answer must be before it is scored: an answer is taken whole or not at all. May not know which detector gave it.

A detector may be anyone's: nothing of its answer is believed before it was looked at, for it goes into record, scores and report.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from detector.protocol import Detection, DetectionFailure, Stage, Teat

WORKING_VOLUME_MM = 2000.0  # no teat of any rig is further from the table's origin along an axis
MOST_TEATS = 16  # four, and what else a detector may take for one; each costs the scorer time
LONGEST_REASON = 500
_SYMMETRY = 1e-6  # of the greatest entry: six printed digits
_PIXELS = ("left_px", "right_px", "thermal_px")


def checked(detection: Any) -> Detection:
    """The answer as it may be used. Raises DetectionFailure that says which part of it can't be."""
    if not isinstance(detection, Detection):
        raise DetectionFailure(f"its answer is a {type(detection).__name__}, not a Detection")
    hidden = detection.hidden
    if isinstance(hidden, bool) or not isinstance(hidden, int | np.integer) or not 0 <= hidden <= MOST_TEATS:
        raise DetectionFailure(f"its answer counts {hidden!r} teats as hidden; a whole number from 0 to {MOST_TEATS} is asked for")
    if len(detection.teats) > MOST_TEATS:
        raise DetectionFailure(f"its answer has {len(detection.teats)} teats; {MOST_TEATS} are taken at most")
    teats = tuple(_teat(number, teat) for number, teat in enumerate(detection.teats, 1))
    trace, lost = _trace(detection.trace)
    reason = "; ".join(" ".join(str(part).split()) for part in (detection.reason, lost) if part is not None)[:LONGEST_REASON]
    return Detection(teats, int(hidden), reason or None, trace)


def _teat(number: int, teat: Any) -> Teat:
    if not isinstance(teat, Teat):
        raise DetectionFailure(f"teat {number} of its answer is a {type(teat).__name__}, not a Teat")
    point = _numbers(teat.world_mm, (3,), f"teat {number} of its answer", "three finite numbers")
    if np.abs(point).max() > WORKING_VOLUME_MM:
        where = ", ".join(f"{value:.4g}" for value in point)
        raise DetectionFailure(f"teat {number} of its answer is at ({where}) mm, outside of the working volume")
    seen = {
        name: None if getattr(teat, name) is None else _numbers(getattr(teat, name), (2,), f"{name} of teat {number}", "two finite numbers")
        for name in _PIXELS
    }
    spread = None if teat.covariance_mm2 is None else _covariance(number, teat.covariance_mm2)
    return replace(teat, world_mm=point, covariance_mm2=spread, **seen)


def _covariance(number: int, given: Any) -> Any:
    what = f"the covariance of teat {number}"
    matrix = _numbers(given, (3, 3), what, "3 x 3 finite numbers")
    if np.abs(matrix - matrix.T).max() > _SYMMETRY * np.abs(matrix).max():
        raise DetectionFailure(f"{what} is not symmetric")
    matrix = 0.5 * (matrix + matrix.T)
    if np.linalg.eigvalsh(matrix).min() <= 0.0:
        raise DetectionFailure(f"{what} is not positive definite")
    return matrix


def _numbers(given: Any, shape: tuple[int, ...], what: str, wanted: str) -> Any:
    try:
        found = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DetectionFailure(f"{what} is {_short(given)}, not {wanted}") from None
    if found.shape != shape or not np.isfinite(found).all():
        raise DetectionFailure(f"{what} is {_short(found.tolist())}, not {wanted}")
    return found


def _trace(trace: Any) -> tuple[tuple[Stage, ...], str | None]:
    """The stages that the record can hold; a trace is only for the reader, so what is wrong with it costs nobody an answer."""
    kept = tuple(stage for stage in trace if _holds(stage)) if isinstance(trace, tuple | list) else ()
    lost = len(trace) - len(kept) if isinstance(trace, tuple | list) else 1
    return kept, f"{lost} of its stages can't be kept: a stage has a plain name, and arrays of numbers or text by name" if lost else None


def _holds(stage: Any) -> bool:
    if not isinstance(stage, Stage) or not isinstance(stage.name, str) or not stage.name.replace(" ", "").replace("-", "").isalnum():
        return False
    return all(isinstance(key, str) and isinstance(value, np.ndarray) and value.dtype.kind in "biufU" for key, value in stage.data.items())


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
