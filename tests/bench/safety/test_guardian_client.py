"""The guardian and the bench's end of it, beside an emulated bath in real time: every way to end,
and signs of life.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from bench.safety.guardian import DONE, HeartbeatReader
from bench.safety.guardian import main as guardian
from bench.safety.guardian_client import (
    BEAT_S,
    UNANSWERED,
    GuardianClient,
    GuardianTarget,
    Heartbeat,
    guarded,
)
from instruments.bath.driver import Bath
from instruments.clock import RealClock, VirtualClock, stopwatch_s
from instruments.errors import LinkError
from instruments.link import Link
from tests.bench.safety.guards import PATIENCE_S, HotBath, guardian_record, standby_after, within
from tests.conftest import ROOT


@pytest.mark.slow
def test_done_lets_the_guardian_go_and_leaves_the_bath_alone(hot: HotBath) -> None:
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat()) as line:
        assert line.lost is None
        line.done()
    assert hot.plant.running
    assert list(hot.folder.iterdir()) == []


@pytest.mark.slow
def test_left_without_a_word_the_guardian_takes_over(hot: HotBath) -> None:
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat()):
        pass
    standby_after(hot.plant)
    assert hot.record()["cause"] == "gave up"


@pytest.mark.slow
def test_a_main_thread_that_hangs_while_the_others_live_is_seen(hot: HotBath) -> None:
    pulse = Heartbeat()
    pulse.sign("detecting", 0.5)
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, pulse) as line:
        pulse.sign("detecting", 0.5)
        standby_after(hot.plant)
        within(PATIENCE_S, lambda: line.lost is not None, "the bench learned of it")
        assert "took the bench for dead" in str(line.lost)
    text = hot.record()
    assert (text["cause"], text["standby"]) == ("hung", True)
    assert text["why"] == "the main thread hangs: detecting took more than 0.5 s"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_guardian_that_dies_is_missed(hot: HotBath) -> None:
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat()) as line:
        os.kill(line.pid, signal.SIGKILL)
        within(PATIENCE_S, lambda: line.lost is not None, "the loss was seen")
        assert "ended by itself" in str(line.lost)
        line.done()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="this system has no SIGSTOP")
def test_a_guardian_that_is_frozen_is_missed_and_one_that_lives_is_not(hot: HotBath) -> None:
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat()) as line:
        beats = BEAT_S * (UNANSWERED + 3)
        start_s = time.monotonic()
        while time.monotonic() - start_s < beats:
            assert line.lost is None, "it echoes each beat"
            time.sleep(0.05)
        os.kill(line.pid, signal.SIGSTOP)
        start_s = time.monotonic()
        within(PATIENCE_S, lambda: line.lost is not None, "the silence was noticed")
        assert time.monotonic() - start_s >= UNANSWERED * BEAT_S
        assert line.lost == "it has not answered for 3 s"
        os.kill(line.pid, signal.SIGCONT)
        within(PATIENCE_S, lambda: line.lost is None, "it answers again")
        line.done()
    assert hot.plant.running


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the process's state from /proc")
def test_the_guardian_has_the_priority_and_the_memory_that_the_system_grants(hot: HotBath) -> None:
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat()) as line:
        status = Path(f"/proc/{line.pid}/status").read_text(encoding="utf-8")
        resident, locked = (
            next(int(row.split()[1]) for row in status.split("\n") if row.startswith(name))
            for name in ("VmRSS", "VmLck")
        )
        nice = os.getpriority(os.PRIO_PROCESS, line.pid)
        assert nice == granted("import os; os.setpriority(os.PRIO_PROCESS, 0, -20)", -20, 0)
        lock = "import bench.safety.guardian, ctypes, sys; sys.exit(ctypes.CDLL(None).mlockall(5))"
        assert (locked >= resident) is granted(lock, True, False)
    assert {name: hot.record()[name] for name in ("nice", "memory_locked")} == {
        "nice": nice,
        "memory_locked": locked >= resident,
    }


def granted(code: str, yes: Any, no: Any) -> Any:
    """Whether the system lets a process of ours do it."""
    tried = subprocess.run([sys.executable, "-c", code], cwd=ROOT, stderr=subprocess.DEVNULL)
    return no if tried.returncode else yes


def test_a_mistake_in_one_try_does_not_end_the_guardian(
    hot: HotBath, monkeypatch: pytest.MonkeyPatch
) -> None:
    safe, tries = Bath.safe, list[int]()

    def fails_once(bath: Bath) -> None:
        tries.append(1)
        if len(tries) == 1:
            raise ValueError("a bug")
        safe(bath)

    monkeypatch.setattr(Bath, "safe", fails_once)
    read, write = os.pipe()
    os.close(write)
    with os.fdopen(read, encoding="utf-8") as end, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", end)
        patched.setattr(signal, "signal", lambda *_: None)
        patched.setattr("bench.safety.guardian._preferred", dict)
        given = ["--url", hot.url, "--profile", "julabo-presto", "--bench", "1"]
        assert guardian([*given, "--record", str(hot.folder / "guardian.json")]) == 0
    assert not hot.plant.running
    assert (hot.record()["standby"], hot.record()["tries"]) == (True, 2)


@pytest.mark.slow
def test_the_guardian_is_small_and_gets_no_signal_that_is_meant_for_the_bench(
    hot: HotBath,
) -> None:
    with GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat()) as line:
        if sys.platform == "linux":
            status = Path(f"/proc/{line.pid}/status").read_text(encoding="utf-8")
            (resident,) = [
                int(row.split()[1]) for row in status.split("\n") if row.startswith("VmRSS")
            ]
            assert resident < 60_000, "kB"
            for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                os.kill(line.pid, name)
            assert os.getsid(line.pid) != os.getsid(0)
            held = [str(path.readlink()) for path in Path(f"/proc/{line.pid}/fd").iterdir()]
            assert len(held) == 3, f"pipes to the bench, its log, and nothing else: {held}"
            assert sum(name.startswith("pipe:") for name in held) == 2
            assert sum(name.endswith("guardian.log") for name in held) == 1
        time.sleep(0.5)
        assert line.lost is None
        line.done()


@pytest.mark.slow
def test_a_guardian_that_cannot_start_is_reported_with_its_own_words(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"did not start.*no-such-family"):
        GuardianClient(GuardianTarget("tcp://127.0.0.1:1", "no-such-family"), tmp_path, Heartbeat())


def test_under_virtual_time_there_is_nothing_to_guard(tmp_path: Path) -> None:
    target = GuardianTarget("tcp://127.0.0.1:1", "julabo-presto")
    with guarded(target, tmp_path, VirtualClock()) as (_, guardian_client):
        assert guardian_client is None


STARTED = """
import os, subprocess, sys, time
command = [sys.executable, "-m", "bench.safety.guardian", "--url", sys.argv[1], "--profile", "julabo-presto", "--record", sys.argv[2]]
child = subprocess.Popen(command + ["--bench", str(os.getpid())], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
child.stdout.readline()
print("ready", flush=True)
"""
BENCH_THAT_FORKS = (
    STARTED
    + """
forked = os.fork()
if forked:
    print(forked, flush=True)
time.sleep(100)
"""
)
BENCH_THAT_HANGS = (
    STARTED
    + """
child.stdin.write(b"hung: the main thread hangs" + bytes([10]))
child.stdin.flush()
time.sleep(100)
"""
)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="sees the bench's end in /proc")
def test_a_bench_that_dies_is_noticed_while_its_end_of_the_pipe_is_still_open(hot: HotBath) -> None:
    """As a process that it has forked keeps it, or the system, which is slow to end a process when
    it has much to do.
    """
    record = hot.folder / "guardian.json"
    command = [sys.executable, "-c", BENCH_THAT_FORKS, hot.url, str(record)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        forked = int(child.stdout.readline())
        child.kill()
        standby_after(hot.plant)
        os.kill(forked, signal.SIGKILL)
    assert (hot.record()["cause"], hot.record()["why"]) == ("died", "the system is ending it")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_hung_bench_that_keeps_the_port_is_ended(hot: HotBath) -> None:
    """The port takes nobody until the bench that holds it is gone, as a serial port does."""
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    record = hot.folder / "guardian.json"
    command = [sys.executable, "-c", BENCH_THAT_HANGS, f"tcp://127.0.0.1:{port}", str(record)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        assert child.wait(60) == -signal.SIGKILL
        within(PATIENCE_S, record.is_file, "the record")
        forward(port, hot.url)
        standby_after(hot.plant)
    text = guardian_record(hot.folder, lambda text: text["standby"])
    assert text["killed"] is True
    assert text["tries"] >= 2


def forward(port: int, url: str) -> None:
    """From now on ``port`` leads to the bath, for one connection."""

    def serve() -> None:
        with socket.create_server(("127.0.0.1", port)) as server:
            near, _ = server.accept()
        host, _, far_port = url.removeprefix("tcp://").partition(":")
        with near, socket.create_connection((host, int(far_port))) as far:
            while data := near.recv(1000):
                far.sendall(data)
                near.sendall(far.recv(1000))

    threading.Thread(target=serve, daemon=True).start()


class Stopwatch:
    """Real time as the test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr("bench.safety.guardian_client.stopwatch_s", lambda: self.now_s)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Stopwatch:
    return Stopwatch(monkeypatch)


@pytest.fixture
def pulse(watch: Stopwatch) -> Heartbeat:
    """The main thread moves something, for ten minutes at most."""
    heartbeat = Heartbeat()
    heartbeat.sign("moving", 600.0, silence_s=10.0)
    return heartbeat


def test_a_long_move_that_shows_life_is_no_hang(watch: Stopwatch, pulse: Heartbeat) -> None:
    for _ in range(60):
        watch.now_s += 9.0
        assert pulse.overdue() is None
        pulse.alive()
    watch.now_s += 10.1
    assert pulse.overdue() == "the main thread hangs: moving, and no sign of life for 10 s"


def test_life_without_an_end_hangs_too(watch: Stopwatch, pulse: Heartbeat) -> None:
    for _ in range(101):
        watch.now_s += 6.0
        pulse.alive()
    assert pulse.overdue() == "the main thread hangs: moving took more than 600 s"


def test_a_computation_may_be_silent_for_as_long_as_it_may_take(watch: Stopwatch) -> None:
    pulse = Heartbeat()
    pulse.sign("detecting", 60.0)
    watch.now_s += 59.0
    assert pulse.overdue() is None
    watch.now_s += 2.0
    assert "detecting took more than 60 s" in str(pulse.overdue())


def test_who_sleeps_says_for_how_long(watch: Stopwatch, pulse: Heartbeat) -> None:
    pulse.alive(asleep_s=30.0)
    watch.now_s += 39.0
    assert pulse.overdue() is None
    watch.now_s += 2.0
    assert pulse.overdue() is not None


def test_the_life_of_another_thread_is_not_that_of_the_main_one(
    watch: Stopwatch, pulse: Heartbeat
) -> None:
    watch.now_s += 9.0
    other = threading.Thread(target=pulse.alive)
    other.start()
    other.join()
    watch.now_s += 2.0
    assert pulse.overdue() is not None


def test_a_clock_tells_who_looks_and_how_long_he_sleeps() -> None:
    clock, heard = RealClock(), list[float]()
    clock.subscribe(heard.append)
    clock.now()
    clock.sleep(0.01)
    clock.subscribe(None)
    clock.now()
    assert heard == [0.0, 0.01]


@pytest.mark.slow
def test_a_link_that_waits_for_an_answer_shows_life_every_second() -> None:
    clock, heard = RealClock(), list[float]()
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", clock, who="nobody")
        near, _ = server.accept()
        clock.subscribe(lambda _: heard.append(stopwatch_s()))
        assert link.receive(2.5) == b""
        link.close()
        near.close()
    assert len(heard) >= 3
    assert max(b - a for a, b in pairwise(heard)) < 5.0


def test_the_last_word_of_a_bench_that_ends_is_read_before_it_counts_as_dead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A guardian that was frozen meanwhile sees the end in /proc before its thread reads the pipe."""
    source, bench_end = os.pipe()

    def looked(_process: int) -> bool:
        os.write(bench_end, DONE.encode() + b"\n")
        return True

    monkeypatch.setattr("bench.safety.guardian._is_dying", looked)
    with Path(os.devnull).open("wb") as echo:
        reader = HeartbeatReader(source, echo.fileno(), os.getpid())
        assert reader.wait_for_loss() is None
    os.close(bench_end)
