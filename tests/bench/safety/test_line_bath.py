"""A bath that speaks lines of ASCII under the bench's own care: a run whose cable is out for some
seconds, and a bench that died.
"""

from __future__ import annotations

import json
import re
import threading
from contextlib import closing
from pathlib import Path

import pytest

from bench.cli.main import main
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, load_profile
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.operated_runs import ONE
from tests.bench.safety.guards import abandoned
from tests.bench.test_config import rig_with

FAULT = (
    '\n[emulation]\nfaults = [{ instrument = "bath", name = "silence", at_s = 200.0, for_s = 8.0 }]'
)
SCRIPT = re.sub(r"\nwindow_s(?:.*\n)*?\n", "\n\n", ONE)  # with the gate as it is usual


@pytest.mark.slow
def test_a_run_on_a_julabo_whose_cable_is_out_ends_in_standby(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rig = rig_with(tmp_path, {'profile = "julabo-presto"': 'profile = "julabo-ascii"'})
    rig.write_text(rig.read_text(encoding="utf-8") + FAULT, encoding="utf-8")
    script = tmp_path / "one.toml"
    script.write_text(SCRIPT, encoding="utf-8")
    assert main(["run", str(script), "--rig", str(rig)]) == 3
    said = capsys.readouterr().out
    assert "interlock communications lost" in said
    assert "heater is in standby" in said


@pytest.mark.slow
def test_the_guardian_puts_a_julabo_into_standby(tmp_path: Path) -> None:
    plant, profile = Plant(1, start_c=33.0), load_profile("julabo-ascii")
    assert isinstance(profile, LineProfile)
    with closing(RealClock()) as clock:
        device = LineEmulator(plant, profile, clock)
        plant.run(33.0)
        with closing(Listener(device, clock, lock=threading.RLock(), name="bath")) as listener:
            record, url = tmp_path / "guardian.json", listener.url.replace("socket", "tcp")
            with abandoned("--profile=julabo-ascii", f"--url={url}", "--record", record):
                pass
    assert not plant.running
    assert json.loads(record.read_text(encoding="utf-8"))["cause"] == "died"
