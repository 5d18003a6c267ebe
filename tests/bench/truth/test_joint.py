"""A run's truth as one covariance, from records of every schema, from recordings, and from runs whose
table frame is there or gone.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.record.reader import RunRecord, TrialRecord, read_run
from bench.results.error_rows import error_rows
from bench.rig.arm_files import TableFrame, TouchedPoint, frame_text
from bench.truth.joint import ARM_LENGTH_MM, joint_truth
from instruments.microscribe.emulator import KinematicError
from instruments.microscribe.kinematics import inverse
from instruments.microscribe.unit import shipped_unit
from tests.bench.small_run import KEPT
from tests.bench.truth.touches import MADE

CORNERS = {"o": (0.0, 0.0, 0.0), "x": (400.0, 0.0, 0.0), "y": (0.0, 400.0, 0.0)}
U = 0.23


def touched(number: int, x_mm: float, **budget: float) -> TrialRecord:
    lines = [{"name": name, "u_mm": u, "source": ""} for name, u in budget.items()]
    u_mm = float(np.sqrt(sum(u**2 for u in budget.values())))
    row: dict[str, Any] = {"teat": "1", "x_mm": x_mm, "y_mm": 300.0, "z_mm": 130.0, "visible": 1}
    row |= {"u_mm": u_mm, "how": "touched", "budget": json.dumps({"components": lines})}
    head = {"id": f"{number:03d}", "name": f"p{number}", "number": number, "stage_mm": None}
    return TrialRecord(head, truth=(row,))


def run_of(folder: Path, trials: list[TrialRecord], **facts: Any) -> RunRecord:
    return RunRecord(folder, {"detectors": [], **facts}, tuple(trials))


def ends_of(run: RunRecord) -> list[Any]:
    return [(trial, row) for trial in run.trials for row in trial.truth]


def test_it_can_be_had_of_a_kept_run() -> None:
    run = read_run(KEPT)
    ends = ends_of(run)
    joint = joint_truth(run, ends)
    u_mm = np.array([row["u_mm"] or 0.0 for _, row in ends])
    own = np.trace(joint.covariances_mm2, axis1=1, axis2=2)
    np.testing.assert_allclose(own, 3.0 * u_mm**2, rtol=1e-6)
    for detector in run.detectors:
        rows = error_rows(run, detector)
        assert rows.truth is not None
        assert len(rows.truth.fresh) == len(rows.errors_mm)


@pytest.mark.slow
def test_the_frames_touches_turn_all_ends_alike(tmp_path: Path) -> None:
    frame = TableFrame.from_touches(MADE, "1", [TouchedPoint(*one) for one in CORNERS.items()])
    (tmp_path / "arm-frame.toml").write_text(frame_text(frame), encoding="utf-8")
    places = (-200.0, 0.0, 200.0)
    u_mm = [frame.u_registration_mm((x, 300.0, 130.0), U) for x in places]
    trials = [touched(k, x, arm=U, registration=u_mm[k]) for k, x in enumerate(places)]
    fact = {"arm frame": {"file": "arm-frame.toml"}}
    exact = joint_truth(run := run_of(tmp_path, trials, **fact), ends_of(run))
    rng = np.random.default_rng(1)
    drawn = np.array(
        [
            TableFrame.from_touches(
                MADE,
                "1",
                [
                    TouchedPoint(name, tuple(np.add(at, rng.normal(0.0, U, 3)).tolist()))
                    for name, at in CORNERS.items()
                ],
            ).world_from_arm.apply([[x, 300.0, 130.0] for x in places])
            for _ in range(3000)
        ]
    )
    of_frame = exact.common[:, :, [source == "table frame" for source in exact.sources]]
    flat, seen = of_frame.reshape(9, -1), drawn.reshape(len(drawn), 9)
    np.testing.assert_allclose(flat @ flat.T, np.cov(seen.T), atol=0.012)
    gone = joint_truth(run := replace(run, folder=tmp_path / "elsewhere"), ends_of(run))
    for joint in (exact, gone):
        assert "table frame" in joint.sources
        own = np.trace(joint.covariances_mm2, axis1=1, axis2=2)
        np.testing.assert_allclose(own, 3.0 * (U**2 + np.square(u_mm)), rtol=1e-6)


def test_what_is_not_said_is_common_and_what_is_exact_is_nothing(tmp_path: Path) -> None:
    trials = [touched(k, 10.0 * k, arm=U) for k in range(4)]
    plain = [replace(t, truth=({**t.truth[0], "budget": None},)) for t in trials]
    joint = joint_truth(run := run_of(tmp_path, plain), ends_of(run))
    assert set(joint.sources) == {"not said"}
    assert not joint.fresh.any()
    assert np.trace(joint.of_mean(np.full(4, 0.25))) == pytest.approx(3.0 * U**2, rel=0.01)
    none = [replace(t, truth=({**t.truth[0], "budget": None, "u_mm": None},)) for t in trials]
    exact = joint_truth(run := run_of(tmp_path, none), ends_of(run))
    assert not exact.shares
    fresh = [touched(k, 10.0 * k, definition=0.1, scatter=0.05) for k in range(4)]
    alone = joint_truth(run := run_of(tmp_path, fresh), ends_of(run))
    assert not alone.shares
    np.testing.assert_allclose(alone.fresh, np.tile(0.0125 * np.eye(3), (4, 1, 1)))


@pytest.mark.slow
def test_emulated_arms_errors_change_over_the_length_that_is_taken() -> None:
    """Its own kinematic errors: their gradient over their size, and what is not linear in place."""
    unit = shipped_unit("40937")
    geometry = unit.geometry()
    home = geometry.angles(unit.home)[0]
    at = np.array([[x, y, 135.0] for x in (-215.0, -115.0, -15.0) for y in (270.0, 360.0, 450.0)])
    up = (0.0, 0.0, 1.0)
    counts = [inverse(geometry, point, up, start=unit.home) for point in at]
    angles = np.concatenate([geometry.angles(one) for one in counts])
    errors = np.array(
        [KinematicError(geometry, home, seed=k, accuracy_mm=U).at(angles) for k in range(60)]
    )
    design = np.column_stack([np.ones(len(at)), (at - at.mean(axis=0))[:, :2]])
    parts = np.einsum("kn,snj->skj", np.linalg.pinv(design), errors)
    size, gradient = np.sqrt(np.mean(parts[:, 0] ** 2)), np.sqrt(np.mean(parts[:, 1:] ** 2))
    left = errors - np.einsum("nk,skj->snj", design, parts)
    assert size / gradient == pytest.approx(ARM_LENGTH_MM, rel=0.35)
    assert U / gradient > ARM_LENGTH_MM  # the stated figure is on the safe side
    assert np.sqrt(np.mean(left**2)) < 0.1 * size
