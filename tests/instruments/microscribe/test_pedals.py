"""Pedals: one event for one foot, however the contact bounces."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.microscribe.stream import Debouncer, Pedal, PedalEvent
from tests.instruments.microscribe.driver_rig import Rig


def fed(levels: list[tuple[int, int]], debounce_s: float = 0.02) -> list[PedalEvent]:
    """Events of (milliseconds, buttons)."""
    debouncer = Debouncer(debounce_s)
    return [event for t_ms, buttons in levels for event in debouncer.feed(t_ms / 1000, buttons)]


def test_press_and_release_once_they_have_lasted() -> None:
    events = fed([(0, 0), (10, 1), (20, 1), (29, 1), (30, 1), (100, 0), (119, 0), (121, 0)])
    assert events == [PedalEvent(Pedal.RIGHT, True, 0.01), PedalEvent(Pedal.RIGHT, False, 0.1)]


def test_a_bounce_starts_the_time_anew() -> None:
    assert fed([(0, 0), (10, 1), (15, 0), (20, 1), (35, 1)]) == []
    assert fed([(0, 0), (10, 1), (15, 0), (20, 1), (40, 1)]) == [
        PedalEvent(Pedal.RIGHT, True, 0.02)
    ]


def test_a_single_packet_is_no_event_at_a_slow_rate() -> None:
    assert fed([(0, 0), (100, 2), (200, 0), (300, 0)]) == []
    assert fed([(0, 0), (100, 2), (200, 2)]) == [PedalEvent(Pedal.LEFT, True, 0.1)]


def test_a_pedal_that_is_down_at_first_was_not_pressed() -> None:
    assert fed([(0, 1), (50, 1), (100, 0), (150, 0)]) == [PedalEvent(Pedal.RIGHT, False, 0.1)]


def test_two_pedals_keep_their_own_time() -> None:
    events = fed([(0, 0), (10, 1), (20, 3), (31, 3), (40, 3)])
    assert events == [PedalEvent(Pedal.RIGHT, True, 0.01), PedalEvent(Pedal.LEFT, True, 0.02)]


def test_other_bits_are_nobodys_pedal() -> None:
    assert fed([(0, 0), (10, 0x7C), (100, 0x7C)]) == []


def test_without_a_time_every_change_is_an_event() -> None:
    assert len(fed([(0, 0), (1, 1), (2, 0)], debounce_s=0.0)) == 2


def test_a_negative_time_is_refused() -> None:
    with pytest.raises(ValueError, match="not less than 0"):
        Debouncer(-0.01)


@given(st.lists(st.tuples(st.integers(1, 50), st.integers(0, 3)), max_size=80))
def test_events_alternate_and_agree_with_what_is_down(steps: list[tuple[int, int]]) -> None:
    debouncer, now_ms = Debouncer(), 0
    events: dict[Pedal, list[bool]] = {pedal: [] for pedal in Pedal}
    debouncer.feed(0.0, 0)
    for step_ms, buttons in steps:
        now_ms += step_ms
        for event in debouncer.feed(now_ms / 1000, buttons):
            assert now_ms / 1000 - event.t_s >= 0.02 - 1e-6
            events[event.pedal].append(event.pressed)
        for pedal, pressed in events.items():
            assert pressed == [at % 2 == 0 for at in range(len(pressed))]
            assert (pedal in debouncer.down) == (len(pressed) % 2 == 1)


# With the arm


def press(rig: Rig, at_s: float, buttons: int) -> None:
    rig.clock.call_at(rig.clock.now() + at_s, lambda: setattr(rig.arm, "buttons", buttons))


def test_waiting_for_a_pedal(rig: Rig) -> None:
    driver = rig.signed_on()
    press(rig, 3.0, 0x01)
    expected = rig.clock.now() + 3.0
    event = driver.wait_for_pedal(10.0)
    assert event is not None
    assert (event.pedal, event.pressed) == (Pedal.RIGHT, True)
    assert event.t_s == pytest.approx(expected, abs=0.006)
    assert rig.clock.now() == pytest.approx(expected + 0.02, abs=0.011)


def test_waiting_in_vain(rig: Rig) -> None:
    driver = rig.signed_on()
    start = rig.clock.now()
    assert driver.wait_for_pedal(2.0) is None
    assert rig.clock.now() - start == pytest.approx(2.0, abs=0.01)


def test_a_foot_that_is_still_down_has_to_come_up_first(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.buttons = 0x01
    assert driver.wait_for_pedal(1.0) is None
    press(rig, 0.5, 0x00)
    press(rig, 1.0, 0x01)
    event = driver.wait_for_pedal(5.0)
    assert event is not None
    assert event.pressed


def test_a_bouncing_contact_is_one_press(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("pedal bounce", amount=0.05)
    press(rig, 0.2, 0x01)
    press(rig, 0.6, 0x00)
    with driver.stream(500.0) as samples:
        got = list(itertools.islice(samples, 500))
    # the contacts did bounce
    assert sum(a.buttons != b.buttons for a, b in itertools.pairwise(got)) > 2
    assert [event.pressed for sample in got for event in sample.events] == [True, False]
