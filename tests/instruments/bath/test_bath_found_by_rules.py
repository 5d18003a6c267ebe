"""What the rule machine has found, each as a test of its own."""

from __future__ import annotations

import threading
from contextlib import closing, suppress

import pytest

from instruments.bath.driver import Bath
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError
from instruments.listener import Listener
from instruments.world.plant import Plant, PlantConstants
from tests.instruments.bath.moving import SCHEMES, Cable, MovingClock


def connected(name: str, clock: VirtualClock) -> tuple[Cable, Listener, Bath]:
    emulator = Cable(Plant(1, constants=PlantConstants(sensor_noise_k=0.0)), name, clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    return (
        emulator,
        listener,
        Bath(f"{SCHEMES[emulator.framing]}://127.0.0.1:{listener.port}", emulator.profile, clock),
    )


@pytest.mark.parametrize("start_s", [26.60000000000002, 28.600000000000012, 62.300000000000054])
def test_a_late_answer_stops_no_clock_whatever_the_rounding(start_s: float) -> None:
    """Times that the rule machine found: a deadline and a late
    answer, one step of rounding apart.
    """
    clock = MovingClock()
    emulator, listener, bath = connected("julabo-presto", clock)
    with closing(listener), closing(bath):
        clock.sleep(start_s - clock.now())
        emulator.late_s = 1.1
        emulator.fault("late answer")
        for _ in range(3):
            with suppress(InstrumentError):
                bath.get("set_point")
        assert clock.now() > start_s + 3.0


@pytest.mark.parametrize("name", ["watlow-pm-map1", "watlow-pm-map2"])
@pytest.mark.parametrize("temp_c", [20.01, 20.03, 25.07, 33.03])
def test_words_turned_behind_our_back_are_never_a_value(name: str, temp_c: float) -> None:
    """20.03 degC with its words the other way round is 0.06 degC, which a bath may have; the set
    point tells.
    """
    clock = MovingClock()
    emulator, listener, bath = connected(name, clock)
    with closing(listener), closing(bath):
        bath.set_point(25.5)
        emulator.plant.pv_c = temp_c
        assert bath.read().temp_c == pytest.approx(temp_c)
        emulator.fault("word order")
        with pytest.raises(InstrumentError):
            bath.read()
