"""No claim of safety without a read-back: what a trip says of a stage whose link is closed, which is
silent, or which its owner is asking; and what a script says that can't make its bath safe.
"""

from __future__ import annotations

import errno
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bench.record.reader import read_run
from bench.rig.by_hand import BY_HAND
from bench.rig.devices import Evidence, Safing, attempt
from bench.rig.leaving import NotSafeError
from bench.rig.model import BathTable
from bench.rig.opening import open_instruments, rig_of
from bench.run.context import RunContext
from bench.safety.bath_monitor import held
from instruments.bath.profile import load_profile
from instruments.clock import RealClock, VirtualClock
from instruments.errors import DeviceError, LinkError
from instruments.link import Link
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import CLASSIC
from instruments.stage.protocol import HOLD
from tests.bench.commands import served
from tests.bench.real_rig import real_rig
from tests.bench.safety.guards import HotBath, standby_after
from tests.waiting import PATIENCE_S

# ---- a stage, asked by another thread than its owner's


@contextmanager
def homed() -> Iterator[tuple[StageEmulator, OwnStage]]:
    with (
        served(lambda clock: StageEmulator(clock, dialect=CLASSIC)) as (device, url),
        closing(RealClock()) as clock,
        closing(Link(url, clock, who="stage")) as link,
    ):
        stage = OwnStage(link, clock)
        stage.connect()
        yield device, stage


