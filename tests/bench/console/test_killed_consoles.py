"""A console may die at any moment: the run goes on, and what it acknowledged is an answer. And no
detection is shown before the trial's truth is stored.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import socket
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

from bench.record.reader import read_run
from bench.record.schema import Row
from bench.run.events import EVENTS_FILE
from instruments.operators.mailbox import read_answer
from tests.bench.console import served
from tests.bench.operated_runs import SCRIPT
from tests.bench.small_run import KEPT

KILLS = int(os.environ.get("TEATBENCH_KILLS", "3"))  # 50 by hand
Floats = NDArray[np.float64]
# ends that a detector gave, in any answer: only those of trials that have their truth
SEEN = ("found", "detections", "covariance")


@pytest.mark.slow
def test_killed_consoles_change_nothing_and_lose_no_answer(tmp_path: Path) -> None:
    whole, _ = answered(tmp_path / "undisturbed", 0)
    folder, acknowledged = answered(tmp_path / "killed", KILLS)
    (said, places), (of_whole, of_whole_mm) = contents(folder), contents(whole)
    assert said == of_whole
    # an emulated hand trembles in real time
    np.testing.assert_allclose(places, of_whole_mm, atol=0.5)
    record = read_run(folder)
    assert record.ending == "finished"
    # each end touched once, none twice, none left out
    assert [[row["teat"] for row in trial.touches] for trial in record.trials] == [list("1234")] * 3
    given = {number: read_answer(folder, number) for number in acknowledged}
    assert {number: one.by for number, one in given.items() if one} == acknowledged
    # homing, three set-ups, twelve touches; those that were not acknowledged were answered too
    assert max(acknowledged) == 16


def answered(here: Path, kills: int) -> tuple[Path, dict[int, str]]:
    """A run answered by consoles of which many are killed; what was acknowledged, by prompt."""
    here.mkdir()
    chance, left, acknowledged = random.Random(20261123), kills, dict[int, str]()
    script = SCRIPT.replace('["thesis"]', '["fused"]')
    with served.operated_run(here, script=script) as (process, folder):
        one = served.serve(here / "runs", here)
        try:
            at = f"/runs/{folder.name}"
            while process.poll() is None:
                try:
                    snapshot = one.ask(at).body
                    nothing_before_its_truth(one, at, folder)
                    prompt = snapshot["prompt"]
                    if prompt and prompt["number"] not in acknowledged:
                        if left and chance.random() < 0.8:
                            left -= 1
                            one.process.kill()  # while it may be answering
                        words = {"words": "go", "name": "the test"}
                        reply = one.ask(f"{at}/answers/{prompt['number']}", words)
                        assert reply.status in (200, 409), reply
                        if reply.status == 200:
                            acknowledged[prompt["number"]] = reply.body["taken"]["by"]
                except OSError:
                    served.end(one)
                    one = served.serve(here / "runs", here)
                time.sleep(0.1)  # each look costs the console some of a processor
        finally:
            served.end(one)
    assert (process.returncode, left) == (0, 0)
    return folder, acknowledged


EXACT = (
    *("id", "number", "name", "situation", "repeat", "invalid", "trial", "teat", "touch"),
    *("packets", "refused", "visible", "exact_mm", "how", "detector"),
)


def contents(folder: Path) -> tuple[list[Row], Floats]:
    """What a run's record says but for its times: trials, touches and truths in their order, and
    what was found from left to right, as a detector lists the surest end first and a trembling
    hand moves which that is; and where all of it is, mm.
    """
    rows: list[Row] = []
    for trial in read_run(folder).trials:
        found = sorted(trial.found, key=lambda row: row["x_mm"])
        rows += [trial.head, *trial.touches, *trial.truth]
        rows += [{**row, "number": number} for number, row in enumerate(found)]
    places = [[row[f"{axis}_mm"] for axis in "xyz"] for row in rows if "x_mm" in row]
    return [{key: row[key] for key in EXACT if key in row} for row in rows], np.array(places)


def nothing_before_its_truth(one: served.Served, at: str, folder: Path) -> None:
    """What is shown of trials has a truth for each teat; a snapshot has no detection at all."""
    for trial in one.ask(f"{at}/trials").body["trials"]:
        of = [mark["of"] for mark in trial["marks"]]
        assert of.count("truth") == 4
    snapshot = one.ask(at).body
    snapshot.pop("run")
    text = json.dumps(snapshot)
    assert not [word for word in SEEN if f'"{word}"' in text]


@pytest.mark.slow
def test_a_watcher_that_stops_reading_costs_bounded_memory_and_delays_no_one(
    tmp_path: Path,
) -> None:
    folder = Path(shutil.copytree(KEPT, tmp_path / "runs" / "kept"))
    with served.console(tmp_path / "runs", tmp_path) as one:
        path, port = f"/api/runs/{folder.name}/stream", one.port
        request = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
        request += f"Authorization: Bearer {one.token}\r\nLast-Event-ID: 0\r\n\r\n"
        with socket.create_connection(("127.0.0.1", port)) as stuck:
            stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stuck.sendall(request.encode())
            assert stuck.recv(100)
            assert one.ask(f"/runs/{folder.name}", client="two").body  # loads what judges a run
            before = psutil.Process(one.process.pid).memory_info().rss
            line = {"what": "event", "kind": "note", "text": "x" * 900, "wall_time": "", "t_s": 0.0}
            with (folder / EVENTS_FILE).open("ab") as file:
                for number in range(1_000_000, 1_060_000):  # 60 MB
                    file.write(json.dumps({"number": number, **line}).encode() + b"\n")
            assert one.ask(f"/runs/{folder.name}", client="two").body["number"] == 1_059_999
            time.sleep(2.0)  # what it could take in meanwhile
            assert psutil.Process(one.process.pid).memory_info().rss - before < 20_000 * 1024
