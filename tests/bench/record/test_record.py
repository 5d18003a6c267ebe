"""The run folder: whole trials or none; when what is durable, what a failed write leaves, and what
physical actions find in the record of a run.
"""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
import pytest

from bench.config import ConfigError
from bench.files import png_bytes, write_pictures, write_synced
from bench.record.check import check_record
from bench.record.reader import TrialRecord, read_run
from bench.record.schema import DATABASE
from bench.record.writer import FLUSH_EVERY, URGENT, Store, new_run_folder
from bench.run.events import RunState
from instruments.bath.driver import OwnBath
from instruments.clock import wall_time
from instruments.operators.emulated import EmulatedOperator
from instruments.stage.driver import OwnStage
from tests.bench.killed_runs import start
from tests.bench.operated_runs import CHECK_POINT, STAGE, files
from tests.conftest import ROOT


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


@pytest.mark.slow
def test_sixteen_runs_of_one_second_get_sixteen_folders(tmp_path: Path) -> None:
    now, start = wall_time(), threading.Barrier(16)
    made: list[Path] = []

    def begin(number: int) -> None:
        start.wait()
        with closing(Store.create_next(tmp_path / "runs", "six", now, {"n": str(number)})) as store:
            made.append(store.folder)

    threads = [threading.Thread(target=begin, args=(number,)) for number in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(made)) == 16
    assert not any(":" in path.name for path in made)
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {path.name for path in made}
    assert {(path / "n").read_text(encoding="utf-8") for path in made} == set(map(str, range(16)))


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


@pytest.fixture
def store(tmp_path: Path) -> Any:
    made = Store.create(tmp_path / "run", {"script.toml": "x = 1"})
    facts(made)
    yield made
    made.close()


def durable(store: Store, table: str = "events") -> int:
    """Rows that another process would see now."""
    with closing(sqlite3.connect(store.folder / DATABASE)) as db:
        return int(db.execute(f"SELECT count(*) FROM {table}").fetchone()[0])


def say(store: Store, kind: str = "state") -> None:
    store.event(1.0, kind, "something", wall_time())


def test_an_event_is_durable_when_it_returns_and_in_a_step_when_that_ends(store: Store) -> None:
    say(store)
    assert durable(store) == 1
    with store.step():
        say(store)
        store.fact("camera faults", {"left": 1})
        with store.step():
            say(store)
        assert durable(store) == 1, "an inner step doesn't end the outer one"
    assert durable(store) == 3
    with suppress(ZeroDivisionError), store.step():
        say(store)
        raise ZeroDivisionError
    assert durable(store) == 4, "a step that fails is a step that ended"


@pytest.mark.parametrize("kind", sorted(URGENT))
def test_what_is_urgent_waits_for_no_step(store: Store, kind: str) -> None:
    with store.step():
        say(store)
        say(store, kind)
        assert durable(store) == 2


def test_no_step_holds_back_more_than_so_many_rows(store: Store) -> None:
    with store.step():
        for _ in range(FLUSH_EVERY):
            say(store)
        assert durable(store) == FLUSH_EVERY


def test_bath_readings_become_durable_with_whatever_comes_next(store: Store) -> None:
    store.bath({"t_s": 1.0, **READING})
    assert durable(store, "bath") == 0
    say(store)
    store.bath({"t_s": 2.0, **READING})
    store.finished(trial(store, 3))
    assert durable(store, "bath") == 3


def test_a_trial_that_cannot_be_written_takes_nothing_with_it(store: Store) -> None:
    good = trial(store, 1)
    orphan = [{"trial": "other", "detector": "x", "number": 1}]
    with pytest.raises(sqlite3.IntegrityError):
        store.finished(replace(good, found=orphan))
    assert (durable(store, "bath"), durable(store, "trials")) == (1, 0)
    store.finished(good)
    assert (durable(store, "bath"), durable(store, "trials")) == (1, 1)
    store.close()
    assert check_record(store.folder).whole


