"""The run folder: whole trials or none, whatever dies."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.config import ConfigError
from bench.record.reader import TrialRecord, read_run
from bench.record.schema import DATABASE
from bench.record.writer import Store, new_run_folder
from instruments.clock import wall_time


def facts(store: Store) -> None:
    for key, value in {"detectors": ["thesis"], "title": "t", "kind": "emulated"}.items():
        store.fact(key, value)


PLACE = {"x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0}
READING = {"temp_c": 33.0, "external_c": None, "power_percent": 2.0, "state": "stable"}


def bare_trial(number: int) -> TrialRecord:
    """A trial without frames."""
    name = f"{number:03d}-x-1"
    head = {"id": name, "number": number, "name": "x", "situation": "s", "repeat": 1}
    of = {"trial": name, "detector": "thesis"}
    detection = {**of, "hidden": 0, "reason": None, "trace": "{}", "wall_seconds": 0.1}
    return TrialRecord(
        {**head, "wall_time": "now"},
        truth=[{"trial": name, "teat": "1", **PLACE, "u_mm": 0.2, "visible": 1}],
        detections=[detection],
        found=[{**of, "number": 1, **PLACE}],
    )


def trial(store: Store, number: int) -> TrialRecord:
    """With a frame in its place, and a bath reading told."""
    done = bare_trial(number)
    picture = np.full((48, 64), number % 256, np.uint8)
    frames = store.frames(done.id, {"left": picture}, {"left": 1.0})
    store.bath({"t_s": float(number), **READING})
    return replace(done, frames=frames)


Damage = Callable[[Path], object]


def sql(*commands: str) -> Damage:
    """Somebody with a database tool."""

    def edit(run: Path) -> None:
        with closing(sqlite3.connect(run / DATABASE)) as db:
            for command in commands:
                assert db.execute(command).rowcount, f"{command}: nothing was changed"
            db.commit()

    return edit


def flipped(data: bytes, at: int, bits: int) -> bytes:
    return data[:at] + bytes([data[at] ^ bits]) + data[at + 1 :]


def test_what_was_written_is_read(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "run", {"script.toml": "x = 1"})
    facts(store)
    store.event(None, "state", "preparing", wall_time())
    store.finished(trial(store, 7))
    store.close()
    run = read_run(tmp_path / "run")
    assert run.ending == "interrupted"
    assert [t.id for t in run.trials] == ["007-x-1"]
    assert run.trials[0].found[0]["z_mm"] == 3.0
    assert run.bath.tolist() == [[7.0, 33.0, 2.0]]
    (frame,) = run.trials[0].frames
    assert (np.asarray(cv2.imread(str(run.folder / frame["path"]), -1)) == 7).all()


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is no run"):
        read_run(tmp_path)
    (tmp_path / DATABASE).write_bytes(b"no database, but long enough to have a header" * 20)
    with pytest.raises(ConfigError, match="can't be read"):
        read_run(tmp_path)


def test_two_runs_of_one_second_get_two_folders(tmp_path: Path) -> None:
    now = wall_time()
    first = new_run_folder(tmp_path, "six", now)
    first.mkdir()
    second = new_run_folder(tmp_path, "six", now)
    assert first != second
    assert ":" not in second.name


def test_the_link_over_many_facts_repeats_in_another_process(tmp_path: Path) -> None:
    """Facts are named as they were written, and none whose value doesn't repeat."""
    keys = [f"fact {number}" for number in (7, 3, 9, 1, 5, 8, 2)]
    with closing(Store.create(tmp_path / "run", {})) as store, store.step():
        for key in ("command", *keys, "recorded to"):
            store.fact(key, "said")
    with closing(sqlite3.connect(tmp_path / "run" / DATABASE)) as db:
        said = [
            json.loads(covers).get("facts", {})
            for (covers,) in db.execute("SELECT covers FROM chain ORDER BY number")
        ]
    assert [
        key for link in said for key in link if key in keys or not key.startswith("fact")
    ] == keys


@pytest.mark.parametrize("name", ["n" * 250, "ü" * 125])
def test_a_run_of_a_script_with_a_long_name_can_be_kept(tmp_path: Path, name: str) -> None:
    folder = new_run_folder(tmp_path, name, datetime(2026, 1, 2, tzinfo=UTC))
    Store.create(folder, {}).close()
    assert folder.is_dir()
    assert name.startswith(folder.name.removeprefix("20260102-000000-"))
