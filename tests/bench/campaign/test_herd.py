"""Cows' visits as they are kept, and a small herd from end to end."""

from __future__ import annotations

import csv
import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.campaign import herd
from bench.campaign.herd import ROWS, VISITS, Cow, Guess, judged, score
from bench.campaign.visits import Confirmed, VisitStore
from bench.config import ConfigError
from bench.record.recording import TruthRow
from bench.results.answers import Answer, score_answer
from bench.rig.loading import LoadedRig
from detector.protocol import Context, Detection, Teat
from tests.bench.commands import Said

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
SURE = 0.2 * np.eye(3)


def end(x: float = 0.0) -> Confirmed:
    return Confirmed(np.array([x, 1.0, 2.0]), SURE, "attached")


@pytest.mark.slow
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(hours=st.lists(st.integers(-80, 80), unique=True, min_size=1, max_size=12))
def test_no_context_holds_a_visit_of_now_or_later(tmp_path: Path, hours: list[int]) -> None:
    path = tmp_path / f"{abs(hash(tuple(hours)))}.sqlite"
    path.unlink(missing_ok=True)
    store = VisitStore(path)
    for hour in hours:
        store.add("12", NOON + timedelta(hours=hour), 8.0, {1: end(hour), 3: end()})
    store.add("13", NOON - timedelta(hours=1), 8.0, {2: end(1000.0)})
    found = store.context("12", NOON, 9.0, 50.0)
    earlier = sorted(hour for hour in hours if hour < 0)
    assert [visit.hours_ago for visit in found.visits] == [-hour for hour in earlier]
    assert [visit.ends_mm[0, 0] for visit in found.visits] == earlier
    assert all(visit.teats == (1, 3) for visit in found.visits)
    assert (found.hours_since_milking, found.days_in_milk) == (9.0, 50.0)


def test_visits_are_only_added_to_and_only_confirmed_ends_are_kept(tmp_path: Path) -> None:
    store = VisitStore(tmp_path / "v.sqlite")
    store.add("12", NOON, 8.0, {1: end()})
    with closing(sqlite3.connect(tmp_path / "v.sqlite")) as db:
        for change in ("UPDATE ends SET x_mm = 3", "DELETE FROM ends"):
            with pytest.raises(sqlite3.IntegrityError, match="visits are only added to"):
                db.execute(change)
    with pytest.raises(ValueError, match="is there already"):
        store.add("12", NOON, 8.0, {2: end()})
    with pytest.raises(ValueError, match="needs a zone"):
        store.add("12", NOON.replace(tzinfo=None), 8.0, {2: end()})
    for how in ("detected", "predicted"):
        with pytest.raises(ValueError, match=rf"only confirmed ends are kept.*not '{how}' ones"):
            Confirmed(np.zeros(3), SURE, how)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="needs three numbers, and a covariance"):
        Confirmed(np.zeros(3), np.zeros((3, 3)), "touched")
    (tmp_path / "text").write_text("no database, but longer than a header of one" * 9)
    with pytest.raises(ConfigError, match="no file of visits"):
        VisitStore(tmp_path / "text")


def test_a_prediction_is_never_found_and_one_of_no_teat_is_invented() -> None:
    stand = Cow(1, 0, 4).stands[3]
    ends = stand.ends_mm
    seen = tuple(Teat(one) for one in ends[1:])
    near, far = Teat(ends[0] + [0.0, 0.0, 1.0], np.eye(3)), Teat(ends[0] + [90.0, 0, 0], np.eye(3))
    visible = [False] + [True] * (len(ends) - 1)
    answer = Detection(seen, predicted=(near, far))
    one, invented = judged(0, 3, stand, visible, answer, Detection(seen), Context(8.0))
    assert (one.teat, one.inside, one.found) == (stand.teats[0], True, False)
    assert one.error_mm == pytest.approx(1.0)
    assert one.volume_ml == pytest.approx(0.0915, abs=1e-3)
    assert invented == Guess(0, 3, 0)
    x, y, z = map(float, ends[0])
    truth = [TruthRow("herd", "1", (x, y, z), visible=True)]
    said = Answer("x", replace(answer, teats=()), 0.1)
    counts = score_answer(said, truth, limit_mm=5.0, time_limit_s=2.0).counts
    assert (counts.matched, counts.missed, counts.false) == (0, 1, 0)
    table = score((one, invented), cows=1, visits=4)
    assert (table.unseen, table.found, table.predicted, table.invented_visits) == (1, 0, 1, 1)


@pytest.mark.slow
def test_a_small_herd(
    small_rig: LoadedRig, tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(herd, "load_rig", lambda _: small_rig)
    command = "campaign herd --cows 2 --visits 8 --seed 1 --workers 1 --out {} --json"
    table = json.loads(said(0, command, tmp_path / "a").out)
    assert table["visits"] == 10
    assert 0 < table["predicted"] <= table["unseen"]
    assert table["within_5_mm"] > table["last_within_5_mm"] >= table["swapped_within_5_mm"] == 0.0
    with (tmp_path / "a" / ROWS).open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) >= table["unseen"]
    assert (tmp_path / "a" / VISITS).exists()
    assert "is there already" in said(2, command, tmp_path / "a").err
