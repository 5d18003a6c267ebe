"""The table of kills: each instrument killed, hung and returning, in each state of a run. At every
moment each surface says the same of the run, and nothing that the wire contradicts.
"""

from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from bench.cli.terminal import Terminal
from bench.cli.verdict import show_verdict
from bench.console import watching
from bench.record.reader import read_run
from bench.report import summary
from bench.report.page import write_run_report
from bench.report.runs import list_runs, write_queue_page
from bench.results.queue import QueueNote, queues
from bench.results.status import GOING_TO_SAFE, RunStatus, Safe, live_status, read_status
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.model import EmulatedFault
from bench.run.events import ENDED, PROMPTED, TRIPPED, Events
from bench.run.interruptions import PREPARING_S
from bench.run.live import Live
from bench.run.notify import text_of
from bench.run.start import RunOptions
from bench.safety.bath_monitor import LATE_S, PERIOD_S
from instruments.listener import Connection, Listener
from tests.bench.fault_catalogue import STATES, Bringer, known_to
from tests.bench.killed_runs import start
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files

INSTRUMENTS = ("arm", "bath", "stage", "cameras")
# what hangs each; a killed one's cable is out (the cameras' frames are dropped), and one that
# returns does so before an interlock or the rig's patience ends the run
HUNG = {"arm": "silent", "bath": "silence", "stage": "silent", "cameras": "late"}
BACK_S = {"arm": 12.0, "bath": 3.0, "stage": 12.0, "cameras": 12.0}
WAYS = ("killed", "hung", "returning")
HEATS_OR_MOVES = ("bath", "stage")
SEVERAL = 15  # of the samples one is compared on the surfaces that read the record, too
LIMITS = "\n[limits]\naway_s = 40.0\n"
# until a poll has had its answer: what is asked for when the instrument goes is its last word
AFTER_S = 0.5
SEND = Connection.send


@dataclass
class Watch(Bringer):
    """Brings the kill about, and holds each thing that is published against the wire."""

    instrument: str
    way: str
    at: str
    samples: list[RunStatus] = field(default_factory=list)
    line: str = ""
    dead_s: float = float("inf")
    sent_s: dict[str, float] = field(default_factory=dict)
    rig: EmulatedRig | None = None
    queue: QueueNote | None = None
    failed: list[Exception] = field(default_factory=list)

    def __post_init__(self) -> None:
        name = "dropped" if self.cable == "cameras" else HUNG[self.instrument]
        back_s = BACK_S[self.instrument] if self.way == "returning" else None
        fault = {"instrument": self.instrument, "name": name, "for_s": back_s}
        super().__init__(self.at, EmulatedFault.model_validate(fault))

    def state(self, text: str) -> None:
        self.line = text

    def bring(self) -> None:
        if self.twin is None:
            return
        self.rig, self.dead_s = self.twin, self.twin._clock.now()
        if self.cable in self.twin.listeners:
            self.twin.listeners[self.cable].close()
            self.twin = None
        else:
            super().bring()

    @property
    def cable(self) -> str:
        """Whose comes out."""
        return self.instrument if self.way == "killed" else ""

    def sent(self, connection: Connection, data: bytes) -> None:
        """An emulator sends something: noted before the bench can have it."""
        rig = self.rig or self.twin
        for name, listener in rig.listeners.items() if rig else ():
            if isinstance(listener, Listener) and connection in listener._connections:
                self.sent_s[name] = connection._clock.now()
        SEND(connection, data)

    @property
    def now_s(self) -> float:
        assert self.rig
        return self.rig._clock.now()

    @property
    def dead(self) -> bool:
        back_s = BACK_S[self.instrument] if self.way == "returning" else float("inf")
        return self.dead_s + AFTER_S <= self.now_s < self.dead_s + back_s

    def wants(self, status: RunStatus) -> bool:
        """Whether this status is written down for other programs."""
        return True

    def looks(self, folder: Path, status: RunStatus) -> None:
        """`published`; the bench lets no error of a viewer through, so they are kept."""
        try:
            self.published(folder, status)
        except Exception as error:
            self.failed.append(error)

    def check(self) -> None:
        """Raise what was wrong first."""
        for error in self.failed:
            raise error

    def published(self, folder: Path, status: RunStatus) -> None:
        """A moment of the run."""
        self.samples.append(status)
        if self.rig is None:
            return
        self.against_the_wire(status)
        shown = live_status(folder)
        assert shown is not None
        assert same(watching.status(folder)) == same(shown.as_dict())
        for kind, words in ((PROMPTED, status.asked), (TRIPPED, status.tripped)):
            sent = text_of(kind, status) if words or kind == PROMPTED else None
            assert bool(sent) == bool(words)
            assert not sent or sent[0] == f"{status.title} ({status.rig}): {kind}"
        if len(self.samples) % SEVERAL == 0:
            assert same(read_status(folder).as_dict()) == same(status.as_dict())
            self.queue = self.queue or queue_of(folder)
            (queue,) = queues(folder.parent)
            shown = queue.scripts[0].status
            assert shown
            assert queue.under_way
            assert same(shown.as_dict()) == same(status.as_dict())

    def against_the_wire(self, status: RunStatus) -> None:
        assert self.rig
        by_name = {one.name: one for one in status.instruments}
        one, since_s = by_name[self.instrument], self.now_s - self.dead_s
        for name, sent_s in self.sent_s.items():
            age_s = by_name[name].age_s
            assert age_s is None or age_s >= self.now_s - sent_s - AFTER_S, (name, age_s)
        if self.dead and self.instrument not in self.sent_s:
            assert one.age_s is None or one.age_s >= since_s - AFTER_S - PERIOD_S, one
        if self.dead and self.instrument == "bath" and since_s > LATE_S + 2 * PERIOD_S:
            assert one.trouble, one
            assert status.left_s is None
            assert "heating" not in status.line
        plant, stage = self.rig.world.plant, self.rig.stage
        assert stage is not None
        bath_rests = by_name["bath"].safe in (Safe.READ_BACK, Safe.AT_REST)
        assert not (bath_rests and plant.running), by_name["bath"]
        if by_name["stage"].safe in (Safe.READ_BACK, Safe.AT_REST):
            assert not stage.velocity().any(), by_name["stage"]
        if status.tripped:
            assert (status.step, status.asked, status.left_s) == (GOING_TO_SAFE, None, None)


