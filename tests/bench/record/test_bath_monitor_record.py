"""The record is written by two threads, the watch's and the engine's, and interrupted at any
moment.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from bench.record.check import check_run
from bench.record.reader import read_run
from bench.record.writer import Store
from instruments.clock import wall_time
from tests.bench.record.test_record import facts, trial

READINGS, TRIALS = 2000, 15


def test_readings_and_trials_from_two_threads_are_all_there(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "run", {})
    facts(store)

    def watch() -> None:
        for t in range(READINGS):
            store.bath(
                {
                    "t_s": 1000.0 + t,
                    "temp_c": 33.0,
                    "external_c": 32.7,
                    "power_percent": 2.0,
                    "state": "stable",
                }
            )
            if t % 50 == 0:
                store.event(float(t), "trip", "from the clock's thread", wall_time())

    thread = threading.Thread(target=watch)
    thread.start()
    for number in range(1, TRIALS + 1):
        store.finished(trial(store, number))
    thread.join()
    store.close()
    run = read_run(tmp_path / "run")
    assert len(run.trials) == TRIALS
    assert len(run.bath) == READINGS + TRIALS
    assert len(run.events) == READINGS / 50
    assert run.external_c[-1] == 32.7


def test_an_interruption_between_any_two_lines_leaves_a_record_that_can_be_finished(
    tmp_path: Path,
) -> None:
    """Ctrl-C may come after each line of the store's own code; what is written afterwards must not
    fail, and nothing be there twice.
    """
    store = Store.create(tmp_path / "run", {})
    facts(store)
    for line in range(1, 200):
        store.bath(
            {
                "t_s": float(line),
                "temp_c": 33.0,
                "external_c": None,
                "power_percent": 2.0,
                "state": "stable",
            }
        )
        came = interrupted_at(line, store)
        store.event(float(line), "aborted", "Ctrl-C", wall_time())
        if not came:
            break
    else:
        raise AssertionError("the event takes more lines than this test interrupts")
    store.close()
    run = read_run(tmp_path / "run")
    assert [event["t_s"] for event in run.events if event["kind"] == "aborted"] == list(
        range(1, line + 1)
    )
    assert run.bath[:, 0].tolist() == list(range(1, line + 1))
    assert check_run(tmp_path / "run").findings == ()


def interrupted_at(line: int, store: Store) -> bool:
    """Write an event and interrupt it after ``line`` lines of `bench.record`, any of its modules;
    whether it was long enough for that.
    """
    count = 0

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal count
        if "record" not in Path(frame.f_code.co_filename).parts:
            return None
        count += event == "line"
        if event == "line" and count == line:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        store.event(None, "state", "interrupted", wall_time())
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_a_guardian_record_that_is_no_record_is_named(tmp_path: Path) -> None:
    from bench.config import ConfigError

    store = Store.create(tmp_path / "run", {})
    facts(store)
    store.close()
    (tmp_path / "run" / "guardian.json").write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"guardian.json can't be read"):
        read_run(tmp_path / "run")
