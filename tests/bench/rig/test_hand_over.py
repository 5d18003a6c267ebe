"""One guardian a bath: who has it, who gets it next, and that the former has ended before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, cast

import psutil
import pytest
from filelock import FileLock

from bench.results.headline import guardian_text
from bench.rig.emulated_rig import PORTS, EmulatedRig
from bench.rig.guardian import ALIVE, DONE
from bench.rig.guardian_client import GuardianClient, GuardianTarget, Heartbeat
from bench.rig.hand_over import HAND_OVER_S, BathLock, bath_name, forget_guardian, free_bath
from bench.rig.loading import load_rig
from instruments.clock import VirtualClock
from instruments.errors import LimitError, LinkError
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.safety.guards import HotBath, guardian, guardian_record, standby_after
from tests.conftest import ROOT
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, within

ENDED = 1 << 22  # more than any system gives a process


@pytest.fixture
def baths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where this test's locks are: of processes too."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder / "teatbench-guardians"


def of_bench(
    hot: HotBath, bench: int, name: str = "guardian-1"
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """A guardian of a bench with this process id."""
    record = hot.folder / f"{name}.json"
    bath = "--profile=julabo-presto", f"--url={hot.url}"
    return guardian(*bath, f"--record={record}", f"--bench={bench}")


@contextmanager
def beating(guardian: subprocess.Popen[bytes]) -> Iterator[None]:
    """Heartbeats, as a bench sends them: to start a process may take longer than a hang."""
    ended, pipe = threading.Event(), cast(IO[bytes], guardian.stdin)

    def beat() -> None:
        while not ended.wait(0.5):
            pipe.write(ALIVE.encode() + b"\n")
            pipe.flush()

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def next_of(hot: HotBath, name: str = "guardian-2") -> GuardianClient:
    target = GuardianTarget(hot.url, "julabo-presto")
    return GuardianClient(target, hot.folder, Heartbeat(), name)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("tcp://10.0.0.7", "tcp://10.0.0.7:502?unit=1", True),
        ("tcp://Lab-Bath:502", "tcp://lab-bath", True),
        ("/dev/ttyUSB0", "/dev/ttyUSB0?baud=19200&parity=E", True),
        ("rtu+tcp://10.0.0.7:4001", "tcp://10.0.0.7:4001", True),
        ("tcp://10.0.0.7", "tcp://10.0.0.7?unit=2", False),
        ("tcp://10.0.0.7", "tcp://10.0.0.8", False),
        ("COM5", "COM6", False),
    ],
)
def test_a_bath_has_one_name_however_its_url_is_written(one: str, other: str, same: bool) -> None:
    assert (bath_name(one) == bath_name(other)) is same


@pytest.mark.skipif(not Path("/dev/fd").is_symlink(), reason="this system has no such link")
def test_a_serial_port_has_one_name_under_all_its_paths() -> None:
    assert bath_name("/dev/fd") == bath_name(os.path.realpath("/dev/fd"))


@pytest.mark.slow
def test_one_that_acts_hands_over_and_has_ended_before_the_next_is_ready(
    hot: HotBath, baths: Path
) -> None:
    hot.emulator.fault("silence")
    with of_bench(hot, ENDED) as old:
        first = guardian_record(hot.folder, lambda record: record["tries"] > 0)
        with next_of(hot) as line:
            assert old.poll() == 0, "it has ended, by itself"
            named = f"the guardian of {hot.folder / 'guardian-1.json'} (process {old.pid})"
            assert line.taken_from == f"{named} handed the bath over"
            assert line.lost is None
            record = json.loads((hot.folder / "guardian-1.json").read_text(encoding="utf-8"))
            assert record["standby"] is False
            assert record["handed_over"] > first["wall_noticed"]
            assert "when it handed it over to a later session at" in guardian_text(record)
            hot.emulator.fault("silence", on=False)
            line.done()
    assert hot.plant.running, "nobody has put it into standby"


@pytest.mark.slow
def test_whoever_has_taken_a_hot_bath_over_stands_for_it(hot: HotBath, baths: Path) -> None:
    """The session that took it over dies before it has done anything."""
    hot.emulator.fault("silence")
    with of_bench(hot, ENDED):
        guardian_record(hot.folder, lambda record: record["tries"] > 0)
        with of_bench(hot, ENDED, "guardian-2") as second:
            hot.emulator.fault("silence", on=False)
            standby_after(hot.plant)
            second.wait(PATIENCE_S)
    record = json.loads((hot.folder / "guardian-2.json").read_text(encoding="utf-8"))
    assert (record["cause"], record["standby"]) == ("died", True)
    assert "handed_over" not in record


@pytest.mark.weekly
@pytest.mark.skipif(sys.platform == "win32", reason="stops a process with a POSIX signal")
def test_one_that_does_not_answer_is_ended(hot: HotBath, baths: Path) -> None:
    hot.emulator.fault("silence")
    with of_bench(hot, ENDED) as old:
        guardian_record(hot.folder, lambda record: record["tries"] > 0)
        psutil.Process(old.pid).suspend()
        with next_of(hot) as line:
            assert old.wait(PATIENCE_S) != 0
            assert line.taken_from.endswith(f"did not answer for {HAND_OVER_S:g} s and was ended")
            line.done()


@pytest.mark.slow
def test_one_whose_bench_lives_keeps_the_bath(hot: HotBath, baths: Path) -> None:
    with of_bench(hot, os.getpid()) as old:
        assert old.stdin is not None
        wanted = r"another guardian has it.*for a bench that still runs"
        with beating(old), pytest.raises(LinkError, match=wanted):
            next_of(hot)
        assert old.poll() is None
        old.stdin.write(DONE.encode() + b"\n")
        old.stdin.flush()
        assert old.wait(PATIENCE_S) == 0
        with next_of(hot) as line:
            assert line.taken_from == "", "nobody acted"
            line.done()


@pytest.mark.slow
def test_a_guardian_that_was_killed_keeps_no_bath_and_is_named(hot: HotBath, baths: Path) -> None:
    with of_bench(hot, os.getpid()) as old:
        old.kill()
        old.wait()
    assert len(list(baths.glob("*.json"))) == 1, "its note is still there"
    with next_of(hot) as line:
        named = f"the guardian of {hot.folder / 'guardian-1.json'} (process {old.pid})"
        assert line.taken_from == f"{named} ended before handing over", "the bath may be on"
        line.done()
    with next_of(hot) as line:
        assert line.taken_from == ""
        line.done()


def test_the_note_of_a_killed_guardian_is_not_told_of_a_new_emulator(
    baths: Path, tmp_path: Path
) -> None:
    loaded, clock = load_rig(write_small_rig(tmp_path)), VirtualClock()

    def told() -> str:
        lock = BathLock(url, tmp_path / "guardian-2.json", ENDED)
        said = lock.take()
        lock._owner.release()  # killed
        return said

    base = free_ports(len(PORTS))
    with EmulatedRig(loaded, clock, 1, port_base=base) as twin:
        url = twin.urls["bath"]
        assert told() == ""
        assert told().endswith("ended before handing over")
    kept = BathLock(url, tmp_path / "guardian-3.json", ENDED)
    kept.take()
    forget_guardian(url)
    assert kept._read()["record"].endswith("guardian-3.json"), "it acts"
    kept._owner.release()
    with EmulatedRig(loaded, clock, 1, port_base=base) as twin:
        assert twin.urls["bath"] == url
        assert told() == ""


def test_a_note_of_a_process_that_is_no_guardian_ends_nobody(
    baths: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its number is another's by now: this process's own."""
    monkeypatch.setattr("bench.rig.hand_over.HAND_OVER_S", 0.2)
    url = "tcp://10.0.0.7"
    lock = BathLock(url, Path("one.json"), ENDED)
    assert lock.take() == ""
    lock.acts()
    with pytest.raises(LimitError, match="a process that doesn't say who it is holds it"):
        BathLock(url, Path("other.json"), ENDED).take()
    lock.release()
    other = BathLock(url, Path("other.json"), ENDED)
    assert other.take() == ""
    other.release()