def queue_of(run: Path) -> QueueNote:
    """A queue whose first script is that of the run."""
    note = QueueNote.begin(run.parent, "rig", ["short", "another"])
    note.runs(run)
    return note


def same(status: Mapping[str, Any]) -> dict[str, Any]:
    """What two readings of one moment have to agree on: ages as the run said them."""
    kept: dict[str, Any] = json.loads(json.dumps(status))
    since_s = kept.pop("age_s")
    for key in ("wall_time", "why", "headline"):
        kept.pop(key)
    for one in kept["instruments"]:
        one.pop("text")
        one["age_s"] = None if one["age_s"] is None else round(one["age_s"] - since_s, 3)
    if asked := kept["asked"]:
        kept["asked"] = asked["kind"], round(asked["waited_s"] - since_s, 3)
    return kept


def killed(folder: Path, instrument: str, way: str, at: str) -> tuple[Watch, Path]:
    """A run of two trials in which that happens to the instrument in the state ``at``."""
    script = SCRIPT.replace("window_s = 2.0", "window_s = 20.0").replace(", {}]", "]")
    more = f"prompt_s = 2.0\n{LIMITS}"
    files(folder, stage=STAGE, check_point=CHECK_POINT, emulation=more, script=script)
    watch = Watch(instrument, way, at)
    with seen(watch) as progress:
        run, _ = start(folder, progress=progress, how=RunOptions(typed=watch.typed))
    return watch, run


@contextmanager
def seen(watch: Watch) -> Iterator[Events]:
    """All that a run publishes, sends and reports is known to ``watch``."""
    write, progress = Live.write, Events(watch)

    def published(live: Live, status: RunStatus, more: Mapping[str, Any]) -> None:
        if watch.wants(status):
            write(live, status, more)
        if not live.ended:
            watch.looks(live._folder.parent, status)

    def reported(kind: str, text: str) -> None:
        Events.event(progress, kind, text)
        watch.event(kind, text)

    with (
        known_to(watch),
        patch.object(Live, "due", True),
        patch.object(Live, "write", published),
        patch.object(Connection, "send", lambda *sent: watch.sent(*sent)),
        patch.object(progress, "event", reported),
    ):
        yield progress
    watch.check()


CELLS = list(product(INSTRUMENTS, WAYS, STATES))


