"""Whoever opens a rig leaves it safe: deaths by ways in, asked of the wire (`deaths`)."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

if sys.platform == "win32":
    pytest.skip("sends POSIX signals, and needs a terminal", allow_module_level=True)

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.rig.model import BathTable
from bench.rig.opening import open_instruments, rig_of
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import SHIPPED, LineProfile, load_profile
from instruments.bath.sequence import start_bath
from instruments.clock import VirtualClock
from instruments.errors import LinkError
from instruments.world.plant import Plant
from tests.bench.commands import Said, served, words
from tests.bench.real_rig import at_set_point
from tests.bench.safety.deaths import (
    DEATHS,
    ENDINGS,
    WAYS,
    Elsewhere,
    die,
    emulators,
    on_a_terminal,
)
from tests.bench.safety.guards import HotBath, Measured, guardians_of, standby_after
from tests.bench.small_cameras import write_calibration
from tests.waiting import PATIENCE_S, within

pytestmark = pytest.mark.slow

# one of each kind of death, and of each way in
FEW = [
    ("script that heats", "kill -9"),
    ("script that heats", "exception"),
    ("script that heats", "interpreter"),
    ("script that moves", "sys.exit"),
    ("stage jog", "group kill"),
    ("stage move", "TERM"),
    ("calibrate stage", "terminal closed"),
]
NONE = [("run by the console's page", "terminal closed")]  # it has none
ALL = [
    *((name, death) for name in WAYS for death in DEATHS if (name, death) not in NONE),
    *((name, end) for name in WAYS if name.startswith("script") for end in ENDINGS),
]


@pytest.fixture(scope="module")
def there(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Elsewhere]:
    with emulators(tmp_path_factory.mktemp("rig") / "rig", recording) as found:
        yield found


@pytest.mark.parametrize(("name", "death"), FEW)
def test_what_heats_or_moves_is_safe_however_the_process_ends(
    name: str, death: str, there: Elsewhere, tmp_path: Path, measured: Measured
) -> None:
    seconds, _ = die(there, name, death, tmp_path / "work")
    measured(f"{death}, {name}", seconds)


@pytest.mark.weekly
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "death"), [one for one in ALL if one not in FEW])
def test_the_same_of_every_way_in_and_every_death(
    name: str, death: str, there: Elsewhere, tmp_path: Path, measured: Measured
) -> None:
    seconds, _ = die(there, name, death, tmp_path / "work")
    measured(f"{death}, {name}", seconds)


# ---- what was on before, and what is to stay on


@pytest.mark.parametrize("death", [None, "kill -9", "TERM"])
def test_what_only_reads_leaves_a_bath_that_somebody_left_on_as_it_is(
    death: str | None, there: Elsewhere, said: Said, tmp_path: Path
) -> None:
    there.start_heating()
    try:
        url = f"tcp://127.0.0.1:{there.port('bath')}"
        at = ["--port", url, "--profile", "julabo-presto"]
        if death is None:
            assert "run: started" in said(0, "bath read {}", at).out
            said(0, "stage status --rig {}", there.rig_path)
            assert "bath: ok" in said(0, "check {}", there.rig_path).out
            assert "IT STAYS ON: 'teatbench bath standby'" in said(0, "bath set {} 31", at).out
        else:
            given = words("bath watch {}", at)
            with on_a_terminal(given) as dying:
                dying.until(lambda: "degC" in dying.said, "read")
                DEATHS[death](dying)
                dying.process.wait(PATIENCE_S)
        assert there.heats()
    finally:
        said(0, "bath standby {}", ["--port", url, "--profile", "julabo-presto"])
    assert not there.heats()


def test_what_is_told_to_stay_on_stays_on_and_that_is_noted(there: Elsewhere, said: Said) -> None:
    rig, before = load_rig(there.rig_path), set(there.folder.glob("lab.guardian-*"))
    with open_instruments(rig, ("bath",), leave_running=True) as devices:
        devices.bath.start(33.0)
        assert set(there.folder.glob("lab.guardian-*")) == before
    assert there.heats()
    (line,) = (there.folder / "lab.left-running.jsonl").read_text(encoding="utf-8").splitlines()
    note = json.loads(line)
    assert (note["left_running"], note["running"]) == (["bath", "pump"], True)
    assert (note["set_point_c"], note["process"]) == (33.0, os.getpid())
    with open_instruments(rig, ("bath",)) as devices:
        assert devices.bath.read().running
    assert there.heats(), "who opens it afterwards and only reads leaves it on"
    with open_instruments(rig, ("bath",)) as devices:
        devices.bath.set_point(32.0)
    assert not there.heats(), "and who orders another temperature leaves it safe"


def test_a_process_that_was_forked_leaves_what_its_parent_opened_alone(hot: HotBath) -> None:
    pid = 0
    with open_instruments(_of(hot), ("bath",)) as devices:
        devices.bath.start(33.0)
        if (pid := os.fork()) == 0:  # it leaves the context, as at its end
            os.close(1)
        else:
            os.waitpid(pid, 0)
            assert hot.plant.running
    if pid == 0:
        os._exit(0)
    assert not hot.plant.running


def test_a_guardian_that_has_gone_is_noticed_before_the_next_order(hot: HotBath) -> None:
    with open_instruments(_of(hot), ("bath",)) as devices:
        devices.bath.start(33.0)
        (guardian,) = guardians_of(os.getpid())
        guardian.kill()
        within(lambda: not psutil.pid_exists(guardian.pid), "gone")
        devices.bath.read()  # reading needs none
        with pytest.raises(LinkError, match="nothing is heated or moved: it ended by itself"):
            devices.bath.set_point(34.0)
    assert not hot.plant.running


def test_an_emulated_rig_is_left_safe_without_a_guardian() -> None:
    with open_instruments(load_rig(find_rig(None)), ("bath", "stage")) as devices:
        assert isinstance(devices.clock, VirtualClock)
        devices.bath.start(33.0)
        assert set(devices.active) == {"bath", "pump"}
        assert not guardians_of(os.getpid())
    assert not devices.active


def test_a_pump_alone_is_switched_off_and_one_behind_a_heater_runs_on(tmp_path: Path) -> None:
    """A pump on a relay of its own."""
    write_calibration(tmp_path)
    rig, clock = at_set_point(tmp_path, 20.0, "eurotherm-2400", pump=True), VirtualClock()
    with EmulatedRig(rig, clock, 1) as twin:
        plant = twin.world.plant
        with open_instruments(rig, ("bath",), clock, twin=twin) as devices:
            devices.bath.set("pump", "on")
            assert (plant.pump, devices.active) == ("on", ("pump alone",))
        assert plant.pump == "off"
        with open_instruments(rig, ("bath",), clock, twin=twin) as devices:
            start_bath(devices.bath, 33.0, clock.sleep)
            began_s = clock.now()
        assert (plant.running, plant.pump) == (False, "off")
        assert clock.now() - began_s >= 60.0


# ---- bench and guardian killed together


def test_a_controller_with_a_watchdog_stops_when_bench_and_guardian_are_killed(
    tmp_path: Path,
) -> None:
    """LAUDA's, by a profile that sets it to the least; the one that ships: `test_line_baths`."""
    shipped = (SHIPPED / "lauda-ascii.toml").read_text(encoding="utf-8")
    assert "watchdog_s = 30.0" in shipped
    mine = tmp_path / "lauda.toml"
    mine.write_text(shipped.replace("watchdog_s = 30.0", "watchdog_s = 10.0"), encoding="utf-8")
    plant, lauda = Plant(1, start_c=30.0), load_profile("lauda-ascii")
    assert isinstance(lauda, LineProfile)
    with served(lambda clock: LineEmulator(plant, lauda, clock)) as (device, at):
        table = {"url": at.replace("socket", "tcp"), "profile": str(mine)}
        table["unit_confirmed"] = "2026-11-20"  # by a person at its display
        script = tmp_path / "script.py"
        script.write_text(HEATER.format(table=table), encoding="utf-8")
        with on_a_terminal([script], script=True) as dying:
            dying.until(lambda: "@@ under way" in dying.said, "began")
            assert plant.running
            (guardian,) = guardians_of(dying.pid)
            for process in (guardian.pid, dying.pid):
                os.kill(process, signal.SIGKILL)
            dying.process.wait(PATIENCE_S)
            standby_after(plant)
            assert device.panel.answer("STAT") == "0100000", "by its own alarm, and nobody's order"


HEATER = """
import time
from bench.rig.model import BathTable
from bench.rig.opening import open_instruments, rig_of
from instruments.bath.profile import load_profile

table = {table!r}
rig = rig_of(load_profile(table["profile"]), bath=BathTable.model_construct(**table, pump_url="",
    pump_profile="", allow_inferred=False))
with open_instruments(rig, ("bath",)) as devices:
    devices.bath.start(33.0)
    assert devices.bath.watchdog_s
    print("@@ under way", flush=True)
    time.sleep(600.0)
"""


def _of(hot: HotBath) -> LoadedRig:
    table = BathTable(url=hot.url, profile="julabo-presto")
    return rig_of(load_profile("julabo-presto"), bath=table)
