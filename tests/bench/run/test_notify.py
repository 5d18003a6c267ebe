"""Word to a phone: to a server of our own by apprise, seldom, and never in a run's way."""

from __future__ import annotations

import json
import queue
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from traceback import walk_stack
from typing import Any

import pytest

import bench
from bench.cli.main import main
from bench.record.reader import read_run
from bench.record.state import State
from bench.results.status import InstrumentStatus, LinkState, OpenPrompt, RunStatus, Safe
from bench.run.events import ENDED, NOT_SAFE, PROMPTED, TRIPPED, read_events
from bench.run.notify import Notifier, notifying, text_of, without_secrets
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.small_run import SCRIPT

NOWHERE = "json://user:secret@127.0.0.1:1"
SOON_S = 60.0
BATH = InstrumentStatus(
    "bath",
    LinkState.SILENT,
    Safe.FAILED,
    how="no answer",
    by_hand="SWITCH OFF THE BATH AT ITS MAINS",
)
STATUS = RunStatus(
    "20261122-short",
    "Short",
    State.RUNNING,
    "running",
    planned=3,
    verdicts={"fused": "met"},
    asked=OpenPrompt("touch", "Touch teat LF"),
    tripped="interlock level",
    instruments=(BATH,),
    why="Because.",
    next=("Do this.",),
)


@contextmanager
def phone() -> Iterator[tuple[str, queue.Queue[dict[str, Any]]]]:
    """An address, and what comes there."""
    came: queue.Queue[dict[str, Any]] = queue.Queue()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            came.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield f"json://127.0.0.1:{server.server_port}", came
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(scope="module", autouse=True)
def pool() -> None:
    """apprise keeps a thread for its look-ups: it is there before a test counts threads."""
    with phone() as (url, _):
        notifier = Notifier([url], pytest.fail)
        notifier.send(ENDED, lambda: ("", "."))
        notifier.close()


@pytest.mark.parametrize(
    ("kind", "status", "title", "lines"),
    [
        (PROMPTED, STATUS, "Short: asked", ["Touch teat LF", "running: trial 1 of 3"]),
        (PROMPTED, replace(STATUS, asked=None), None, []),
        (PROMPTED, None, None, []),
        (
            TRIPPED,
            replace(STATUS, title=" Short\nBcc: x", rig="south\n bench"),
            "Short Bcc: x (south bench): tripped",
            ["interlock level", f"{BATH.by_hand}: no answer"],
        ),
        (TRIPPED, STATUS, "Short: tripped", ["interlock level", f"{BATH.by_hand}: no answer"]),
        (NOT_SAFE, STATUS, "Short: not safe", [f"{BATH.by_hand}: no answer"]),
        (
            ENDED,
            replace(STATUS, state=State.FINISHED, done=3),
            "Short: ended",
            ["met: 3 of 3 trials", "fused: met", "Because.", "Do this."],
        ),
    ],
)
def test_each_kind_says_the_runs_status(
    kind: str, status: RunStatus | None, title: str | None, lines: list[str]
) -> None:
    found = text_of(kind, status)
    assert found == (None if title is None else (title, "\n".join(lines)))


@pytest.mark.slow
def test_one_of_a_kind_at_a_time_and_a_dead_address_is_said_once() -> None:
    warned: list[str] = []
    with phone() as (url, came):
        notifier = Notifier([NOWHERE, url], warned.append, every_s=0.5)
        notifier.send(PROMPTED, lambda: ("asked", "first"))
        assert came.get(timeout=SOON_S)["message"] == "first"
        for text in ("second", "third"):  # one takes the other's place
            notifier.send(PROMPTED, lambda text=text: ("asked", text))  # type: ignore[misc]
        notifier.send(TRIPPED, lambda: ("tripped", "at once"))
        assert [came.get(timeout=SOON_S)["message"] for _ in range(2)] == ["at once", "third"]
        notifier.send(PROMPTED, lambda: None)  # answered meanwhile
        notifier.send(NOT_SAFE, lambda: 1 / 0)  # type: ignore[return-value,arg-type]
        notifier.send(ENDED, lambda: ("ended", "last"))
        notifier.close()
        assert came.get(timeout=SOON_S)["message"] == "last"
        assert came.empty()
    (said,) = warned
    assert said == "no message can be sent to json://user:****@127.0.0.1:1/"
    assert "secret" not in said


def test_a_prompt_that_was_answered_at_once_delays_no_other_s_word() -> None:
    looked = threading.Event()
    with phone() as (url, came):
        notifier = Notifier([url], pytest.fail)
        notifier.send(PROMPTED, lambda: looked.set())
        assert looked.wait(SOON_S)
        notifier.send(PROMPTED, lambda: ("asked", "touch"))
        assert came.get(timeout=SOON_S)["message"] == "touch"
        notifier.close()


