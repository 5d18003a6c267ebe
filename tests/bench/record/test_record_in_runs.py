"""What a run's physical actions find in the record: all that was said before is on the disk when
the next thing in the world happens.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from bench.record.reader import TrialRecord
from bench.record.schema import DATABASE
from bench.record.writer import Store
from bench.run.engine import Ending
from instruments.bath.driver import Bath
from instruments.operators.emulated import EmulatedOperator
from instruments.stage.driver import Stage
from tests.bench.killed_runs import start
from tests.bench.operated_runs import CHECK_POINT, STAGE, files

ACTIONS: tuple[tuple[type, str], ...] = (
    (Stage, "home"),
    (Stage, "move_to"),
    (Stage, "stop"),
    (Bath, "start"),
    (Bath, "standby"),
    (Bath, "safe"),
    (EmulatedOperator, "ask"),
    (EmulatedOperator, "_set_up"),
    (EmulatedOperator, "_touch"),
)


class Spoken:
    """Counts what a store is told, and compares it with what another process would see."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.folder: Path | None = None
        self.said = Counter[str]()
        self.looked = Counter[str]()
        event, finished = Store.event, Store.finished

        def said(store: Store, *words: Any) -> None:
            self.folder = store.folder
            self.said["events"] += 1
            event(store, *words)

        def done(store: Store, trial: TrialRecord) -> None:
            self.said["trials"] += 1
            finished(store, trial)

        patch.setattr(Store, "event", said)
        patch.setattr(Store, "finished", done)
        for kind, name in ACTIONS:
            patch.setattr(kind, name, self.looking(f"{kind.__name__}.{name}", getattr(kind, name)))

    def looking(self, what: str, own: Callable[..., Any]) -> Callable[..., Any]:
        def action(*given: Any, **more: Any) -> Any:
            if self.folder:
                self.looked[what] += 1
                with closing(sqlite3.connect(self.folder / DATABASE)) as db:
                    for table in ("events", "trials"):
                        (there,) = db.execute(f"SELECT count(*) FROM {table}").fetchone()
                        assert there == self.said[table], f"{what}: not all {table} were durable"
            return own(*given, **more)

        return action


def test_all_that_was_said_is_durable_before_the_next_physical_action(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files(tmp_path, stage=STAGE, check_point=CHECK_POINT)
    spoken = Spoken(monkeypatch)
    assert start(tmp_path)[1] is Ending.FINISHED
    assert spoken.said["trials"] == 3
    assert {
        "Stage.home",
        "Stage.move_to",
        "Bath.start",
        "Bath.safe",
        "EmulatedOperator._set_up",
        "EmulatedOperator._touch",
    } <= set(spoken.looked)
    assert spoken.looked["Stage.move_to"] >= 3
