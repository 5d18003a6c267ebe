"""What the driver refuses: before anything is sent, at its first look, and to start."""

from __future__ import annotations

import math
import socket
import threading
from collections.abc import Callable

import pytest

from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_profile
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.instruments.bath.stand import Stand

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


def test_a_set_point_out_of_bounds_does_not_start(stand: Stand) -> None:
    with pytest.raises(LimitError, match="5 to 36"):
        stand.bath().start(80.0)
    assert not stand.emulator.writes()


def test_inferred_rows_are_not_written_unless_allowed(stand: Stand) -> None:
    stand.edited("heating_limit", evidence="INFERRED")
    with pytest.raises(LimitError, match="only infers where heating_limit is"):
        stand.bath().set("heating_limit", 50.0)
    assert not stand.emulator.writes()
    stand.bath(allow_inferred=True).set("heating_limit", 50.0)
    assert stand.plant.output_max == 0.5


def test_a_row_that_the_family_lacks(stand: Stand) -> None:
    bath = stand.bath()
    for call in (lambda: bath.get("flow"), lambda: bath.set("flow", 1.0), bath.acknowledge):
        with pytest.raises(
            LimitError,
            match=r"JULABO PRESTO has no '(flow|acknowledge)'\. It has: actuating, alarm, ",
        ):
            call()


# ---- refusals at the first look


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        (
            "fahrenheit",
            DeviceError,
            (
                r"does not speak degC \(asked its unit, got f\)\. Set the controller to degrees"
                r" Celsius"
            ),
        ),
        (
            "sensor break",
            DeviceError,
            r"has no temperature \(asked temperature, got alarm 5, working sensor",
        ),
        ("silence", LinkError, r"no answer \(asked holding registers 93 to 93, after 2 s\)"),
        (
            "busy",
            DeviceError,
            r"refused: it is busy \(asked holding registers 93 to 93, got Modbus exception 6\)",
        ),
        ("wrong length", ProtocolError, "0 registers were answered where 1 were asked"),
    ],
)
def test_a_controller_that_does_not_fit_is_refused(
    stand: Stand, fault: str, error: type[InstrumentError], message: str
) -> None:
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    with pytest.raises(error, match=message):
        stand.bath()
    assert not stand.emulator.writes()
    stand.emulator.fault(fault, on=False)
    assert stand.bath().read().temp_c == pytest.approx(20.0, abs=0.05)


def test_another_order_of_bytes_is_learnt(stand: Stand) -> None:
    stand.emulator.fault("word order")
    bath = stand.bath()
    assert bath.identity["order"] == "CDAB"
    bath.start(33.0)
    assert stand.plant.set_point_c == 33.0
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.02)


def test_a_code_of_order_that_nobody_knows_is_refused(stand: Stand) -> None:
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


def test_an_order_that_changes_behind_our_back_is_noticed(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.clock.sleep(300.0)
    stand.emulator.fault("word order")
    with pytest.raises(
        ProtocolError, match=r"its order of bytes has changed \(asked encoding, got 3\)"
    ):
        bath.read()
    assert bath.read().set_point_c == 33.0  # learnt anew
    bath.safe()
    assert not stand.plant.running


@pytest.mark.parametrize(
    "call",
    [
        lambda bath: bath.get("set_point"),
        lambda bath: bath.set_point(30.0),
        lambda bath: bath.read(),
    ],
)
def test_a_unit_that_changes_behind_our_back_is_noticed(
    stand: Stand, call: Callable[[Bath], object]
) -> None:
    bath = stand.bath()
    stand.emulator.fault("fahrenheit")
    with pytest.raises(DeviceError, match=r"does not speak degC \(asked its unit, got f\)"):
        call(bath)
    assert not stand.emulator.writes()


def test_gaps_that_the_controller_refuses_are_left_out(stand: Stand) -> None:
    stand.emulator.fault("gaps refused")
    bath = stand.bath()
    stand.emulator.asked.clear()
    assert bath.read().safety_c == pytest.approx(20.0)
    assert [address for _, _, address in stand.emulator.asked] == [0, 2, 90, 93, 5, 10, 16]


def test_a_url_that_is_none(stand: Stand) -> None:
    with pytest.raises(
        LinkError,
        match=r'bath at tpc://h:1: "tpc://" is no link to a Modbus device; did you mean "tcp://"',
    ):
        Bath("tpc://h:1", stand.profile, stand.clock)


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


def test_another_unit_is_silence_and_the_url_names_it(stand: Stand) -> None:
    with pytest.raises(LinkError, match="no answer"):
        Bath(stand.url + "?unit=2", stand.profile, stand.clock)
    stand.emulator.unit_id = 2
    bath = Bath(stand.url + "?unit=2", stand.profile, stand.clock)
    assert bath.read().temp_c == 20.0
    bath.close()


def test_nobody_there_is_said_after_some_tries(stand: Stand) -> None:
    with pytest.raises(
        LinkError, match=r"nothing took the connection in 6 tries: .+ \(after 3\.1 s\)"
    ):
        Bath("tcp://127.0.0.1:1", stand.profile, stand.clock)
    with pytest.raises(LinkError, match="nothing took the connection"):
        Bath("tcp://no-such-host.invalid:502", stand.profile, stand.clock)


def test_a_controller_that_comes_up_late_is_waited_for() -> None:
    clock, profile = VirtualClock(), load_profile("julabo-presto")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    listeners: list[Listener] = []

    def switch_on() -> None:
        listeners.append(
            Listener(
                BathEmulator(Plant(1), profile, clock),
                clock,
                lock=threading.RLock(),
                name="bath",
                port=port,
            )
        )

    clock.call_at(1.0, switch_on)
    bath = Bath(f"tcp://127.0.0.1:{port}", profile, clock)
    assert clock.now() == pytest.approx(1.5)
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)
    bath.close()
    listeners[0].close()


# ---- refusals to start


@pytest.mark.parametrize(
    ("fault", "message"), [("low level", "alarm 1, low level"), ("sensor break", "working sensor")]
)
def test_no_heat_with_an_alarm(stand: Stand, fault: str, message: str) -> None:
    bath = stand.bath()
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    with pytest.raises(DeviceError, match=message):
        bath.start(33.0)
    assert not stand.emulator.writes()
    assert not stand.plant.running


def test_a_write_that_does_not_stand_is_told(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("manual mode")
    assert bath.read().remote is False
    with pytest.raises(
        DeviceError, match=r"did not do it \(asked set_point = 33, got set_point = 20\).*'manual'"
    ):
        bath.start(33.0)
    assert not stand.plant.running
