"""What the report says of the calibration: its record, and what can be reached at best by distance,
against its own figures.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from bench.record.reader import RunRecord
from bench.report.accuracy import limit_table
from bench.report.page import record_parts
from bench.rig.loading import RIGS
from bench.script.calibration_age import CALIBRATION_FACT, calibration_fact
from detector.calibration import Calibration, ParameterCovariance, Record, load_calibration

ENDS = np.array([[-250.0, y, 120.0] for y in (150.0, 200.0, 300.0, 420.0, 600.0, 800.0, 900.0)])
BASELINE_SD_MM = 0.5


@pytest.fixture
def rig() -> Calibration:
    """The emulated rig's with a baseline that is uncertain, and nothing else."""
    whole = load_calibration(RIGS / "calibration.toml")
    return replace(
        whole, covariance=ParameterCovariance((("stereo", "T1"),), np.array([[BASELINE_SD_MM**2]]))
    )


def column(table_rows: tuple[tuple[object, ...], ...], at: int) -> list[float]:
    return [float(str(row[at])) for row in table_rows]


def test_it_grows_with_distance_and_noise_comes_on_top(rig: Calibration) -> None:
    rows = limit_table(ENDS, rig).rows
    assert sum(int(str(row[1])) for row in rows) == len(ENDS)
    per_px, own, seen = column(rows, 2), column(rows, 3), column(rows, 4)
    assert per_px == sorted(per_px)
    assert own == sorted(own)
    assert all(o < s for o, s in zip(own, seen, strict=True))
    assert per_px[-1] == pytest.approx(rig.depth_per_disparity_px_mm(ENDS[-1:])[0], abs=0.05)


def test_a_baseline_off_by_a_share_is_a_distance_off_by_that_share(rig: Calibration) -> None:
    """All lengths from the right camera scale with the baseline: k = 2 of a point at 1.7 m is twice
    sd / B of its distance.
    """
    farthest = limit_table(ENDS, rig).rows[-1]
    from_camera = np.linalg.norm(rig.world_from_right.inverse().apply(ENDS[-1:])[0])
    assert float(str(farthest[3])) == pytest.approx(
        2.0 * BASELINE_SD_MM / rig.baseline_mm * from_camera, rel=0.01
    )


def test_a_calibration_that_states_nothing_says_so(rig: Calibration) -> None:
    table = limit_table(ENDS, replace(rig, covariance=None))
    assert {str(row[3]) for row in table.rows} == {"not measured"}
    assert "states no uncertainty" in (table.note or "")


class TestRecord:
    def text(self, calibration: Calibration, *, emulated: bool) -> str:
        facts = {
            CALIBRATION_FACT: calibration_fact(calibration, date(2026, 11, 20), emulated=emulated)
        }
        return str(tuple(record_parts(cast("RunRecord", SimpleNamespace(facts=facts)))))

    def test_it_states_the_age_and_who_made_it_from_what(self, rig: Calibration) -> None:
        record = Record("2026-11-01", "A. Tester", "teatbench 0.1", {"left": "SN 1"}, {})
        said = self.text(replace(rig, record=record), emulated=False)
        for words in ("2026-11-01", "19 days on the day of the run", "A. Tester", "SN 1"):
            assert words in said

    def test_one_without_a_record_is_no_better_than_unknown(self, rig: Calibration) -> None:
        assert "Its age is not known, so it is not checked." in self.text(rig, emulated=False)
        assert "The emulated cameras are made from it." in self.text(rig, emulated=True)

    def test_a_run_that_kept_nothing_of_it_says_nothing(self) -> None:
        assert tuple(record_parts(cast("RunRecord", SimpleNamespace(facts={})))) == ()
