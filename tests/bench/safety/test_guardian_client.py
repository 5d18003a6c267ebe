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
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import pytest

from bench.rig.guardian import DONE, HeartbeatReader
from bench.rig.guardian import main as guardian
from bench.rig.guardian_client import BEAT_S, UNANSWERED, GuardianClient, GuardianTarget, Heartbeat
from bench.rig.watched_bench import WatchedBench
from instruments.bath.driver import OwnBath
from instruments.clock import RealClock, stopwatch_s
from instruments.errors import LinkError
from instruments.link import Link
from tests.bench.safety.guards import HotBath, standby_after
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S, within


def guardian_of(hot: HotBath) -> GuardianClient:
    return GuardianClient(GuardianTarget(hot.url, "julabo-presto"), hot.folder, Heartbeat())


@pytest.mark.slow
def test_left_before_anything_heats_the_guardian_leaves_the_bath_alone(hot: HotBath) -> None:
    with guardian_of(hot) as line:
        line.heats = False
    assert hot.plant.running
    assert list(hot.folder.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="this system has no SIGSTOP")
def test_a_guardian_that_is_frozen_is_missed_and_one_that_lives_is_not_until_it_is_let_go(
    hot: HotBath,
) -> None:
    """Then the bath is left alone, and nothing is written; nor is what another guardian wrote taken
    for its own.
    """
    other = hot.folder / "guardian.json"
    other.write_text('{"standby": true}', encoding="utf-8")
    with guardian_of(hot) as line:
        beats = BEAT_S * (UNANSWERED + 3)
        start_s = time.monotonic()
        while time.monotonic() - start_s < beats:
            assert line.lost is None, "it echoes each beat"
            time.sleep(0.05)
        os.kill(line.pid, signal.SIGSTOP)
        start_s = time.monotonic()
        within(lambda: line.lost is not None, "the silence was noticed")
        assert time.monotonic() - start_s >= UNANSWERED * BEAT_S
        assert line.lost == "it has not answered for 3 s"
        os.kill(line.pid, signal.SIGCONT)
        within(lambda: line.lost is None, "it answers again")
        line.done()
    assert hot.plant.running
    assert list(hot.folder.iterdir()) == [other]
    assert other.read_text(encoding="utf-8") == '{"standby": true}'


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the process's state from /proc")
def test_the_guardian_is_small_has_what_the_system_grants_and_gets_no_signal_of_the_bench(
    hot: HotBath,
) -> None:
    with guardian_of(hot) as line:
        of = Path(f"/proc/{line.pid}")
        status = (of / "status").read_text(encoding="utf-8")
        resident, locked = (
            next(int(row.split()[1]) for row in status.split("\n") if row.startswith(name))
            for name in ("VmRSS", "VmLck")
        )
        assert resident < 60_000, "kB"
        nice = os.getpriority(os.PRIO_PROCESS, line.pid)
        assert nice == granted("import os; os.setpriority(os.PRIO_PROCESS, 0, -20)", -20, 0)
        lock = "import bench.rig.guardian, ctypes, sys; sys.exit(ctypes.CDLL(None).mlockall(5))"
        assert (locked >= resident) is granted(lock, True, False)
        for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(line.pid, name)
        assert os.getsid(line.pid) != os.getsid(0)
        opened = [str(path.readlink()) for path in (of / "fd").iterdir()]
        held = [name for name in opened if "/libffi.so" not in name]  # which some libffi do
        assert len(held) == 4, f"pipes to the bench, its log, the bath's lock: {held}"
        assert sum(name.endswith(".owner") for name in held) == 1
        assert sum(name.startswith("pipe:") for name in held) == 2
        assert sum(name.endswith("guardian.log") for name in held) == 1
        time.sleep(0.5)
        assert line.lost is None
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
    safe, tries = OwnBath.safe, list[int]()

    def fails_once(bath: OwnBath) -> None:
        tries.append(1)
        if len(tries) == 1:
            raise ValueError("a bug")
        safe(bath)

    monkeypatch.setattr(OwnBath, "safe", fails_once)
    read, write = os.pipe()
    os.close(write)
    with os.fdopen(read, encoding="utf-8") as end, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", end)
        patched.setattr(signal, "signal", lambda *_: None)
        patched.setattr("bench.rig.guardian._raise_priority", dict)
        given = ["--url", hot.url, "--profile", "julabo-presto", "--bench", "1"]
        assert guardian([*given, "--record", str(hot.folder / "guardian.json")]) == 0
    assert not hot.plant.running
    assert (hot.record()["standby"], hot.record()["tries"]) == (True, 2)


