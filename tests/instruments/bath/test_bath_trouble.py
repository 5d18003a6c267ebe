"""The driver when things break: silence, late answers, pulled cables, liars. Any order of it:
`test_any_order`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from instruments.bath.driver import Bath
from instruments.bath.profile import load_profile
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from instruments.listener import Connection, Listener
from tests.instruments.bath.stand import Stand

# ---- trouble under way


def test_silence_costs_2_s_of_virtual_time_and_then_all_is_well(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("silence")
    real = time.perf_counter()
    with pytest.raises(LinkError, match=r"no answer \(asked holding registers 0 to 3, after 2 s\)"):
        bath.read()
    assert time.perf_counter() - real < 0.5
    assert stand.clock.now() == pytest.approx(2.0)
    stand.emulator.fault("silence", on=False)
    assert bath.read().temp_c == 20.0


def test_a_late_answer_is_never_taken_for_the_next_one(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 2.5  # both attempts are over by then
    with pytest.raises(LinkError, match="no answer"):
        bath.read()
    stand.emulator.fault("late answer", on=False)
    for wanted in (21.0, 22.0, 23.0):
        bath.set_point(wanted)
        stand.clock.sleep(0.7)
        assert bath.get("set_point") == wanted


def test_an_answer_within_the_second_attempt_counts(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 1.2
    assert bath.read().temp_c == pytest.approx(20.0)
    assert stand.clock.now() == pytest.approx(3.6)  # three questions


def test_a_poll_that_takes_too_long_is_none(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 1.8
    with pytest.raises(
        LinkError, match=r"it answers too slowly \(asked 3 questions of a poll, after 5\.4 s\)"
    ):
        bath.read()


def test_a_wrong_length_is_nonsense(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("wrong length")
    with pytest.raises(
        ProtocolError, match=r"3 registers were answered where 4 were asked.*got 00"
    ):
        bath.read()


def test_a_cable_pulled_between_two_questions_is_mended(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    for connection in list(stand.emulator.hosts):
        connection.hang_up()
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)
    # looked at anew
    assert [address for _, function, address in stand.emulator.asked if function == 3].count(
        93
    ) == 2


def test_a_power_cut_is_told_once(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.plant.standby()
    for connection in list(stand.emulator.hosts):
        connection.hang_up()
    with pytest.raises(DeviceError, match="stopped by itself: a power cut"):
        bath.read()
    assert bath.read().power_percent == 0.0
    bath.start(33.0)
    assert stand.plant.running


def test_a_controller_switched_off_is_a_link_error(stand: Stand) -> None:
    bath = stand.bath()
    stand.listener.close()
    with pytest.raises(LinkError, match="nothing took the connection"):
        bath.read()
    with pytest.raises(LinkError, match="nothing took the connection"):
        bath.safe()


def test_an_event_of_virtual_time_may_ask_while_an_answer_is_awaited(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 0.5
    seen: list[float] = []
    stand.clock.call_at(0.2, lambda: seen.append(bath.read().temp_c))
    assert bath.read().temp_c == pytest.approx(20.0)
    assert seen == [pytest.approx(20.0)]


def test_an_interrupted_question_drops_the_link(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault("late answer")

    def interrupt() -> None:
        raise KeyboardInterrupt

    stand.clock.call_at(stand.clock.now() + 0.5, interrupt)
    with pytest.raises(KeyboardInterrupt):
        bath.read()
    stand.emulator.fault("late answer", on=False)
    bath.safe()
    assert not stand.plant.running
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)
    # over a new link, looked at anew
    assert [address for _, _, address in stand.emulator.asked].count(93) == 2


# ---- safe


@pytest.mark.parametrize(
    "fault",
    ["fahrenheit", "sensor break", "low level", "word order", "gaps refused", "stuck heater"],
)
def test_safe_is_standby_whatever_is_wrong(stand: Stand, fault: str) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    bath.safe()
    bath.safe()
    assert not stand.plant.running


def test_safe_writes_even_what_seems_so_already(stand: Stand) -> None:
    bath = stand.bath()
    bath.safe()
    assert [address for _, address in stand.emulator.writes()] == [0]


def test_safe_gets_over_a_silence_that_ends(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault("silence")
    stand.clock.call_at(stand.clock.now() + 3.0, lambda: stand.emulator.fault("silence", on=False))
    bath.safe()
    assert not stand.plant.running


@pytest.mark.parametrize(
    ("fault", "error"),
    [("silence", LinkError), ("busy", DeviceError), ("manual mode", DeviceError)],
)
def test_safe_says_so_when_it_can_not(
    stand: Stand, fault: str, error: type[InstrumentError]
) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault(fault)
    start = stand.clock.now()
    with pytest.raises(error):
        bath.safe()
    assert stand.clock.now() - start < 10.0
    stand.emulator.fault(fault, on=False)
    bath.safe()
    assert not stand.plant.running


def test_whoever_cleans_up_needs_no_look_at_the_controller(stand: Stand) -> None:
    stand.bath().start(33.0)
    stand.emulator.fault("fahrenheit")
    other = stand.bath(identify=False)
    other.safe()
    assert not stand.plant.running
    with pytest.raises(DeviceError, match="degC"):
        other.read()


# ---- a controller of another make: answers that pymodbus lets through


class Liar:
    """Answers every request with ``reply(request)``."""

    def __init__(self, reply: Callable[[bytes], bytes]) -> None:
        self.reply = reply

    def connect(self, connection: Connection) -> None:
        """Nothing unasked."""

    def disconnect(self, connection: Connection) -> None:
        """Nothing to forget."""

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.reply(data))


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (
            lambda asked: asked[:2] + bytes.fromhex("0000 0005 01 04 02 0000"),
            "function 4 was answered to function 3",
        ),
        # another transaction
        (
            lambda asked: b"\0\x63" + bytes.fromhex("0000 0005 01 03 02 0000"),
            "what came is no answer to this",
        ),
        # another unit
        (
            lambda asked: asked[:2] + bytes.fromhex("0000 0005 02 03 02 0000"),
            "what came is no answer to this",
        ),
        (
            lambda asked: asked[:2] + bytes.fromhex("0000 0005 01 2A 02 0000"),
            "function 42 was answered to function 3",
        ),
        (
            lambda asked: b"HTTP/1.1 400 Bad Request\r\n\r\n",
            r"what came is no answer to this.*got 48 54 54 50",
        ),
    ],
)
def test_answers_that_are_none(reply: Callable[[bytes], bytes], message: str) -> None:
    clock = VirtualClock()
    listener = Listener(Liar(reply), clock, lock=threading.RLock(), name="liar")
    with pytest.raises(ProtocolError, match=message):
        Bath(f"tcp://127.0.0.1:{listener.port}", load_profile("julabo-presto"), clock)
    listener.close()
