"""What benches in processes of their own play back, and baths that heat."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_register_profile
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.safety.guards import HotBath, Measured


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one frame."""
    from tests.bench.real_rig import record_one

    return record_one(tmp_path_factory.mktemp("frames") / "recording")


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Measured:
    """Notes how long standby took, for the summary of the tests and their JUnit file."""
    return lambda what, seconds: request.node.user_properties.append(
        (f"s to standby, {what}", round(seconds, 3))
    )


@pytest.fixture
def hot(tmp_path: Path) -> Iterator[HotBath]:
    clock, plant = RealClock(), Plant(1, start_c=33.0)
    plant.run(33.0)
    emulator = BathEmulator(plant, load_register_profile("julabo-presto"), clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    try:
        url = listener.url.replace("socket://", "tcp://")
        yield HotBath(plant, emulator, clock, url, tmp_path)
    finally:
        listener.close()
        clock.close()