@pytest.mark.slow
def test_a_guardian_that_cannot_start_is_reported_with_its_own_words(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"did not start.*no-such-family"):
        GuardianClient(GuardianTarget("tcp://127.0.0.1:1", "no-such-family"), tmp_path, Heartbeat())


BENCH_WHOSE_PIPE_IS_HELD = """
import os, subprocess, sys, time
command = [sys.executable, "-m", "bench.rig.guardian", "--url", sys.argv[1], "--profile", "julabo-presto", "--record", sys.argv[2]]
child = subprocess.Popen(command + ["--bench", str(os.getpid())], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
child.stdout.readline()
os.set_inheritable(child.stdin.fileno(), True)
nowhere = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
holder = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"], close_fds=False, **nowhere)
print(holder.pid, flush=True)
time.sleep(100)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "darwin", reason="macOS doesn't say that a process is ending")
def test_a_bench_that_dies_is_noticed_while_its_end_of_the_pipe_is_still_open(hot: HotBath) -> None:
    """As a process that it has started keeps it, or the system, which is slow to end a process when
    it has much to do.
    """
    record = hot.folder / "guardian.json"
    command = [sys.executable, "-c", BENCH_WHOSE_PIPE_IS_HELD, hot.url, str(record)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        holder = int(child.stdout.readline())
        child.kill()
        standby_after(hot.plant)
        psutil.Process(holder).kill()
    assert (hot.record()["cause"], hot.record()["why"]) == ("died", "the system is ending it")


def test_a_bench_that_hangs_is_ended_though_a_launcher_stands_between_on_windows() -> None:
    """As `.venv\\Scripts\\python.exe` is one. Elsewhere a guardian ends its parent alone."""
    waits = [sys.executable, "-c", "input()"]
    with subprocess.Popen(waits, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        watched = WatchedBench(process.pid)
        assert watched.state() == "alive"
        assert watched.end() is (sys.platform == "win32")
        if sys.platform != "win32":
            assert watched.state() == "alive"
            process.kill()
        assert process.wait(PATIENCE_S) != 0
        assert watched.state() == ("alive" if sys.platform == "darwin" else "dying")


MOVING, DETECTING = ("moving", 600.0, 10.0), ("detecting", 60.0, None)


@dataclass
class Stopwatch:
    """Real time as the test says."""

    now_s: float = 1000.0


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Stopwatch:
    watch = Stopwatch()
    monkeypatch.setattr("bench.rig.guardian_client.stopwatch_s", lambda: watch.now_s)
    return watch


@pytest.mark.parametrize(
    ("doing", "alive", "more_s", "hangs"),
    [  # ``alive``: after so many seconds, so often, and asleep from then on for so long
        (MOVING, (9.0, 60, 0.0), 9.9, None),
        (MOVING, (9.0, 60, 0.0), 10.1, "moving, and no sign of life for 10 s"),
        (MOVING, (6.0, 101, 0.0), 0.0, "moving took more than 600 s"),
        (MOVING, (0.0, 1, 30.0), 39.0, None),
        (MOVING, (0.0, 1, 30.0), 41.0, "moving, and no sign of life for 10 s"),
        (DETECTING, (0.0, 0, 0.0), 59.0, None),  # it may be silent for as long as it may take
        (DETECTING, (0.0, 0, 0.0), 61.0, "detecting took more than 60 s"),
    ],
)
def test_who_hangs_and_who_does_not(
    watch: Stopwatch,
    doing: tuple[str, float, float | None],
    alive: tuple[float, int, float],
    more_s: float,
    hangs: str | None,
) -> None:
    heartbeat = Heartbeat()
    heartbeat.sign(*doing[:2], silence_s=doing[2])
    after_s, times, asleep_s = alive
    for turn in range(1, times + 1):
        watch.now_s += after_s
        assert heartbeat.overdue() is None or after_s * turn > doing[1]
        heartbeat.alive(asleep_s)
    watch.now_s += more_s
    assert heartbeat.overdue() == (hangs and f"the main thread hangs: {hangs}")


def test_the_life_of_another_thread_is_not_that_of_the_main_one(watch: Stopwatch) -> None:
    heartbeat = Heartbeat()
    heartbeat.sign("moving", 600.0, silence_s=10.0)
    watch.now_s += 9.0
    other = threading.Thread(target=heartbeat.alive)
    other.start()
    other.join()
    watch.now_s += 2.0
    assert heartbeat.overdue() is not None


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

    def looked(_bench: WatchedBench) -> str:
        os.write(bench_end, DONE.encode() + b"\n")
        return "dying"

    monkeypatch.setattr(WatchedBench, "state", looked)
    with Path(os.devnull).open("wb") as echo:
        reader = HeartbeatReader(source, echo.fileno(), WatchedBench(os.getpid()))
        assert reader.wait_for_loss() is None
    os.close(bench_end)
