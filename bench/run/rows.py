"""What a trial gave as rows of the store's tables. What depends on real time goes into columns that
begin with ``wall``, so that all others repeat with the seed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.files import Picture
from bench.record.schema import Row
from bench.record.writer import Store
from bench.results.answers import Answer, score_answer
from bench.scoring.scene import SceneScore
from bench.truth.uncertainty import TruthPoint
from instruments.camera.frame import FrameSet
from instruments.camera.recording import TruthRow


def frame_rows(
    store: Store, trial_id: str, frames: FrameSet, answers: Sequence[Answer]
) -> list[Row]:
    """Write the frames of a trial, and the pictures that the detectors' stages left; gives back
    their rows.
    """
    images: dict[str, Picture | None] = {"left": frames.left, "right": frames.right}
    images |= {"thermal": frames.thermal, "thermal_radiometric": frames.thermal_ck}
    for answer in answers:
        images |= stage_pictures(answer)
    there = {name: image for name, image in images.items() if image is not None}
    return store.frames(
        trial_id, there, {name: frames.exposed_s.get(name.split("_")[0]) for name in there}
    )


def truth_row(
    trial_id: str,
    row: TruthRow,
    exact: NDArray[np.float64] | None = None,
    point: TruthPoint | None = None,
) -> Row:
    """The row of the table ``truth``; ``point`` has the budget,
    where the truth is the bench's own.
    """
    x, y, z = row.xyz_mm
    kept = None if exact is None else json.dumps([float(v) for v in exact])
    place = {
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "u_mm": row.u_mm,
        "visible": int(row.visible),
        "exact_mm": kept,
    }
    known: Row = (
        {}
        if point is None
        else {"how": point.how.value, "budget": json.dumps(point.uncertainty.as_dict())}
    )
    spread = None if point is None else _json(point.covariance_mm2)
    return {"trial": trial_id, "teat": row.teat, **place, **known, "covariance_mm2": spread}


def judged(
    trial_id: str,
    answers: Sequence[Answer],
    truth: Sequence[TruthRow],
    limit_mm: float,
    time_limit_s: float,
) -> tuple[list[Row], list[Row], dict[str, SceneScore]]:
    """Rows of ``detections`` and ``found``, and scores by detector, for all answers on one frame
    set; no scores without truth.
    """
    detections: list[Row] = []
    found: list[Row] = []
    scores: dict[str, SceneScore] = {}
    for answer in answers:
        head, ends = detection_rows(trial_id, answer)
        detections.append(head)
        found.extend(ends)
        if truth:
            scores[answer.detector] = score_answer(
                answer, truth, limit_mm=limit_mm, time_limit_s=time_limit_s
            )
    return detections, found, scores


def detection_rows(trial: str, answer: Answer) -> tuple[Row, list[Row]]:
    """The rows of the tables ``detections`` and ``found``."""
    detection = answer.detection
    head = {
        "trial": trial,
        "detector": answer.detector,
        "hidden": detection.hidden,
        "reason": detection.reason,
        "outcome": answer.outcome.value,
        "cold": int(answer.cold),
        "trace": json.dumps(
            {
                stage.name: {key: _small(value) for key, value in stage.data.items()}
                for stage in detection.trace
            }
        ),
        "wall_seconds": answer.seconds,
        "wall_start_up_s": answer.start_up_s,
        "wall_stderr": answer.stderr or None,
        "wall_cpu_s": answer.cpu_s,
        "wall_load": answer.load,
    }
    found: list[Row] = []
    for number, teat in enumerate(detection.teats, 1):
        x, y, z = (float(v) for v in teat.world_mm)
        places = {
            "covariance_mm2": _json(teat.covariance_mm2),
            "left_px": _json(teat.left_px),
            "right_px": _json(teat.right_px),
        }
        found.append(
            {
                "trial": trial,
                "detector": answer.detector,
                "number": number,
                "x_mm": x,
                "y_mm": y,
                "z_mm": z,
                **places,
            }
        )
    return head, found


def stage_pictures(answer: Answer) -> dict[str, Picture]:
    """The two-dimensional masks among a detector's stages as 8-bit pictures, by
    ``detector-stage``.
    """
    return {
        f"{answer.detector}-{stage.name.replace(' ', '-')}": np.where(
            mask, np.uint8(255), np.uint8(0)
        )
        for stage in answer.detection.trace
        for mask in stage.data.values()
        if mask.dtype == np.bool_ and mask.ndim == 2
    }


def _json(value: Any) -> str | None:
    return None if value is None else json.dumps(np.asarray(value).tolist())


def _small(value: Any) -> Any:
    """Points and figures go into the record; pictures are told by their shape (masks are kept as
    files of their own).
    """
    array = np.asarray(value)
    return (
        array.tolist()
        if array.size <= 400
        else {"shape": list(array.shape), "type": str(array.dtype)}
    )