@pytest.mark.slow
@pytest.mark.parametrize(("instrument", "way", "at"), CELLS)
def test_all_surfaces_say_the_same_and_what_the_wire_says(
    instrument: str, way: str, at: str, tmp_path: Path
) -> None:
    watch, run = killed(tmp_path, instrument, way, at)
    assert watch.rig is not None, f"it never came into {at}"
    assert any(watch.dead_s <= watch.now_s for _ in watch.samples)
    status = read_status(run)
    of_bath, of_stage = (one for one in status.instruments if one.name in HEATS_OR_MOVES)
    assert all(one.safe is Safe.AT_REST for one in status.instruments if one.name == "arm")
    if way == "returning" and at != "safing":  # where it is too late
        assert status.state == "finished", status.why
        assert not status.unsafe
    events = read_run(run).events
    at_s = {event["kind"]: event["t_s"] for event in events}
    if "given up" in at_s:
        # where it was noticed: what is late is seen by its next frames alone
        of_run = [one["text"] for one in events if one["kind"] == "run state"]
        noticed_in = of_run[of_run.index("paused") - 1]
        patience_s = PREPARING_S if noticed_in == "preparing" else 40.0
        assert patience_s <= at_s["given up"] - at_s["dropped out"] <= patience_s + 20.0
    assert bool(of_bath.by_hand) >= watch.rig.world.plant.running, of_bath
    assert watch.rig.stage
    assert bool(of_stage.by_hand) >= bool(watch.rig.stage.velocity().any()), of_stage
    compare_the_surfaces(run, status, watch)


def compare_the_surfaces(run: Path, status: RunStatus, watch: Watch) -> None:
    """Of a run that has ended."""
    written = write_run_report(run)
    status = written.status
    out = io.StringIO()
    code = show_verdict(Terminal(out), written)
    said = " ".join(out.getvalue().split())
    report = run / "report"
    page = " ".join(html.unescape((report / "index.html").read_text(encoding="utf-8")).split())
    junit = html.unescape((report / "junit.xml").read_text(encoding="utf-8"))
    (listed,) = list_runs(run.parent).runs
    (card,) = watching.listed(run.parent)
    note = watch.queue or queue_of(run)
    note.ends("an instrument was killed")
    (queue,) = queues(run.parent)
    finished = int(status.state == "finished")
    assert queue.headline.startswith(f"ended early, {finished} of 2 scripts finished: an instr")
    of_queue = queue.as_dict()["scripts"]
    assert [one["text"] for one in of_queue] == [status.headline, "not begun"]
    queued = html.unescape(write_queue_page(run.parent)[1].read_text(encoding="utf-8"))
    queued = " ".join(queued.split())
    assert queue.headline in queued
    in_json = json.loads((report / "run.json").read_text(encoding="utf-8"))
    of_run = (card["status"], listed.status, in_json["status"], of_queue[0]["status"])
    for shown in (read_status(run).as_dict(), *of_run):
        assert json.loads(json.dumps(shown)) == json.loads(json.dumps(status.as_dict()))
    assert watching.snapshot(run)["live"] is None
    assert f">{status.word}<" in page
    if status.decided:
        assert "<error" not in junit
    else:
        assert code == 3
        assert f"Verdict: {status.word}" in said
        assert junit.count("<error") == len(status.verdicts)
        assert "<skipped" in junit, "the requirements, too"
        assert {one.verdict for one in listed.results} == {status.word}
        assert f"{status.headline[0].upper()}{status.headline[1:]}." in queued
        assert status.why.split("\n")[0] in " ".join(junit.split())
    sent = text_of(ENDED, status)
    assert sent
    in_ci = re.sub(r"\\(.)", r"\1", summary.of_run(written))
    assert ("every trial of the script was done" in page) <= (status.done == status.planned)
    assert ": 1 times" not in page
    for where in (sent[1], in_ci):
        assert status.headline in where
        assert " ".join(status.why.split()) in " ".join(where.split())
    assert all(in_ci.index(line) < in_ci.find("requirement") % 10**6 for line in status.unsafe)
    if not status.decided:
        assert status.next
    for words in (" ".join(line.split()) for line in "\n".join(status.next).splitlines()):
        undecided = () if status.decided else (junit, listed.note, queued)
        for where in (" ".join(text.split()) for text in (said, page, sent[1], in_ci, *undecided)):
            assert words in where, (words, where[:2000])
    warned = "\n".join(watch.warned)
    for line in status.unsafe:
        words = " ".join(line.split())
        texts = (said, page, junit, listed.note, queued, sent[1], in_ci)
        for where in (" ".join(text.split()) for text in texts):
            assert words in where, (words, where[:2000])
        assert words.split(":")[0] in warned
        assert f"<strong>{words}</strong>" in page, "before all else to do"
    raw = json.dumps(in_json, ensure_ascii=False)
    assert not re.search(r"\d degC\b", page + queued), "a page has °C"
    assert "°C" not in "".join((said, warned, junit, in_ci, sent[1], raw)), (
        "any terminal shows degC"
    )
    assert ("NOT SAFE" in warned) == bool(status.unsafe)
    assert bool(status.unsafe) == bool(re.search("NOT SAFE", said))
