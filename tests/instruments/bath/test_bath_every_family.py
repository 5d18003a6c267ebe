"""Rules that hold for every shipped family, each seen through driver and emulator: who is refused,
and what is never written.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from instruments.bath.driver import Bath
from instruments.bath.profile import Profile, load_profile, profile_names
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.listener import Listener
from instruments.world.plant import Plant, PlantConstants
from tests.instruments.bath.stand import Watched

NAMES = profile_names()
BOTH = {"transports": ("tcp", "rtu")}  # so that any driver can meet any controller
ALIKE = {  # nothing that may be read for certain tells them apart
    ("julabo-magio", "julabo-presto"),
}


@contextmanager
def met(
    name: str, other: str | None = None, *, fault: str = "", warm: bool = True
) -> Iterator[tuple[Watched, str, Profile, VirtualClock]]:
    """A controller of the family ``other`` (its own by default), and the profile ``name`` to meet
    it with, over TCP.
    """
    clock, plant = VirtualClock(), Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
    served = load_profile(other or name).model_copy(update=BOTH)
    emulator = Watched(plant, served, clock)
    if warm:
        plant.set_point_c = 25.0
    if fault:
        emulator.fault(fault)
    with closing(Listener(emulator, clock, lock=threading.RLock(), name="bath")) as listener:
        yield (
            emulator,
            f"tcp://127.0.0.1:{listener.port}",
            load_profile(name).model_copy(update=BOTH),
            clock,
        )


# ---- evidence

WITH_DOUBT = {"julabo-magio"}  # families with rows that might be written but for their evidence


@pytest.mark.parametrize("name", NAMES)
def test_no_inferred_row_is_written_or_polled_unless_the_rig_says_so(name: str) -> None:
    with met(name) as (emulator, url, profile, clock), closing(Bath(url, profile, clock)) as bath:
        for row in profile.rows:
            if row.evidence != "INFERRED" or row.access == "r":
                continue
            value = (
                float(next(iter(row.values.values())))
                if row.values
                else row.range[0]
                if row.range
                else 0.0
            )
            with pytest.raises(
                LimitError, match=f"not written: the profile only infers where {row.name} is"
            ):
                bath.set(row.name, value)
        bath.read()
        inferred = {row.address for row in profile.rows if row.evidence == "INFERRED"}
        certain = {
            address
            for row in profile.rows
            if row.evidence != "INFERRED"
            for address in range(row.address, row.end)
        }
        assert emulator.writes() == []
        assert not {address for _, _, address in emulator.asked} & (inferred - certain)


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in NAMES
        if any(r.evidence == "INFERRED" and r.access != "r" for r in load_profile(name).rows)
    ],
)
def test_an_inferred_row_is_written_where_the_rig_says_so(name: str) -> None:
    with (
        met(name) as (emulator, url, profile, clock),
        closing(Bath(url, profile, clock, allow_inferred=True)) as bath,
    ):
        for row in profile.rows:
            if row.evidence == "INFERRED" and row.access != "r" and row.values:
                bath.set(row.name, float(max(row.values.values())))
            elif (
                row.evidence == "INFERRED"
                and row.access != "r"
                and row.range
                and row.range[1] < 1e6
            ):
                bath.set(row.name, float(round(min(row.range[1], 30.0))))
        assert emulator.writes()


def test_which_families_have_inferred_rows_that_could_be_written() -> None:
    """So that the two tests above are known to have looked at something."""
    inferred = {
        name: [
            r.name for r in load_profile(name).rows if r.evidence == "INFERRED" and r.access != "r"
        ]
        for name in NAMES
    }
    assert {name for name, rows in inferred.items() if rows} == WITH_DOUBT


# ---- who is there


@pytest.mark.parametrize("other", NAMES)
@pytest.mark.parametrize("name", NAMES)
def test_a_controller_of_another_family_is_refused_before_the_first_write(
    name: str, other: str
) -> None:
    with met(name, other) as (emulator, url, profile, clock):
        if name == other or (name, other) in ALIKE:
            with closing(Bath(url, profile, clock)) as bath:
                assert bath.read().temp_c == pytest.approx(20.0, abs=0.1)
        else:
            with pytest.raises(InstrumentError) as caught:
                Bath(url, profile, clock)
            assert str(caught.value).startswith("bath at tcp://"), "it says who"
        assert emulator.writes() == []


@pytest.mark.parametrize("name", NAMES)
def test_the_look_comes_before_the_first_write(name: str) -> None:
    with met(name) as (emulator, url, profile, clock), closing(Bath(url, profile, clock)) as bath:
        bath.start(33.0)
        writes = emulator.writes()
        assert writes
        before = [address for when, _, address in emulator.asked if when <= writes[0][0]]
        for identity in profile.identity:
            assert profile.row(identity.row).address in before


@pytest.mark.parametrize("name", NAMES)
def test_another_unit_is_silence(name: str) -> None:
    with met(name) as (emulator, url, profile, clock):
        with pytest.raises(LinkError, match="no answer"):
            Bath(f"{url}?unit=2", profile, clock)
        assert emulator.writes() == []
        with closing(Bath(url, profile, clock)) as bath:
            assert bath.read().temp_c == pytest.approx(20.0)


@pytest.mark.parametrize("name", NAMES)
def test_a_port_that_drops_comes_back(name: str) -> None:
    with met(name) as (emulator, url, profile, clock), closing(Bath(url, profile, clock)) as bath:
        for _ in range(3):
            for connection in list(emulator.hosts):
                connection.hang_up()
            assert bath.read().temp_c == pytest.approx(20.0)
        bath.start(33.0)
        for connection in list(emulator.hosts):
            connection.hang_up()
        bath.safe()
        assert not emulator.plant.running


# ---- unit


@pytest.mark.parametrize("name", NAMES)
def test_a_controller_in_fahrenheit_is_refused(name: str) -> None:
    with met(name, fault="fahrenheit") as (emulator, url, profile, clock):
        error, what = (
            (DeviceError, "does not speak degC")
            if profile.find("unit")
            else (ProtocolError, "In degF it would be 20")
        )
        with pytest.raises(error, match=what):
            Bath(url, profile, clock)
        assert emulator.writes() == []


@pytest.mark.parametrize("name", NAMES)
def test_a_unit_changed_behind_our_back_is_noticed_and_nothing_written(name: str) -> None:
    with met(name) as (emulator, url, profile, clock), closing(Bath(url, profile, clock)) as bath:
        emulator.fault("fahrenheit")
        for call in (
            bath.read,
            lambda: bath.get("set_point"),
            lambda: bath.set_point(33.0),
            lambda: bath.start(33.0),
        ):
            with pytest.raises(InstrumentError, match=r"degC|degF"):
                call()
        assert emulator.writes() == []
        bath.safe()  # standby alone needs no unit


# ---- order of words

FLOATS = [name for name in NAMES if load_profile(name).row("temperature").words == 2]
LEARNT = "julabo-presto"  # it tells its order, and the driver follows


def test_who_has_words_to_turn() -> None:
    assert set(NAMES) - set(FLOATS) == {"omega-cn7"}


@pytest.mark.parametrize("name", FLOATS)
def test_words_the_other_way_round_are_refused_or_learnt(name: str) -> None:
    with met(name, fault="word order") as (emulator, url, profile, clock):
        if name == LEARNT:
            with closing(Bath(url, profile, clock)) as bath:
                assert bath.read().temp_c == pytest.approx(20.0)
                assert bath.identity["order"] == "CDAB"
        else:
            turned = "ABCD" if profile.order == "CDAB" else "CDAB"
            with pytest.raises(
                ProtocolError,
                match=(
                    rf"can't be: not within -5 to 60 degC.*In the order {turned} it would be 20\.0"
                    r" degC"
                ),
            ):
                Bath(url, profile, clock)
        assert emulator.writes() == []


@pytest.mark.parametrize("name", FLOATS)
def test_words_turned_behind_our_back_are_noticed_and_nothing_written(name: str) -> None:
    with met(name) as (emulator, url, profile, clock), closing(Bath(url, profile, clock)) as bath:
        emulator.fault("word order")
        with pytest.raises(ProtocolError):
            bath.set_point(33.0)
        assert emulator.writes() == []
        if name == LEARNT:
            assert bath.read().temp_c == pytest.approx(20.0)
        else:
            with pytest.raises(ProtocolError):
                bath.read()
        bath.safe()


# ---- what a family can do


@pytest.mark.parametrize("name", NAMES)
def test_a_pump_that_the_family_lacks_is_never_made_up(name: str) -> None:
    with met(name) as (emulator, url, profile, clock), closing(Bath(url, profile, clock)) as bath:
        bath.start(33.0)
        clock.sleep(5.0)
        emulator.plant.advance_to(clock.now())
        assert emulator.plant.pump_on == (bath.pump == "with run") == ("julabo" in name)
        if bath.pump == "none":
            for row in ("pump", "pump_stage"):
                with pytest.raises(LimitError, match=f"has no '{row}'"):
                    bath.set(row, 1.0)
