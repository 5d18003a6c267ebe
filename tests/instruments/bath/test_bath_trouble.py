"""The driver when things break: silence, late answers, pulled cables, liars; and standby from an event of
virtual time in the midst of another call on the same link, as interlocks do it. Any order of it:
`test_any_order`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.session import BrokenError
from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from tests.instruments.bath.devices import Stand, load_register_profile
from tests.instruments.bath.far_end import Spoil, virtual

# ---- trouble under way


def test_a_poll_that_takes_too_long_is_none(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 1.8
    with pytest.raises(
        LinkError, match=r"it answers too slowly \(asked 3 questions of a poll, after 5\.4 s\)"
    ):
        bath.read()


def test_a_power_cut_is_reported_once(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.plant.standby()
    stand.emulator.pull_the_cable()
    with pytest.raises(DeviceError, match="stopped by itself: a power cut"):
        bath.read()
    assert bath.read().power_percent == 0.0
    bath.start(33.0)
    assert stand.plant.running


def test_an_event_of_virtual_time_may_ask_while_an_answer_is_awaited(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 0.5
    seen: list[float] = []
    stand.clock.call_at(0.2, lambda: seen.append(bath.read().temp_c))
    assert bath.read().temp_c == pytest.approx(20.0)
    assert seen == [pytest.approx(20.0)]


# ---- safe


def test_safe_writes_even_what_seems_so_already(stand: Stand) -> None:
    bath = stand.bath()
    bath.safe()
    assert [address for _, address in stand.emulator.writes()] == [0]


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


# ---- a controller of another make: answers that pymodbus lets through


NO_ANSWER = "what came is no answer to this"


def behind(answer: str, number: bytes = b"") -> Spoil:
    """Another ``answer``, under the question's number by default."""
    return lambda frame: (number or frame[:2]) + bytes.fromhex(f"0000 0005 {answer}")


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (behind("01 04 02 0000"), "function 4 was answered to function 3"),
        (behind("01 03 02 0000", b"\0\x63"), NO_ANSWER),  # another transaction
        (behind("02 03 02 0000"), NO_ANSWER),  # another unit
        (behind("01 2A 02 0000"), "function 42 was answered to function 3"),
        (lambda _: b"HTTP/1.1 400 Bad Request\r\n\r\n", f"{NO_ANSWER}.*got 48 54 54 50"),
    ],
)
def test_answers_that_are_none(reply: Spoil, message: str) -> None:
    with virtual("tcp") as (far_end, url):
        far_end.spoils = [reply] * 9
        with pytest.raises(ProtocolError, match=message):
            OwnBath(url, load_register_profile("julabo-presto"), far_end.clock)


CALLS: dict[str, Callable[[OwnBath], object]] = {
    "read": lambda bath: bath.read(),
    "get": lambda bath: bath.get("set_point"),
    "set": lambda bath: bath.set("set_point", 30.0),
    "start": lambda bath: bath.start(33.0),
    "safe": lambda bath: bath.safe(),
}
FAMILIES = ["julabo-presto", "eurotherm-3200"]


def stand_of(family: str) -> Stand:
    return Stand(profile=load_register_profile(family))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("after_s", [0.05, 0.3, 0.9, 1.4, 2.6])
def test_standby_within_another_call_while_nothing_answers(
    family: str, call: str, after_s: float
) -> None:
    """The first attempts fail and close the session that the outer call waits on."""
    with stand_of(family) as stand:
        bath = stand.bath()
        stand.plant.run(33.0)
        stand.emulator.fault("silence")
        stand.clock.call_at(
            stand.clock.now() + after_s + 4.0, lambda: stand.emulator.fault("silence", on=False)
        )
        made_safe: list[bool] = []

        def trip() -> None:
            bath.safe()
            made_safe.append(not stand.plant.running)

        stand.clock.call_at(stand.clock.now() + after_s, trip)
        with suppress(InstrumentError):  # and nothing else
            CALLS[call](bath)
        if not made_safe:  # the call was over before
            stand.clock.sleep(after_s + 8.0)
        assert made_safe == [True]
        assert not stand.plant.running


@pytest.mark.parametrize("family", FAMILIES)
def test_a_session_that_is_closed_while_it_waits_is_reported_as_a_broken_link(family: str) -> None:
    with stand_of(family) as stand:
        bath = stand.bath()
        stand.emulator.fault("silence")
        stand.clock.call_at(stand.clock.now() + 0.5, bath.close)
        with pytest.raises(BrokenError, match="the link broke"):
            bath._wire.read(3, 0, 1)  # type: ignore[union-attr]
        stand.emulator.fault("silence", on=False)
        assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("within", range(1, 12))
def test_a_start_never_undoes_a_standby_that_came_meanwhile(family: str, within: int) -> None:
    """Standby comes amid the start's ``within``-th question, which is slow to be answered."""
    with stand_of(family) as stand:
        bath = stand.bath()
        tripped: list[float] = []
        asked = len(stand.emulator.asked)
        receive = stand.emulator.receive

        def trip() -> None:
            stand.emulator.fault("late answer", on=False)
            bath.safe()
            tripped.append(stand.clock.now())

        def slow(connection: object, data: bytes) -> None:
            if len(stand.emulator.asked) == asked + within - 1 and not tripped:
                stand.emulator.late_s = 0.6
                stand.emulator.fault("late answer")
                stand.clock.call_at(stand.clock.now() + 0.2, trip)
            receive(connection, data)  # type: ignore[arg-type]

        stand.emulator.receive = slow  # type: ignore[method-assign]
        with suppress(InstrumentError):
            bath.start(33.0)
        if tripped:
            assert not stand.plant.running
        else:
            assert stand.plant.running
        stand.clock.sleep(1.0)
        bath.read()
        assert stand.plant.running == (not tripped)


def test_who_starts_learns_that_it_was_made_safe() -> None:
    with stand_of("julabo-presto") as stand:
        bath = stand.bath()
        # writes to a JULABO keep 0.25 s apart
        stand.clock.call_at(stand.clock.now() + 0.1, bath.safe)
        with pytest.raises(InstrumentError, match="not started: it was made safe meanwhile"):
            bath.start(33.0)
        assert not stand.plant.running
        bath.start(33.0)
        assert stand.plant.running