def test_a_wrong_row_that_waited_does_not_hold_up_the_runs_end(store: Store) -> None:
    for _ in range(2):
        store.bath({"t_s": 1.0, **READING})  # the same moment twice
    with pytest.raises(sqlite3.IntegrityError):
        say(store)
    say(store, "end")
    assert (durable(store, "bath"), durable(store)) == (0, 1)


def test_what_waits_goes_on_waiting_while_the_disk_is_full(store: Store) -> None:
    store.bath({"t_s": 1.0, **READING})
    (pages,) = store._db.execute("PRAGMA page_count").fetchone()
    store._db.execute(f"PRAGMA max_page_count = {pages}")
    step = store.step()
    step.__enter__()
    for _ in range(FLUSH_EVERY - 2):
        store.event(1.0, "state", "x" * 10_000, wall_time())
    with pytest.raises(sqlite3.OperationalError, match="full"):
        step.__exit__(None, None, None)
    assert durable(store, "bath") == 0
    store._db.execute("PRAGMA max_page_count = 1000000")
    say(store, "end")
    assert (durable(store, "bath"), durable(store)) == (1, FLUSH_EVERY - 1)
    store.close()
    assert check_record(store.folder).whole


def test_a_file_is_synced_then_renamed_then_its_folder_is_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def synced(handle: int) -> None:
        done.append("sync " + Path(f"/proc/self/fd/{handle}").readlink().name)
        fsync(handle)

    def renamed(path: Path, target: Path) -> Path:
        done.append(f"rename {path.name} to {target.name}")
        return replace(path, target)

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("needs /proc to tell which file is synced")
    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    write_synced(tmp_path / "new" / "a.bin", b"a")
    assert done == [
        f"sync {tmp_path.name}",
        "sync a.bin.part",
        "rename a.bin.part to a.bin",
        "sync new",
    ]


def test_frames_are_on_the_disk_before_the_row_that_names_them(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    fsync = os.fsync

    def synced(handle: int) -> None:
        seen.append(durable(store, "frames"))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", synced)
    done = trial(store, 1)
    # the frame, its folder, and the folder that holds that; Windows syncs no folder
    assert len(seen) >= (1 if sys.platform == "win32" else 3)
    assert set(seen) == {0}
    store.finished(done)
    assert durable(store, "frames") == 1


def test_a_run_folder_is_there_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out" / "run"

    def died(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "rename", died)
    with pytest.raises(KeyboardInterrupt):
        Store.create(folder, {"script.toml": "x = 1"})
    assert not folder.exists()
    monkeypatch.undo()
    Store.create(folder, {"script.toml": "x = 1"}).close()
    with pytest.raises(FileExistsError):
        Store.create(folder, {})
    assert (folder / "script.toml").read_text(encoding="utf-8") == "x = 1"


def test_each_opening_is_a_session_with_a_clock_of_its_own(store: Store) -> None:
    store.bath({"t_s": 1.0, **READING})
    store.close()
    again = Store(store.folder)
    again.bath({"t_s": 1.0, **READING})
    again.bath({"t_s": 2.0, **READING})
    again.close()
    assert (store.session, again.session) == (1, 2)
    assert read_run(store.folder).bath[:, 0].tolist() == [1.0, 1.0, 2.0]


def test_pictures_of_a_trial_that_died_in_flight_do_not_stay_beside_those_of_its_repetition(
    store: Store,
) -> None:
    store.frames(
        "001-x-1",
        {"left": np.zeros((4, 5), np.uint8), "thesis-edges": np.zeros((4, 5), np.uint8)},
        {},
    )
    store.finished(trial(store, 2))
    store.close()
    again = Store(store.folder)
    again.finished(trial(again, 1))
    again.close()
    assert check_record(store.folder).findings == ()
    assert sorted(path.parent.name for path in store.folder.rglob("*.png")) == [
        "001-x-1",
        "002-x-1",
    ]


def test_a_write_protected_run_is_read_unless_its_log_would_be_missed(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There SQLite can't make the index of its log, and says so."""
    store.finished(trial(store, 1))
    store.close()
    connect: Any = sqlite3.connect

    def protected(address: str, **more: Any) -> Any:
        return connect(
            address if "immutable=1" in address else "file:/nowhere/run.sqlite?mode=ro", **more
        )

    monkeypatch.setattr(sqlite3, "connect", protected)
    assert len(read_run(store.folder).trials) == 1
    (store.folder / f"{DATABASE}-wal").write_bytes(b"something")
    with pytest.raises(ConfigError, match="can't be read: unable to open"):
        read_run(store.folder)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (120, 160)])
