"""Any record can be read, judged, listed and written as a page: of no trial or one, all ends hidden,
no truth, no answer, a camera lost, any ending, several sessions.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.console import watching
from bench.record.reader import TrialRecord, read_run
from bench.record.recording import TruthRow
from bench.record.writer import Store
from bench.report import summary
from bench.report.page import write_run_report
from bench.report.runs import list_runs, write_runs_page
from bench.results.answers import Answer, score_answers
from bench.results.status import read_status
from bench.results.verdicts import stored_rules
from bench.run.rows import detection_tables
from bench.script.model import Rules
from detector.protocol import Detection, Outcome, Teat
from instruments.clock import wall_time
from tests.bench.small_run import KEPT

OF = read_run(KEPT)
FILES = ("calibration.toml", "rig.toml", "script.toml")
KINDS = ("emulated", "mixed", "real", "recorded")
ENDINGS = ("finished", "faulted", "aborted", "interrupted")
# written in one step, as a run opens its instruments
OF_BATH = (
    *("interlocks asleep", "pump", "comms loss", "cut-out tested", "safe states", "guardian"),
    "bath figures",
)
OPTIONAL = (
    *("calibration record", "arm uncertainty", "arm check before", "arm check after"),
    *("identities", "arm record", "frame checks", "instruments at the end", "retries"),
)


@dataclass(frozen=True, slots=True)
class Drawn:
    """A trial: which of those kept, how many of its ends have a truth, and what became of it."""

    of: int
    ends: int
    hidden: bool
    how: str | None
    stated: bool
    skipped: bool
    invalid: bool
    outcome: Outcome
    off_mm: float
    false: bool
    seconds: float
    without: str  # camera

    def truth(self, trial: str) -> list[dict[str, Any]]:
        rows = [dict(row) for row in OF.trials[self.of].truth[: self.ends]]
        for row in rows:
            row |= {"trial": trial, "visible": int(not self.hidden), "how": self.how}
            if not self.stated:
                row |= {"u_mm": None, "budget": None, "covariance_mm2": None, "cameras": None}
        return rows

    def answer(self, detector: str, truth: Sequence[TruthRow]) -> Answer:
        found: list[Teat] = []
        if self.outcome is Outcome.ANSWERED:
            found = [Teat(world_mm=np.add(row.xyz_mm, [self.off_mm, 0.0, 0.0])) for row in truth]
            found += [Teat(world_mm=np.array([1e6, 0.0, 0.0]))] * self.false
        detection = Detection(tuple(found), int(self.hidden), None if found else "it was dark")
        return Answer(detector, detection, self.seconds, self.outcome)


TRIAL = st.builds(
    Drawn,
    of=st.integers(0, len(OF.trials) - 1),
    ends=st.integers(0, 4),
    hidden=st.booleans(),
    how=st.sampled_from(["touched", "carried", None]),
    stated=st.booleans(),
    skipped=st.booleans(),
    invalid=st.booleans(),
    outcome=st.sampled_from(Outcome),
    off_mm=st.sampled_from([0.0, 0.3, 20.0]),
    false=st.booleans(),
    seconds=st.sampled_from([0.0, 0.1, 100.0]),
    without=st.sampled_from(["", "left", "right", "thermal"]),
)


def written(store: Store, trials: Sequence[Drawn], detectors: Sequence[str], rules: Rules) -> None:
    for number, one in enumerate(trials, 1):
        kept = OF.trials[one.of]
        id_ = f"{number:03d}-{kept.pose}-{number}"
        head = {key: kept.head[key] for key in kept.head if key not in ("invalid", "session")}
        head |= {"id": id_, "number": number, "repeat": number}
        if one.skipped:
            named = {key: head[key] for key in ("number", "name", "situation", "repeat")}
            store.skipped({"trial": id_, **named, "t_s": 1.0, "reason": "the hose leaks"})
            continue
        rows = one.truth(id_)
        situation, seen = head["situation"], not one.hidden
        truth = [
            TruthRow(situation, r["teat"], (r["x_mm"], r["y_mm"], r["z_mm"]), seen, r["u_mm"])
            for r in rows
        ]
        answers = [one.answer(name, truth) for name in detectors]
        limits = {"limit_mm": rules.visible_within_mm, "time_limit_s": rules.time_limit_s}
        scores = score_answers(answers, truth, **limits)
        frames = []
        for row in kept.frames:
            if one.without and row["camera"].startswith(one.without):
                continue
            path = f"frames/{id_}/{row['camera']}.png"
            (store.folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(KEPT / row["path"], store.folder / path)
            frames.append({**row, "trial": id_, "path": path})
        tables = detection_tables(id_, answers)
        store.finished(TrialRecord(head, frames, (), rows, *tables, scores))
        if one.invalid:
            store.checked([], [id_], "the phantom was moved")


@pytest.mark.slow
@given(
    trials=st.lists(TRIAL, max_size=5),
    detectors=st.sampled_from([("fused",), ("fused", "thesis"), ("own", "fused", "thesis")]),
    missing=st.sets(st.sampled_from(OPTIONAL)),
    opened=st.booleans(),
    kind=st.sampled_from(KINDS),
    ending=st.sampled_from(ENDINGS),
    readings=st.sampled_from([0, 1, 2, 30]),
    sessions=st.integers(1, 3),
)
@settings(max_examples=25, deadline=None)
def test_any_record_becomes_a_page_on_each_surface(
    trials: list[Drawn],
    detectors: tuple[str, ...],
    missing: set[str],
    opened: bool,
    kind: str,
    ending: str,
    readings: int,
    sessions: int,
) -> None:
    gone = {*missing, "ending", *(() if opened else OF_BATH)}
    items = dict.fromkeys(detectors, OF.facts["items"]["fused"])
    facts = {key: OF.facts[key] for key in OF.facts.keys() - gone}
    facts |= {"detectors": [*detectors], "items": items, "kind": kind, "planned": len(trials) + 1}
    facts |= {"emulated": ["arm"]} if kind == "mixed" else {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "20261129-120000-any"
        store = Store.create(
            folder, {name: (KEPT / name).read_text(encoding="utf-8") for name in FILES}
        )
        for key, value in facts.items():
            store.fact(key, value)
        for session in range(1, sessions + 1):
            if session > 1:
                store.close()
                store = Store(folder)
            for k in range(readings):
                bath = {"t_s": 10.0 * k, "temp_c": 33.0, "external_c": None, "power_percent": None}
                store.bath({**bath, "state": "stable"})
            store.event(None, "fault", "bath: no answer", wall_time())
        written(store, trials, detectors, stored_rules(KEPT))
        if ending != "interrupted":
            store.fact("ending", ending)
        store.close()
        found = write_run_report(folder)
        shown = read_status(folder).as_dict()
        assert found.status.as_dict() | {"wall_time": ""} == shown | {"wall_time": ""}
        assert summary.of_run(found)
        assert write_runs_page(list_runs(folder.parent)).is_file()
        (card,) = watching.listed(folder.parent)
        assert card["status"]["headline"] == shown["headline"]
        assert len(watching.trials(folder)) == sum(not one.skipped for one in trials)
