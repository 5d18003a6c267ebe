"""How soon the console's page knows what happened, and how soon an abort from it has the emulated
bath in standby.
"""

from __future__ import annotations

import http.client
import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.record.reader import read_run
from bench.run.events import EVENTS_FILE
from instruments.operators.mailbox import read_prompt
from tests.bench.console import served
from tests.bench.operated_runs import texts
from tests.bench.small_run import write_small_run
from tests.benchmarks.figures import figure

WATCHERS, EVENTS, EVERY_S = 5, 100, 0.1
ABORTS = 10


def watch(one: served.Served, run: str, began: threading.Barrier, late_s: list[float]) -> None:
    """Follows a run as the page does, and notes how old each event is when it comes."""
    connection = http.client.HTTPConnection("127.0.0.1", one.port, timeout=served.SOON_S)
    headers = {"Authorization": f"Bearer {one.token}", "Last-Event-ID": "999999"}
    connection.request("GET", f"/api/runs/{run}/stream", headers=headers)
    stream = connection.getresponse()
    stream.readline()  # the snapshot comes
    began.wait()
    seen = 0
    while seen < EVENTS:
        line = stream.readline()
        if line.startswith(b"data: ") and b'"written_s"' in line:
            late_s.append(time.monotonic() - json.loads(line[6:])["written_s"])
            seen += 1
    connection.close()


def test_event_to_page_with_five_watchers(tmp_path: Path, benchmark: BenchmarkFixture) -> None:
    folder = write_small_run(tmp_path)
    late_s: list[float] = []
    with served.console(tmp_path / "runs", tmp_path) as one:
        began = threading.Barrier(WATCHERS + 1)
        watchers = [
            threading.Thread(target=watch, args=(one, folder.name, began, late_s))
            for _ in range(WATCHERS)
        ]
        for watcher in watchers:
            watcher.start()
        began.wait()

        def write() -> None:
            for number in range(1_000_000, 1_000_000 + EVENTS):
                time.sleep(EVERY_S)
                event = {"number": number, "what": "note", "written_s": time.monotonic()}
                with (folder / EVENTS_FILE).open("ab") as file:
                    file.write(json.dumps(event).encode() + b"\n")

        benchmark.pedantic(write, rounds=1)
        for watcher in watchers:
            watcher.join()
    assert len(late_s) == WATCHERS * EVENTS
    p95_ms = 1000.0 * float(np.percentile(late_s, 95))
    figure(benchmark, "event to page, p95 of 5 watchers at 10 Hz, ms", p95_ms, "under 250")


def abort(folder: Path, prompts: int) -> float:
    """Seconds from an abort at prompt ``prompts`` (from 1) to the bath in standby."""
    folder.mkdir()
    with (
        served.operated_run(folder) as (process, run),
        served.console(folder / "runs", folder) as one,
    ):

        def at(number: int) -> bool:
            prompt = read_prompt(run)
            return bool(prompt and prompt["open"] and prompt["number"] == number)

        for number in range(1, prompts + 1):
            served.eventually(lambda number=number: at(number), process)
            if number < prompts:
                given = {"words": "go", "name": "the test"}
                one.ask(f"/runs/{run.name}/answers/{number}", given)
        clicked_s = time.time()
        assert one.ask(f"/runs/{run.name}/control", {"words": "abort"}).status == 200
        process.wait()
    record = read_run(run)
    assert "bath is safe" in texts(record, "safe")
    lines = (run / EVENTS_FILE).read_text(encoding="utf-8").splitlines()
    safe = next(event for event in map(json.loads, lines) if event.get("text") == "bath is safe")
    return float(np.datetime64(safe["wall_time"][:23], "ms").astype(float) / 1000.0) - clicked_s


@pytest.mark.slow
def test_abort_to_standby(tmp_path: Path, benchmark: BenchmarkFixture) -> None:
    """At a set-up and at touches by turns."""
    took_s: list[float] = []

    def all_of_them() -> None:
        took_s.extend(abort(tmp_path / str(n), 2 + n % 3) for n in range(ABORTS))

    benchmark.pedantic(all_of_them, rounds=1)
    p95_s = float(np.percentile(took_s, 95))
    figure(benchmark, f"abort to standby, p95 of {ABORTS}, s", p95_s, "under 1.5")