@contextmanager
def peer(answer: Callable[[socket.socket], None]) -> Iterator[OwnStage]:
    """A stage at a port of which ``answer`` has the other end."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        closing(RealClock()) as clock,
        closing(Link(f"socket://127.0.0.1:{server.getsockname()[1]}", clock, who="stage")) as link,
    ):
        theirs, _ = server.accept()
        with theirs:
            answer(theirs)
            yield OwnStage(link, clock)


def test_a_stage_that_stands_says_so_itself() -> None:
    with homed() as (_, stage):
        stage.brake()
        found = held(stage)
        assert (found.evidence, found.texts) == (Evidence.READ_BACK, ["stage is held"])


def test_a_closed_link_takes_the_first_write_and_holds_no_stage() -> None:
    with peer(lambda theirs: theirs.close()) as stage:
        stage.brake()  # which says nothing: the system has taken a byte
        found = held(stage)
    assert found.evidence is Evidence.FAILED
    assert found.texts[0].startswith("stage could not be made safe: stage at socket:")


@pytest.mark.slow
def test_a_stage_that_takes_the_byte_and_answers_nothing_is_not_held() -> None:
    with peer(lambda theirs: None) as stage:
        stage.brake()
        found = held(stage)
    assert found.evidence is Evidence.FAILED
    assert "no status report" in found.detail


@pytest.mark.slow
def test_amid_a_question_of_its_owner_the_brake_is_sent_and_not_acknowledged() -> None:
    said = "stage: the order to brake was sent, not acknowledged"
    with homed() as (_, stage):
        asking, asked = threading.Event(), threading.Event()

        def own() -> None:
            with stage._dialogue.turns.taken():
                asking.set()
                asked.wait(PATIENCE_S)

        owner = threading.Thread(target=own)
        owner.start()
        assert asking.wait(PATIENCE_S)
        stage.brake()
        found = held(stage)
        asked.set()
        owner.join()
        assert (found.is_safe, found.texts) == (False, [said])
        assert held(stage).is_safe, "and once the owner is through, it is asked"


@pytest.mark.parametrize("evidence", [Evidence.SENT, Evidence.FAILED])
def test_what_was_told_to_stop_is_nobodys_to_switch_off_while_the_run_goes_to_safe(
    evidence: Evidence,
) -> None:
    devices = SimpleNamespace(
        safed={"stage": Safing("stage", evidence)}, answered_s={}, active=set(), arm=None
    )
    run: Any = SimpleNamespace(devices=devices, clock=VirtualClock(), last={}, away="")
    run._camera_gone, run.made_safe = "", False
    shown = RunContext._instrument(run, "stage")
    assert (shown.safe, bool(shown.by_hand)) == (evidence.value, evidence is Evidence.FAILED)
    run.made_safe = True
    assert RunContext._instrument(run, "stage").by_hand == BY_HAND["stage"]


@pytest.mark.slow
def test_an_alarm_of_before_is_no_word_of_a_stage_that_has_gone() -> None:
    theirs: list[socket.socket] = []
    with peer(theirs.append) as stage:
        theirs[0].sendall(b"ALARM:1\r\n")
        with pytest.raises(DeviceError):
            stage.status()
        theirs[0].close()
        with pytest.raises(LinkError):
            stage.safe()


def test_the_brake_is_a_byte_and_the_question_another() -> None:
    """Grbl 1.1: "!" is feed hold, "?" the status query; Hold:0 is a complete hold."""
    got = b""

    def answer(theirs: socket.socket) -> None:
        def run() -> None:
            nonlocal got
            for report in (b"<Run|MPos:1.000,0.000,0.000>\r\n", b"<Hold:0|MPos:2.0,0.0,0.0>\r\n"):
                while b"?" not in (piece := theirs.recv(16)):
                    got += piece
                got += piece
                theirs.sendall(report)

        threading.Thread(target=run, daemon=True).start()

    with peer(answer) as stage:
        stage.brake()
        assert held(stage).is_safe
    assert got.startswith(HOLD)
    assert got.count(b"?") == 2


# ---- and of a run, a script, a pump


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="forks the bench")
def test_a_trip_with_the_stage_unplugged_never_says_that_it_is_held(
    recording: Path, tmp_path: Path
) -> None:
    from tests.bench.marked_bench import MARK, marked_bench

    with (
        real_rig(tmp_path / "rig", recording, stage=True, window_s=600.0) as rig,
        marked_bench(rig, "settling") as running,
    ):
        running.wait_for("on its peg")
        running.enter()
        running.wait_for(f"{MARK}settling")
        running.until(lambda: rig.twin.world.plant.running, "heated")
        rig.twin.listeners["stage"].close()
        with rig.twin.world.lock:
            rig.twin.bath.fault("low level")
        running.process.join(PATIENCE_S)
        assert running.process.exitcode == 3, running.said
        run = read_run(rig.run_folder())
    done = run.facts["trip"]["done"]
    assert done[0].startswith("stage could not be made safe: stage at socket:")
    assert done[1] == "heater is in standby"
    shown = " ".join([running.said, *(event["text"] for event in run.events)])
    assert "is held" not in shown
    assert "stage is safe" not in shown
    assert "NOT SAFE: stage" in " ".join(running.said.split())


@pytest.mark.slow
def test_a_script_that_can_not_make_its_bath_safe_says_so_and_the_guardian_goes_on(
    hot: HotBath, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    unlink = Path.unlink

    def refuse(path: Path, missing_ok: bool = False) -> None:
        if path.name == "guardian.log":  # as on Windows while the guardian has it open
            raise PermissionError(errno.EACCES, "it is used by another process", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refuse)
    rig = rig_of(
        load_profile("julabo-presto"), bath=BathTable(url=hot.url, profile="julabo-presto")
    )

    def script() -> None:
        with open_instruments(rig, ("bath",)) as devices:
            devices.bath.start(33.0)
            hot.emulator.fault("silence")

    with pytest.raises(NotSafeError, match=r"NOT SAFE: bath\.\nSWITCH OFF THE BATH AT ITS MAINS: "):
        script()
    said = capsys.readouterr().err
    assert "NOT SAFE: bath.\nSWITCH OFF THE BATH AT ITS MAINS: no answer for " in said
    assert "The guardian goes on trying." in said
    assert hot.plant.running
    hot.emulator.fault("silence", on=False)
    standby_after(hot.plant)


def test_what_a_step_raises_is_no_safety() -> None:
    def fails() -> None:
        raise LinkError("pump", "no answer", seconds=1.0)

    found = attempt("pump", fails)
    assert not found.is_safe
    assert found.texts == ["pump could not be made safe: pump: no answer (after 1 s)"]
