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
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.record.reader import read_run
from bench.results.headline import guardian_text
from bench.rig.guardian import DONE
from instruments.bath.emulator import BathEmulator, RelayEmulator
from instruments.bath.profile import load_relay
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.real_rig import real_rig
from tests.bench.safety.guards import (
    STANDBY_S,
    STOPPED_S,
    Measured,
    abandoned,
    guardian_record,
    standby_after,
)
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S, within

if sys.platform == "win32":
    pytest.skip("needs pseudo-terminals and POSIX signals", allow_module_level=True)

from tests.bench.marked_bench import MARK, MarkedBench, marked_bench
from tests.instruments.bath.devices import load_register_profile

pytestmark = pytest.mark.slow

RTU_FAMILY = "eurotherm-2400"
# of the pump; how much later than it happens a busy machine may show us something
OVERRUN_S, SEEN_LATE_S = 5.0, 4.0


def to_settling(running: MarkedBench) -> None:
    running.wait_for("on its peg")
    running.enter()
    running.wait_for(f"{MARK}settling")
    time.sleep(1.5)


def test_a_killed_bench_leaves_its_serial_port_to_the_guardian(
    recording: Path, tmp_path: Path, measured: Measured
) -> None:
    with real_rig(tmp_path / "rig", recording, profile=RTU_FAMILY, pty=True, window_s=60.0) as rig:
        assert rig.twin.urls["bath"].startswith("/dev/")
        plant = rig.twin.world.plant
        with marked_bench(rig, "settling") as running:
            to_settling(running)
            assert plant.running
            running.signal("SIGKILL")
            seconds = standby_after(plant)
            measured("SIGKILL while settling, serial port", seconds)
            running.process.join(PATIENCE_S)
        assert seconds < STANDBY_S
        text = guardian_record(rig.run_folder(), lambda record: record["standby"])
        assert text["cause"] == "died"


def test_a_hung_bench_that_holds_its_serial_port_is_ended_first(
    recording: Path, tmp_path: Path, measured: Measured
) -> None:
    """The port has one owner: standby takes the silence, tries to open, and the bench's end."""
    with real_rig(tmp_path / "rig", recording, profile=RTU_FAMILY, pty=True, window_s=60.0) as rig:
        plant = rig.twin.world.plant
        with marked_bench(rig, "settling") as running:
            to_settling(running)
            running.signal("SIGSTOP")
            seconds = standby_after(plant)
            measured("SIGSTOP while settling, serial port", seconds)
            text = guardian_record(rig.run_folder(), lambda record: record["standby"])
            running.process.join(PATIENCE_S)
            assert running.process.exitcode == -signal.SIGKILL
        assert seconds > STOPPED_S - 1.0
        assert (text["cause"], text["killed"]) == ("hung", True)
        run = read_run(rig.run_folder())
        assert run.ending == "interrupted"
        assert "The bench hung" in guardian_text(text)


def test_with_a_pump_on_a_relay_the_heater_goes_off_first_and_the_pump_runs_on(
    recording: Path, tmp_path: Path, measured: Measured
) -> None:
    with real_rig(tmp_path / "rig", recording, profile=RTU_FAMILY, pump=True, window_s=60.0) as rig:
        plant = rig.twin.world.plant
        with marked_bench(rig, "settling") as running:
            to_settling(running)
            assert (plant.running, plant.pump) == (True, "on")
            running.signal("SIGKILL")
            seconds = standby_after(plant)
            measured("SIGKILL while settling, pump on a relay", seconds)
        assert seconds < STANDBY_S
        text = guardian_record(rig.run_folder(), lambda record: "pump" in record)
        os.kill(text["guardian"], signal.SIGKILL)  # it would wait out its minute
        assert text["pump"] == "runs on for 60 s"
        assert plant.pump == "on"
        assert "The pump runs on for 60 s." in guardian_text(text)


# ---- the guardian alone, with a minute that is a second


@dataclass
class Hot:
    """A bath that heats with a pump on a relay, each on a port of its own."""

    plant: Plant
    relay: RelayEmulator
    arguments: list[str]
    record: Path

    def abandoned(self, overrun_s: float) -> AbstractContextManager[None]:
        """A guardian whose bench has just died."""
        return abandoned(*self.arguments, "--record", self.record, "--overrun-s", overrun_s)


@pytest.fixture
def hot(tmp_path: Path) -> Iterator[Hot]:
    clock, plant, lock = RealClock(), Plant(1, start_c=33.0), threading.RLock()
    family, relay_profile = load_register_profile(RTU_FAMILY), load_relay("modbus-relay")
    bath, relay = BathEmulator(plant, family, clock), RelayEmulator(plant, relay_profile, clock)
    arguments = [f"--profile={RTU_FAMILY}", "--pump-profile=modbus-relay"]
    listeners = []
    for option, device in (("--url", bath), ("--pump-url", relay)):
        listeners.append(Listener(device, clock, lock=lock, name=option))
        scheme = "tcp://" if device.framing == "tcp" else "rtu+tcp://"
        arguments.append(f"{option}={listeners[-1].url.replace('socket://', scheme)}")
    plant.pump = "on"
    plant.run(33.0)
    try:
        yield Hot(plant, relay, arguments, tmp_path / "guardian.json")
    finally:
        for listener in listeners:
            listener.close()
        clock.close()


def test_the_pump_stops_once_it_has_run_on(hot: Hot) -> None:
    with hot.abandoned(OVERRUN_S):
        standby_after(hot.plant)
        start = time.monotonic()
        assert hot.plant.pump == "on", "never before the heater"
        within(lambda: hot.plant.pump == "off", "pump off")
        assert time.monotonic() - start >= OVERRUN_S - SEEN_LATE_S
    text = json.loads(hot.record.read_text(encoding="utf-8"))
    assert (text["standby"], text["pump"]) == (True, f"ran on for {OVERRUN_S:g} s and is off")


def test_a_bath_that_somebody_starts_meanwhile_keeps_its_pump(hot: Hot) -> None:
    with hot.abandoned(OVERRUN_S):
        standby_after(hot.plant)
        guardian_record(hot.record.parent, lambda record: "pump" in record)
        hot.plant.run(33.0)
    text = json.loads(hot.record.read_text(encoding="utf-8"))
    assert text["standby"] is True
    assert text["pump"].startswith("was left as it was: ")
    assert hot.plant.pump == "on"


def test_a_dead_relay_does_not_prevent_standby(hot: Hot) -> None:
    hot.relay.fault("silence")
    with hot.abandoned(0.5):
        seconds = standby_after(hot.plant)
    assert seconds < STANDBY_S
    text = json.loads(hot.record.read_text(encoding="utf-8"))
    assert text["standby"] is True
    assert text["pump"].startswith("was left as it was: ")


def test_a_bench_that_has_made_safe_itself_leaves_the_pump_alone(hot: Hot) -> None:
    more = [f"--record={hot.record}", "--bench=1"]
    command = [sys.executable, "-m", "bench.rig.guardian", *hot.arguments, *more]
    done = subprocess.run(
        command, cwd=ROOT, input=f"{DONE}\n".encode(), stdout=subprocess.PIPE, timeout=PATIENCE_S
    )
    assert done.returncode == 0
    assert (hot.plant.running, hot.plant.pump) == (True, "on")
    assert not hot.record.exists()
