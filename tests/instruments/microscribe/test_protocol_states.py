"""The states of a session as a table, and the bytes that are never sent."""

from __future__ import annotations

import pytest

from instruments.microscribe import protocol as wire
from instruments.microscribe.protocol import Event, State, WireError

F, Y, S, M = State.FINDING_BAUD, State.SYNCED, State.SESSION, State.STREAMING


@pytest.mark.parametrize(
    ("event", "after"),
    [
        (Event.SYNC, {F: Y, Y: Y}),
        (Event.BEGIN, {Y: S}),
        (Event.POLL, {S: S, M: S}),
        (Event.CONFIGURE, {S: S, M: S}),
        (Event.STREAM, {S: M, M: M}),
        (Event.MARKER, {S: S, M: M}),
        (Event.END, {F: F, Y: F, S: F, M: F}),
        (Event.POWER_LOST, {F: F, Y: F, S: F, M: F}),
    ],
)
def test_the_table_of_states(event: Event, after: dict[State, State]) -> None:
    for state in State:
        if state in after:
            assert wire.next_state(state, event) is after[state]
        else:
            with pytest.raises(
                WireError, match=f"{event.value} is not allowed while {state.value}"
            ):
                wire.next_state(state, event)


@pytest.mark.parametrize(
    ("byte", "event"),
    [
        (0x03, Event.POLL),
        (0x83, Event.POLL),
        (0x42, Event.CONFIGURE),
        (0xC5, Event.END),
        (0x45, Event.END),
        (0x4F, Event.STREAM),
        (0xD2, Event.MARKER),
    ],
)
def test_bit_7_of_a_command_means_nothing(byte: int, event: Event) -> None:
    assert wire.event_of(byte) is event


@pytest.mark.parametrize("byte", [0xC3, 0xC7, 0xD0, 0xD1])
def test_eeprom_writes_are_refused_with_bit_7_and_without(byte: int) -> None:
    for state in State:
        with pytest.raises(WireError, match="EEPROM"):
            wire.refuse_forbidden(bytes([0xC5, byte]), state)
    for state in (S, M):
        with pytest.raises(WireError, match="EEPROM"):
            wire.refuse_forbidden(bytes([byte & 0x7F]), state)
    wire.refuse_forbidden(wire.SYNC + wire.BEGIN, F)
