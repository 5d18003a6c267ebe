"""The guardian on a serial port, which has one owner only, and with a pump that a relay turns: real
time, pseudo-terminals.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from bench.record.reader import read_run
from bench.report.wording import guardian_told
from bench.safety.guardian import DONE
from instruments.bath.emulator import BathEmulator, RelayEmulator
from instruments.bath.profile import load_profile, load_relay
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.real_rig import real_rig
from tests.conftest import ROOT

if sys.platform == "win32":
    pytest.skip("needs pseudo-terminals and POSIX signals", allow_module_level=True)

from tests.bench.marked_bench import MARK, MarkedBench, marked_bench

STANDBY_S, HANG_S = 3.0, 10.0  # what docs/safety.md promises; standby takes milliseconds
RTU_FAMILY = "eurotherm-2400"
# of the pump; how much later than it happens a busy machine may show us something
OVERRUN_S, SEEN_LATE_S = 5.0, 4.0


def to_settling(running: MarkedBench) -> None:
    running.wait_for("on its peg")
    running.enter()
    running.wait_for(f"{MARK}settling")
    time.sleep(1.5)


def until(there: Callable[[], bool], within_s: float, what: str) -> float:
    """How long it took."""
    start = time.monotonic()
    while not there():
        assert time.monotonic() - start < within_s, f"not within {within_s} s: {what}"
        time.sleep(0.005)
    return time.monotonic() - start


def record_of(
    folder: Path, done: Callable[[dict[str, Any]], bool], within_s: float = 60.0
) -> dict[str, Any]:
    """The guardian's record, once it is ``done``."""

    def there() -> dict[str, Any]:
        path = folder / "guardian.json"
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}

    until(lambda: bool(there()) and done(there()), within_s, "the guardian's record")
    return there()


