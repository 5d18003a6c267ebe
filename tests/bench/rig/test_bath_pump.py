"""A bath whose controller turns no pump: with a relay's that fails in a run, and with none. One that
works is in `test_interlocks_in_runs`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.record.reader import read_run
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from bench.rig.opening import open_instruments
from instruments.bath.sequence import pump_text
from instruments.clock import VirtualClock
from tests.bench.real_rig import script_of
from tests.bench.rig.test_bath_profiles import rig_of
from tests.examples import few

pytestmark = pytest.mark.slow

FAULT = """
[[emulation.faults]]
instrument = "pump"
name = "{name}"
at_s = {at_s}
"""


def tripped(rig: Path, folder: Path) -> dict[str, Any]:
    """The trip of a run on this rig."""
    script = folder / "script.toml"
    script.write_text(script_of(3000.0), encoding="utf-8")
    assert main(["run", str(script), "--rig", str(rig), "--out", str(folder / "runs")]) == 3
    (made,) = (folder / "runs").iterdir()
    trip: dict[str, Any] = read_run(made).facts["trip"]
    return trip


@pytest.mark.parametrize("fault", few(["silence", "power cut"], 2))
def test_a_relay_that_fails_ends_the_heat(fault: str, tmp_path: Path) -> None:
    rig = rig_of(tmp_path, "eurotherm-3200", FAULT.format(name=fault, at_s=200.0), relay=True)
    trip = tripped(rig, tmp_path)
    assert trip["rule"] == "communications lost"
    assert 200.0 <= trip["t_s"] <= 220.0
    assert any("heater is in standby" in done for done in trip["done"])


@pytest.mark.weekly
def test_a_contact_that_falls_off_and_comes_back_is_heat_without_a_pump(tmp_path: Path) -> None:
    """After a short power cut the relay answers again, and says that it is off."""
    wish = FAULT.format(name="power cut", at_s=200.2) + "for_s = 0.5\n"
    rig = rig_of(tmp_path, "eurotherm-3200", wish, relay=True)
    trip = tripped(rig, tmp_path)
    assert trip["rule"] == "heat without pump or level"
    assert "while the pump stands" in trip["why"]
    assert 200.0 <= trip["t_s"] <= 203.0


def test_a_pump_that_is_not_fitted_is_reported_and_not_pretended(tmp_path: Path) -> None:
    rig, clock = load_rig(rig_of(tmp_path, "eurotherm-3200")), VirtualClock()
    with (
        EmulatedRig(rig, clock, seed=1) as twin,
        open_instruments(rig, ("bath",), clock, twin=twin) as devices,
    ):
        text = "not fitted to the controller: nothing here proves that the water goes round"
        assert pump_text(devices.bath) == text
        assert twin.pump is None
        assert "pump" not in twin.urls
        plant = twin.world.plant
        plant.run(33.0)
        plant.advance_to(1800.0)
        assert not plant.pump_on
        assert float(plant.teat_c.max()) == 20.0


def test_the_relay_listens_on_a_port_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rig_of(tmp_path, "eurotherm-3200", relay=True)
    with EmulatedRig(load_rig(path), VirtualClock(), seed=1) as twin:
        assert re.fullmatch(r"tcp://127\.0\.0\.1:\d+", twin.urls["pump"])
        assert re.fullmatch(r"rtu\+tcp://127\.0\.0\.1:\d+", twin.urls["bath"])
    assert main(["check", str(path)]) == 0
    assert "pump: off" in capsys.readouterr().out


def test_faults_of_a_relay_in_the_rig_file(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"faults\[1\]\.instrument: this rig has no such instrument"
    ):
        load_rig(rig_of(tmp_path, "eurotherm-3200", FAULT.format(name="power cut", at_s=1.0)))
    with pytest.raises(ConfigError, match='the pump has no fault "low level"'):
        load_rig(
            rig_of(tmp_path, "eurotherm-3200", FAULT.format(name="low level", at_s=1.0), relay=True)
        )
    with pytest.raises(ConfigError, match="JULABO PRESTO has a pump of its own"):
        load_rig(rig_of(tmp_path, "julabo-presto", relay=True))
