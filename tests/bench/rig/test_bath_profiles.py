"""An emulated rig with each shipped bath profile: checked, started and stopped through the bench's
own way to its driver.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from bench.rig.opening import open_instruments
from instruments.bath.profile import load_profile, profile_names
from instruments.bath.sequence import start_bath
from instruments.clock import VirtualClock
from tests.bench.test_config import rig_with

RELAY = '\npump_url = "emulator:"\npump_profile = "modbus-relay"'


def rig_of(folder: Path, profile: str, more: str = "", *, relay: bool = False) -> Path:
    path = rig_with(
        folder, {'profile = "julabo-presto"': f'profile = "{profile}"{RELAY if relay else ""}'}
    )
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("profile", profile_names())
def test_every_profile_warms_the_teats(tmp_path: Path, profile: str) -> None:
    clock = VirtualClock()
    own = load_profile(profile).capabilities.pump == "none"
    rig = load_rig(rig_of(tmp_path, profile, relay=own))
    with (
        EmulatedRig(rig, clock, seed=1) as twin,
        open_instruments(rig, ("bath",), clock, twin=twin) as devices,
    ):
        bath = devices.bath
        scheme = "tcp://127.0.0.1:" if "tcp" in rig.profile.transports else "rtu+tcp://127.0.0.1:"
        assert twin.urls["bath"].startswith(scheme)
        start_bath(bath, 33.0, clock.sleep)
        clock.sleep(60.0)
        tells = rig.profile.find("power") is not None
        assert bath.read().power_percent == (100.0 if tells else None)
        clock.sleep(1740.0)
        reading = bath.read()
        assert reading.temp_c == pytest.approx(33.0, abs=0.15)
        assert reading.set_point_c == pytest.approx(33.0, abs=0.05)
        twin.world.scene()
        # bath sheet, section 5
        assert float(twin.world.plant.teat_c.min()) == pytest.approx(33.0 - 0.32, abs=0.1)
        bath.safe()
        assert not twin.world.plant.running


@pytest.mark.slow
def test_a_fault_that_the_bath_can_not_have_is_refused(tmp_path: Path) -> None:
    path = rig_of(
        tmp_path,
        "julabo-presto",
        '\n[emulation]\nfaults = [{ instrument = "bath", name = "bad CRC" }]\n',
    )
    with pytest.raises(ConfigError, match="Modbus TCP, which has no check sum"):
        EmulatedRig(load_rig(path), VirtualClock(), seed=1)
    assert main(["check", str(path)]) == 2
