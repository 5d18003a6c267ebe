"""Each fault of the emulated bath, named in the rig file, seen through the driver: what it says,
and that it works again afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from instruments.bath.driver import Bath
from instruments.bath.emulator import FAULTS
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from tests.bench.test_config import rig_with

JULABO, EUROTHERM, WATLOW, OMEGA = "julabo-presto", "eurotherm-3200", "watlow-pm-map2", "omega-cn7"
AT_S, FOR_S = 60.0, 30.0
FAULT = """
[emulation]
bath_start_c = 33.0
faults = [{{ instrument = "bath", name = "{name}", at_s = {at_s}, for_s = {for_s}{more} }}]
"""

# What `read` says while it lasts: an error and its words, or None where the reading is right all
# the same.
ON_THE_WIRE: list[tuple[str, str, str, type[InstrumentError] | None, str]] = [
    ("late answer", ", amount = 0.8", JULABO, None, ""),
    ("late answer", ", amount = 0.8", EUROTHERM, None, ""),
    ("late answer", ", amount = 6.0", JULABO, LinkError, "no answer"),
    ("late answer", ", amount = 6.0", EUROTHERM, LinkError, "no answer"),
    ("garbage", "", EUROTHERM, None, ""),
    ("garbage", "", OMEGA, None, ""),
    ("garbage", "", JULABO, InstrumentError, "no answer|broke|no answer to this"),
    ("bad CRC", "", EUROTHERM, ProtocolError, "what came is no answer"),
    ("bad CRC", "", OMEGA, ProtocolError, "what came is no answer"),
    ("silence", "", JULABO, LinkError, "no answer"),
    ("silence", "", EUROTHERM, LinkError, "no answer"),
    ("busy", "", JULABO, DeviceError, "refused: it is busy"),
    ("busy", "", WATLOW, DeviceError, "refused: it is busy"),
    # it knows exceptions 2 and 3 only (fact sheet, 1.1)
    ("busy", "", EUROTHERM, LinkError, "no answer"),
    ("wrong length", "", JULABO, ProtocolError, "were answered where"),
    ("wrong length", "", EUROTHERM, ProtocolError, "were answered where"),
    ("wrong length", "", OMEGA, ProtocolError, "were answered where"),
    ("surplus", "", JULABO, ProtocolError, "were answered where"),
    ("fahrenheit", "", JULABO, DeviceError, "it does not speak degC"),
    ("fahrenheit", "", EUROTHERM, DeviceError, "it does not speak degC"),
    ("fahrenheit", "", OMEGA, DeviceError, "it does not speak degC"),
    ("external control", "", JULABO, DeviceError, "control_sensor = external where internal is"),
    ("word order", "", JULABO, ProtocolError, "its order of bytes has changed"),
    ("word order", "", WATLOW, ProtocolError, "can't be"),
    ("word order", "", EUROTHERM, ProtocolError, "can't be"),
    ("controller reset", "", EUROTHERM, LinkError, "no answer"),
    ("sensor break", "", JULABO, DeviceError, "it has no temperature .*alarm 5, .*sensor"),
    ("sensor break", "", OMEGA, DeviceError, "it has no temperature .*sensor"),
]


@contextmanager
def running(
    folder: Path, profile: str, name: str, *, more: str = "", for_s: float = FOR_S
) -> Iterator[tuple[EmulatedRig, Bath]]:
    """A bath that holds 33 degC, shortly before its fault comes."""
    path = rig_with(folder, {'profile = "julabo-presto"': f'profile = "{profile}"'})
    text = path.read_text(encoding="utf-8")
    path.write_text(
        text + FAULT.format(name=name, at_s=AT_S, for_s=for_s, more=more), encoding="utf-8"
    )
    rig, clock = load_rig(path), VirtualClock()
    with (
        EmulatedRig(rig, clock, seed=1) as twin,
        closing(Bath(twin.urls["bath"], rig.profile, clock, unit_confirmed=True)) as bath,
    ):
        bath.start(33.0)
        clock.sleep(AT_S - 1.0 - clock.now())
        assert bath.read().temp_c == pytest.approx(33.0, abs=0.15)
        assert twin.bath.faults == frozenset()
        clock.sleep(AT_S + 0.1 - clock.now())
        yield twin, bath


def true_c(twin: EmulatedRig) -> float:
    twin.world.plant.advance_to(twin.world.clock.now())
    return twin.world.plant.pv_c


@pytest.mark.slow
@pytest.mark.parametrize(("name", "more", "profile", "error", "words"), ON_THE_WIRE)
def test_what_the_driver_says(
    tmp_path: Path,
    name: str,
    more: str,
    profile: str,
    error: type[InstrumentError] | None,
    words: str,
) -> None:
    with running(tmp_path, profile, name, more=more) as (twin, bath):
        clock = twin.world.clock
        if error is None:
            for _ in range(3):
                assert bath.read().temp_c == pytest.approx(true_c(twin), abs=0.051)
                clock.sleep(1.0)
        else:
            with pytest.raises(error, match=words):
                bath.read()
        assert twin.bath.faults == {name}
        clock.sleep(AT_S + FOR_S + 12.0 - clock.now())
        assert twin.bath.faults == frozenset()
        if name == "sensor break":
            twin.world.plant.acknowledge()
        try:
            reading = bath.read()
        except InstrumentError:  # the first may still tell of what was broken
            reading = bath.read()
        assert reading.temp_c == pytest.approx(true_c(twin), abs=0.051)
        bath.safe()
        assert not twin.world.plant.running


@pytest.mark.slow
@pytest.mark.parametrize("profile", [JULABO, EUROTHERM, WATLOW, OMEGA])
def test_a_stuck_heater_shows_in_the_temperature_alone(tmp_path: Path, profile: str) -> None:
    with running(tmp_path, profile, "stuck heater", for_s=1000.0) as (twin, bath):
        twin.world.clock.sleep(150.0)
        reading = bath.read()
        assert reading.temp_c > 35.0
        assert reading.power_percent == 0.0
        bath.safe()
        twin.world.clock.sleep(60.0)
        assert bath.read().temp_c > reading.temp_c + 1.0, (
            "what standby can't stop, the cut-out has to"
        )


@pytest.mark.slow
@pytest.mark.parametrize("profile", [JULABO, EUROTHERM, WATLOW, OMEGA])
def test_a_dead_heater_cools_whatever_the_output(tmp_path: Path, profile: str) -> None:
    with running(tmp_path, profile, "dead heater", for_s=3000.0) as (twin, bath):
        twin.world.clock.sleep(1500.0)
        reading = bath.read()
        assert reading.temp_c < 32.5
        assert reading.power_percent is not None
        assert reading.power_percent > 40.0


def test_a_stopped_pump_shows_at_the_external_sensor(tmp_path: Path) -> None:
    with running(tmp_path, JULABO, "pump stopped", for_s=1000.0) as (twin, bath):
        before = bath.read()
        twin.world.clock.sleep(120.0)
        after = bath.read()
        assert before.external_c is not None
        assert after.external_c is not None
        assert before.external_c - after.external_c > 1.5
        assert after.running


@pytest.mark.slow
def test_a_low_level_is_the_circulators_alarm_and_cuts_every_heater(tmp_path: Path) -> None:
    with running(tmp_path, JULABO, "low level") as (twin, bath):
        twin.world.clock.sleep(1.0)
        assert bath.profile.alarm_text(bath.read().alarm).startswith("alarm 1, low level")
        with pytest.raises(DeviceError, match="not started: alarm 1, low level"):
            bath.start(33.0)
        assert twin.world.plant.heat_w == 0.0
    with running(tmp_path, EUROTHERM, "low level") as (twin, bath):
        twin.world.clock.sleep(20.0)
        assert bath.read().alarm == 0, "a controller of its own knows nothing of the float switch"
        assert twin.world.plant.heat_w == 0.0


def test_none_is_left_out() -> None:
    """Every name that the issue lists is tried above or, with a shape of its own, below."""
    tried = {name for name, *_ in ON_THE_WIRE} | {"stuck heater", "dead heater", "pump stopped"}
    tried |= {"low level"}
    assert set(FAULTS) - tried == {"gaps refused", "manual mode", "frozen sensor"}
