"""A bath that speaks lines of ASCII whose bench has died."""

from __future__ import annotations

import json
import threading
from contextlib import closing
from pathlib import Path

import pytest

from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, load_profile
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.safety.guards import abandoned


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