def test_who_waits_is_seen_as_long_as_it_waits(baths: Path) -> None:
    url = "tcp://10.0.0.7"
    lock = BathLock(url, Path("one.json"), ENDED)
    seen = [lock.wanted]
    with FileLock(baths / f"{bath_name(url)}.next"):
        seen.append(lock.wanted)
    assert [*seen, lock.wanted] == [False, True, False]


@pytest.mark.weekly
def test_of_two_that_ask_at_once_one_gets_the_bath(hot: HotBath, baths: Path) -> None:
    hot.emulator.fault("silence")
    command = [sys.executable, "-m", "bench.rig.guardian", "--profile=julabo-presto"]
    command += [f"--url={hot.url}", f"--bench={os.getpid()}"]
    pipe = subprocess.PIPE
    with of_bench(hot, ENDED) as old:
        guardian_record(hot.folder, lambda record: record["tries"] > 0)
        asking = [
            subprocess.Popen(
                [*command, f"--record={hot.folder / name}.json"],
                cwd=ROOT,
                stdin=pipe,
                stdout=pipe,
                stderr=pipe,
            )
            for name in ("a", "b")
        ]
        try:
            within(lambda: any(one.poll() == 2 for one in asking), "one is refused")
            assert old.poll() == 0
            assert sorted(one.poll() is None for one in asking) == [False, True]
        finally:
            for one in asking:
                one.kill()
                one.communicate()


@pytest.mark.slow
def test_a_bath_that_died_with_its_bench_is_left_alone(hot: HotBath, baths: Path) -> None:
    """An emulated one: nothing is made safe any more, and the record is not written again."""
    hot.emulator.fault("silence")
    with of_bench(hot, ENDED) as old:
        guardian_record(hot.folder, lambda record: record["tries"] > 0)
        free_bath(hot.url, hot.folder)
        assert old.poll() == 0
        assert "handed_over" in json.loads((hot.folder / "guardian-1.json").read_bytes())
