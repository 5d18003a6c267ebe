"""The driver against the emulator over loopback: what it reads, sends and refuses; before anything is sent,
at its first look, and to start."""

from __future__ import annotations

import itertools
import math

import pytest

from instruments.bath.driver import OwnBath
from instruments.errors import LimitError, LinkError, ProtocolError
from tests.instruments.bath.devices import Stand


def test_identity(stand: Stand) -> None:
    assert stand.bath().identity == {
        "family": "JULABO PRESTO",
        "url": stand.url,
        "order": "ABCD",
        "firmware": "10400",
        "cut_out": "40 degC",
    }
    assert stand.bath().pump == "with run"


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


def test_start_puts_the_controller_in_charge_of_the_heater(stand: Stand) -> None:
    bath = stand.bath()
    bath.set("actuating", "digital")
    bath.start(33.0)
    assert bath.get("actuating") == 0.0
    assert [address for _, address in stand.emulator.writes()] == [1, 1, 2, 0]


# ---- refusals before anything is sent


@pytest.mark.parametrize(
    ("row", "value", "message"),
    [
        ("set_point", 36.5, "set_point takes 5 to 36 degC"),
        ("set_point", math.nan, "set_point takes 5 to 36 degC"),
        ("run", 7, r"run takes 0 \(standby\), 1 \(started\)"),
        ("run", "on", "run has no value 'on'"),
        ("unit", "f", "unit is read-only"),
        ("temperature", 20.0, "temperature is read-only"),
        ("pump_stage", 5, "pump_stage takes 1 to 4"),
    ],
)
def test_what_the_profile_does_not_list_is_not_written(
    stand: Stand, row: str, value: float | str, message: str
) -> None:
    bath = stand.bath()
    with pytest.raises(LimitError, match=message) as caught:
        bath.set(row, value)
    assert str(caught.value).startswith(f"bath at {stand.url}")
    assert not stand.emulator.writes()


def test_a_row_that_the_family_lacks(stand: Stand) -> None:
    bath = stand.bath()
    for call in (lambda: bath.get("flow"), lambda: bath.set("flow", 1.0), bath.acknowledge):
        with pytest.raises(
            LimitError,
            match=r"JULABO PRESTO has no '(flow|acknowledge)'\. It has: actuating, alarm, ",
        ):
            call()


# ---- refusals at the first look


def test_an_unknown_order_code_is_refused(stand: Stand) -> None:
    codes = stand.profile.order_from
    assert codes is not None
    stand.profile = stand.profile.model_copy(
        update={"order_from": codes.model_copy(update={"codes": {"9": "ABCD"}})}
    )
    with pytest.raises(
        ProtocolError,
        match=r"order of bytes is none that the profile knows \(asked encoding, got 0\)",
    ):
        stand.bath()


def test_gaps_that_the_controller_refuses_are_left_out(stand: Stand) -> None:
    stand.emulator.fault("gaps refused")
    bath = stand.bath()
    stand.emulator.asked.clear()
    assert bath.read().safety_c == pytest.approx(20.0)
    assert [address for _, _, address in stand.emulator.asked] == [0, 2, 10, 90, 93, 5, 10]


def test_a_family_that_does_not_speak_tcp(stand: Stand) -> None:
    stand.profile = stand.profile.model_copy(update={"transports": ("rtu",)})
    with pytest.raises(
        LinkError,
        match=(
            r"JULABO PRESTO does not speak Modbus TCP\. It has: rtu\+tcp://host:port or a serial"
            r" port"
        ),
    ):
        stand.bath()


def test_no_answer_is_an_error_after_some_tries(stand: Stand) -> None:
    with pytest.raises(
        LinkError, match=r"nothing took the connection in 6 tries: .+ \(after 3\.1 s\)"
    ):
        OwnBath("tcp://127.0.0.1:1", stand.profile, stand.clock)
    with pytest.raises(LinkError, match="nothing took the connection"):
        OwnBath("tcp://no-such-host.invalid:502", stand.profile, stand.clock)