@pytest.mark.parametrize("kill", ["SIGKILL", "SIGTERM"])
def test_a_killed_bench_leaves_its_serial_port_to_the_guardian(
    kill: str, recording: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    with real_rig(tmp_path / "rig", recording, profile=RTU_FAMILY, pty=True, window_s=60.0) as rig:
        assert rig.twin.urls["bath"].startswith("/dev/")
        plant = rig.twin.world.plant
        with marked_bench(rig, "settling") as running:
            to_settling(running)
            assert plant.running
            running.signal(kill)
            seconds = until(lambda: not plant.running, 60.0, "standby")
            request.node.user_properties.append(
                (f"s to standby, {kill} while settling, serial port", round(seconds, 3))
            )
            running.process.join(60)
        assert seconds < STANDBY_S
        if kill == "SIGKILL":
            told = record_of(rig.run_folder(), lambda record: record["standby"])
            assert told["cause"] == "died"
        else:
            assert not (rig.run_folder() / "guardian.json").exists()
            assert read_run(rig.run_folder()).ending == "aborted"


def test_a_hung_bench_that_holds_its_serial_port_is_ended_first(
    recording: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The port takes no second owner, so standby takes the hang's ten seconds, the tries to open,
    and the end of the bench.
    """
    with real_rig(tmp_path / "rig", recording, profile=RTU_FAMILY, pty=True, window_s=60.0) as rig:
        plant = rig.twin.world.plant
        with marked_bench(rig, "settling") as running:
            to_settling(running)
            running.signal("SIGSTOP")
            seconds = until(lambda: not plant.running, 60.0, "standby")
            request.node.user_properties.append(
                ("s to standby, SIGSTOP while settling, serial port", round(seconds, 3))
            )
            told = record_of(rig.run_folder(), lambda record: record["standby"])
            running.process.join(60)
            assert running.process.exitcode == -signal.SIGKILL
        assert seconds > HANG_S - 2.0
        assert (told["cause"], told["killed"]) == ("hung", True)
        run = read_run(rig.run_folder())
        assert run.ending == "interrupted"
        assert "The bench hung" in guardian_told(told)


def test_with_a_pump_on_a_relay_the_heater_goes_off_first_and_the_pump_runs_on(
    recording: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    with real_rig(tmp_path / "rig", recording, profile=RTU_FAMILY, pump=True, window_s=60.0) as rig:
        plant = rig.twin.world.plant
        with marked_bench(rig, "settling") as running:
            to_settling(running)
            assert (plant.running, plant.pump) == (True, "on")
            running.signal("SIGKILL")
            seconds = until(lambda: not plant.running, 60.0, "standby")
            request.node.user_properties.append(
                ("s to standby, SIGKILL while settling, pump on a relay", round(seconds, 3))
            )
        assert seconds < STANDBY_S
        told = record_of(rig.run_folder(), lambda record: "pump" in record)
        os.kill(told["guardian"], signal.SIGKILL)  # it would wait out its minute
        assert told["pump"] == "runs on for 60 s"
        assert plant.pump == "on"
        assert "The pump runs on for 60 s." in guardian_told(told)


# ---- the guardian alone, with a minute that is a second


@dataclass
class Hot:
    """A bath that heats with a pump on a relay, each on a port of its own."""

    plant: Plant
    relay: RelayEmulator
    arguments: list[str]
    record: Path

    @contextmanager
    def abandoned(self, overrun_s: float) -> Iterator[subprocess.Popen[bytes]]:
        """A guardian whose bench has just died."""
        more = ["--record", str(self.record), "--bench", "1", "--overrun-s", str(overrun_s)]
        command = [sys.executable, "-m", "bench.safety.guardian", *self.arguments, *more]
        pipe = subprocess.PIPE
        with subprocess.Popen(
            command, cwd=ROOT, stdin=pipe, stdout=pipe, start_new_session=True
        ) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline().strip() == b"ready"
            process.stdin.close()
            yield process
            process.wait(60)


@pytest.fixture
def hot(tmp_path: Path) -> Iterator[Hot]:
    clock, plant, lock = RealClock(), Plant(1, start_c=33.0), threading.RLock()
    family, relay_profile = load_profile(RTU_FAMILY), load_relay("modbus-relay")
    bath, relay = BathEmulator(plant, family, clock), RelayEmulator(plant, relay_profile, clock)
    listeners = [
        Listener(device, clock, lock=lock, name=name)
        for name, device in (("bath", bath), ("pump", relay))
    ]
    schemes = ["tcp://" if device.framing == "tcp" else "rtu+tcp://" for device in (bath, relay)]
    urls = [
        listener.url.replace("socket://", scheme)
        for listener, scheme in zip(listeners, schemes, strict=True)
    ]
    plant.pump = "on"
    plant.run(33.0)
    arguments = [f"--url={urls[0]}", f"--profile={RTU_FAMILY}"]
    arguments += [f"--pump-url={urls[1]}", "--pump-profile=modbus-relay"]
    try:
        yield Hot(plant, relay, arguments, tmp_path / "guardian.json")
    finally:
        for listener in listeners:
            listener.close()
        clock.close()


def test_the_pump_stops_once_it_has_run_on(hot: Hot) -> None:
    with hot.abandoned(OVERRUN_S):
        until(lambda: not hot.plant.running, 60.0, "standby")
        start = time.monotonic()
        assert hot.plant.pump == "on", "never before the heater"
        until(lambda: hot.plant.pump == "off", 60.0, "pump off")
        assert time.monotonic() - start >= OVERRUN_S - SEEN_LATE_S
    told = json.loads(hot.record.read_text(encoding="utf-8"))
    assert (told["standby"], told["pump"]) == (True, f"ran on for {OVERRUN_S:g} s and is off")


def test_a_bath_that_somebody_starts_meanwhile_keeps_its_pump(hot: Hot) -> None:
    with hot.abandoned(OVERRUN_S):
        until(lambda: not hot.plant.running, 60.0, "standby")
        record_of(hot.record.parent, lambda record: "pump" in record)
        hot.plant.run(33.0)
    told = json.loads(hot.record.read_text(encoding="utf-8"))
    assert told["standby"] is True
    assert told["pump"].startswith("was left as it was: ")
    assert hot.plant.pump == "on"


def test_a_relay_that_is_dead_keeps_nobody_from_standby(hot: Hot) -> None:
    hot.relay.fault("silence")
    with hot.abandoned(0.5):
        seconds = until(lambda: not hot.plant.running, 60.0, "standby")
    assert seconds < STANDBY_S
    told = json.loads(hot.record.read_text(encoding="utf-8"))
    assert told["standby"] is True
    assert told["pump"].startswith("was left as it was: ")


def test_a_bench_that_has_made_safe_itself_leaves_the_pump_to_nobody(hot: Hot) -> None:
    more = [f"--record={hot.record}", "--bench=1"]
    command = [sys.executable, "-m", "bench.safety.guardian", *hot.arguments, *more]
    done = subprocess.run(
        command, cwd=ROOT, input=f"{DONE}\n".encode(), stdout=subprocess.PIPE, timeout=60
    )
    assert done.returncode == 0
    assert (hot.plant.running, hot.plant.pump) == (True, "on")
    assert not hot.record.exists()
