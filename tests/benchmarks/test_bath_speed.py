"""How fast the bath is polled and its plant steps. Figures only; comparisons are in
`test_bath_round_trips`.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_register_profile
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.listener import Listener
from instruments.world.plant import Plant


@pytest.fixture(params=[VirtualClock, RealClock], ids=["virtual", "real"])
def served(request: pytest.FixtureRequest) -> Iterator[tuple[Clock, Listener]]:
    clock = request.param()
    listener = Listener(
        BathEmulator(Plant(1), load_register_profile("julabo-presto"), clock),
        clock,
        lock=threading.RLock(),
        name="bath",
    )
    yield clock, listener
    listener.close()
    if isinstance(clock, RealClock):
        clock.close()


def test_poll(benchmark: BenchmarkFixture, served: tuple[Clock, Listener]) -> None:
    clock, listener = served
    bath = Bath(f"tcp://127.0.0.1:{listener.port}", load_register_profile("julabo-presto"), clock)
    assert benchmark(bath.read).temp_c > 19.0
    bath.close()


def test_3600_steps_of_the_plant(benchmark: BenchmarkFixture) -> None:
    def half_an_hour() -> float:
        plant = Plant(1)
        plant.run(33.0)
        plant.advance_to(1800.0)
        return plant.pv_c

    assert benchmark(half_an_hour) == pytest.approx(33.0, abs=0.1)