def test_an_address_that_never_ends_its_answer_is_left_to_who_ends_the_command() -> None:
    """Of apprise's threads those of a daemon are daemons, for which Python waits without end."""
    asked, over = threading.Event(), threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.set()
            over.wait(SOON_S)

    with HTTPServer(("127.0.0.1", 0), Slow) as server:
        serving = threading.Thread(target=server.handle_request)
        serving.start()
        notifier = Notifier([f"json://127.0.0.1:{server.server_port}"], lambda _: None)
        notifier.send(ENDED, lambda: ("ended", "last"))
        assert asked.wait(SOON_S)
        at_work = {
            thread
            for thread, top in sys._current_frames().items()
            if any("apprise" in frame.f_code.co_filename for frame, _ in walk_stack(top))
        }
        waiting = [one for one in threading.enumerate() if one.ident in at_work]
        over.set()
        notifier.close()
        serving.join()
    assert "messages" in {one.name for one in waiting}
    assert len(waiting) > 1, "it sends in a thread of its own"
    assert not any(one.daemon for one in waiting)


def test_nothing_is_loaded_without_an_address_and_a_wrong_one_is_refused() -> None:
    with notifying([], pytest.fail) as word:
        word(ENDED, pytest.fail)
    assert main(["run", "--notify", "nonsense://x"]) == 2


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["run", "--notify", "ntfy://a/b", "x"], ["run", "--notify", "…", "x"]),
        (["run", "--notify=ntfy://a/b"], ["run", "--notify=…"]),
        (["run", "--noti", "ntfy://a/b"], ["run", "--noti", "…"]),
        (["run", "--no-open", "x"], ["run", "--no-open", "x"]),
    ],
)
def test_a_record_has_no_secret(given: list[str], kept: list[str]) -> None:
    assert without_secrets(given) == kept


@pytest.mark.slow
def test_a_run_says_how_it_ended_whatever_an_address_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.toml").write_text(SCRIPT.replace("fused", "thesis"), encoding="utf-8")
    rig, out = write_small_rig(tmp_path), tmp_path / "runs"
    with phone() as (url, came):
        monkeypatch.setenv("TEATBENCH_PHONE", url)
        table = f'\n[notify]\nurls = ["$TEATBENCH_PHONE", "{NOWHERE}"]\n'
        rig.write_text(rig.read_text(encoding="utf-8") + table, encoding="utf-8")
        assert main(["run", str(tmp_path / "a.toml"), "--rig", str(rig), "--out", str(out)]) == 4
        (ended,) = came.queue
    assert ended["title"] == "Short (emulated rig): ended"
    assert ended["message"].startswith("inconclusive: 2 of 2 trials\nthesis: inconclusive\n")
    assert "no message can be sent to" in "".join(capsys.readouterr())
    (folder,) = out.glob("*/run.sqlite")
    assert read_run(folder.parent).ending == "finished"
    assert url not in (folder.parent / "rig.toml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_run_of_a_program_sends_word_and_writes_events_as_a_command_s(tmp_path: Path) -> None:
    """To whom its rig file names."""
    (tmp_path / "a.toml").write_text(SCRIPT.replace("fused", "thesis"), encoding="utf-8")
    rig, lines = write_small_rig(tmp_path), tmp_path / "events"
    with phone() as (url, came):
        table = f'\n[notify]\nurls = ["{url}"]\n'
        rig.write_text(rig.read_text(encoding="utf-8") + table, encoding="utf-8")
        found = bench.run_script(tmp_path / "a.toml", rig, out=tmp_path / "runs", events=lines)
        (ended,) = came.queue
    assert ended["title"] == "Short (emulated rig): ended"
    written = list(read_events(found.folder))
    own = [json.loads(line) for line in lines.read_bytes().splitlines()]
    assert [one for one in own if one["what"] == "trial"] == [
        one for one in written if one["what"] == "trial"
    ]
    assert own[-1]["text"] == "writing the report"


@pytest.mark.slow
def test_the_last_word_of_a_queue_names_each_run(tmp_path: Path) -> None:
    scripts = [tmp_path / name for name in ("a.toml", "b.toml")]
    for script in scripts:
        script.write_text(SCRIPT.replace("fused", "thesis"), encoding="utf-8")
    how = ["--rig", str(write_small_rig(tmp_path)), "--out", str(tmp_path / "runs")]
    with phone() as (url, came):
        assert main(["run", *map(str, scripts), *how, "--notify", url]) == 4
        (ended,) = came.queue
    assert ended["title"] == "Queue (emulated rig): ended"
    queue, *runs = ended["message"].split("\n\n")
    assert queue == "Queue: ended: 2 of 2 scripts finished"
    for text, script in zip(runs, scripts, strict=True):
        assert f"-{script.stem}: inconclusive: 2 of 2 trials\n" in text