def test_pictures_come_back_as_they_were(
    tmp_path: Path, dtype: type[np.uint8 | np.uint16], shape: tuple[int, int]
) -> None:
    image = np.random.default_rng(4).integers(
        0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True
    )
    paths = {tmp_path / f"{k}.png": np.roll(image, k) for k in range(9)}
    assert list(write_pictures(paths)) == list(paths)
    for path, written in paths.items():
        read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert read is not None
        assert read.dtype == dtype
        assert np.array_equal(read, written)


def test_a_picture_that_is_none_is_named() -> None:
    with pytest.raises((ValueError, cv2.error)):
        png_bytes(np.zeros((0, 0), np.uint16))


READINGS, TRIALS = 2000, 15


def test_readings_and_trials_from_two_threads_are_all_there(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "run", {})
    facts(store)

    def watch() -> None:
        for t in range(READINGS):
            store.bath({**READING, "t_s": 1000.0 + t, "external_c": 32.7})
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


@pytest.mark.slow
def test_an_interruption_between_any_two_lines_leaves_a_record_that_can_be_finished(
    tmp_path: Path,
) -> None:
    """Ctrl-C may come after each line of the store's own code; what is written afterwards must not
    fail, and nothing be there twice.
    """
    store = Store.create(tmp_path / "run", {})
    facts(store)
    for line in range(1, 200):
        store.bath({"t_s": float(line), **READING})
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
    assert check_record(tmp_path / "run").findings == ()


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


ACTIONS: tuple[tuple[type, str], ...] = (
    (OwnStage, "home"),
    (OwnStage, "move_to"),
    (OwnStage, "stop"),
    (OwnBath, "start"),
    (OwnBath, "standby"),
    (OwnBath, "safe"),
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


@pytest.mark.slow
def test_all_that_was_said_is_durable_before_the_next_physical_action(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files(tmp_path, stage=STAGE, check_point=CHECK_POINT)
    spoken = Spoken(monkeypatch)
    assert start(tmp_path)[1] is RunState.FINISHED
    assert spoken.said["trials"] == 3
    assert {
        "OwnStage.home",
        "OwnStage.move_to",
        "OwnBath.start",
        "OwnBath.safe",
        "EmulatedOperator._set_up",
        "EmulatedOperator._touch",
    } <= set(spoken.looked)
    assert spoken.looked["OwnStage.move_to"] >= 3


HEAPS = """
import ctypes, sys, threading
from pathlib import Path
from bench.record.writer import Store
folder, heaps = Path(sys.argv[1]), Path(sys.argv[2])
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.fopen.restype = ctypes.c_void_p, ctypes.c_void_p
together = threading.Barrier(4)
def draw():
    together.wait()
    libc.malloc(10_000)
    together.wait()
if len(sys.argv) == 3:
    Store.create(folder, {}).close()
threads = [threading.Thread(target=draw) for _ in range(4)]
for each in threads:
    each.start()
for each in threads:
    each.join()
file = ctypes.c_void_p(libc.fopen(bytes(heaps), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "confstr"), reason="heaps are of glibc")
def test_threads_of_a_run_share_its_heap(tmp_path: Path) -> None:
    if "CS_GNU_LIBC_VERSION" not in os.confstr_names:
        pytest.skip("heaps are of glibc")
    program, heaps = [sys.executable, "-c", HEAPS, str(tmp_path / "run")], tmp_path / "heaps.xml"
    counts = []
    for more in ([], ["without a run"]):
        subprocess.run([*program, str(heaps), *more], check=True, cwd=ROOT)
        counts.append(heaps.read_text("utf-8").count("<heap nr="))
    assert counts[0] == 1 < counts[1]
