"""The driver against the emulator over loopback: what it reads, sends and refuses."""

from __future__ import annotations

import itertools
import struct

import pytest

from instruments.world.plant import Plant
from tests.instruments.bath.stand import Stand


def test_a_reading_says_it_all(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.clock.sleep(300.0)
    reading = bath.read()
    assert reading.t_s == stand.clock.now()
    assert reading.temp_c == pytest.approx(stand.plant.pv_c, abs=1e-5)
    assert reading.raw == struct.unpack(">HH", struct.pack(">f", stand.plant.pv_c))
    assert reading.external_c == pytest.approx(float(stand.plant.teat_c.mean()), abs=1e-5)
    assert reading.safety_c == pytest.approx(stand.plant.bath_c, abs=1e-5)
    assert reading.power_percent == 100.0
    assert (reading.alarm, reading.warning, reading.remote) == (0, 0, True)
    assert (reading.running, reading.set_point_c) == (True, 33.0)


def test_a_poll_is_the_same_three_questions_every_time(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.asked.clear()
    bath.read()
    bath.read()
    assert [(function, address) for _, function, address in stand.emulator.asked] == [
        (3, 0),
        (3, 90),
        (4, 5),
    ] * 2


def test_identity(stand: Stand) -> None:
    assert stand.bath().identity == {
        "family": "JULABO PRESTO",
        "url": stand.url,
        "order": "ABCD",
        "firmware": "10400",
        "cut_out": "40 degC",
    }
    assert stand.bath().pump == "with run"


def test_the_controller_is_looked_at_before_the_first_write(stand: Stand) -> None:
    stand.bath().start(33.0)
    looked = [(function, address) for _, function, address in stand.emulator.asked]
    first_write = next(at for at, (function, _) in enumerate(looked) if function in (6, 16))
    assert looked[0] == (3, 93)
    assert {(3, 93), (3, 90), (4, 5)} <= set(looked[:first_write])


def test_start_sets_the_set_point_before_run_and_keeps_the_spacing(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    bath.standby()
    assert [address for _, address in stand.emulator.writes()] == [2, 0, 0]
    times = [when for when, _ in stand.emulator.writes()]
    assert all(later - earlier >= 0.25 - 1e-9 for earlier, later in itertools.pairwise(times))
    assert stand.clock.now() == pytest.approx(0.5)
    assert stand.plant.set_point_c == 33.0
    assert not stand.plant.running


def test_what_is_so_already_is_not_written(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    count = len(stand.emulator.writes())
    bath.start(33.0)
    bath.set_point(33.0)
    assert len(stand.emulator.writes()) == count


def test_start_puts_the_controller_in_charge_of_the_heater(stand: Stand) -> None:
    bath = stand.bath()
    bath.set("actuating", "digital")
    bath.start(33.0)
    assert bath.get("actuating") == 0.0
    assert [address for _, address in stand.emulator.writes()] == [1, 1, 2, 0]


def test_heating_to_33_degc_and_back_to_standby(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    for _ in range(1200):
        stand.clock.sleep(1.0)
        reading = bath.read()
    assert reading.temp_c == pytest.approx(33.0, abs=0.05)
    bath.standby()
    assert not stand.plant.running


def test_two_runs_read_the_same() -> None:
    def run() -> list[object]:
        stand = Stand(plant=Plant(7))
        try:
            bath = stand.bath()
            bath.start(33.0)
            readings: list[object] = []
            for _ in range(300):
                stand.clock.sleep(1.0)
                readings.append(bath.read())
            return readings
        finally:
            stand.close()

    assert run() == run()
