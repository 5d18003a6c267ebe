"""Covariances as they stand in a run's rows: what a detector claims of an answer, and what is known of the truth."""

from __future__ import annotations

import json

import numpy as np

from bench.scoring.points import Floats
from bench.store import Row


def claimed_mm2(answer: Row, truth: Row) -> Floats | None:
    """What the difference of an answer and its truth should scatter by (3, 3), mm^2; None where the detector claims nothing usable."""
    stated = covariance_of(answer)
    if stated is None:
        return None
    own = covariance_of(truth)
    if own is None:
        own = np.eye(3) * float(truth["u_mm"] or 0.0) ** 2
    total = stated + own
    return total if np.all(np.linalg.eigvalsh(total) > 0.0) else None


def covariance_of(row: Row) -> Floats | None:
    """The covariance (3, 3) of a row, mm^2; None where there is none, or what stands there is no such thing."""
    text = row["covariance_mm2"]
    matrix = np.array(json.loads(text) if text else [], dtype=np.float64)
    return matrix if matrix.shape == (3, 3) and np.isfinite(matrix).all() else None
