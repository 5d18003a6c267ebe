"""Bytes of the arm: golden ones typed from the fact sheet, round trips, and garbage; the states of a
session; the bytes that are never sent; the arm's own time.
"""

from __future__ import annotations

import itertools
from dataclasses import astuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import BlockLengthError, Maxima, StreamRequest
from instruments.microscribe.protocol import (
    ArmTime,
    Code,
    Event,
    Packet,
    PacketDecoder,
    State,
    WireError,
)
from tests.instruments.microscribe import rigs

AT_REST = bytes.fromhex(rigs.AT_REST)
MAXIMA, PARAMETERS, EXTENDED = (rigs.REPLIES[code] for code in (0xC6, 0xC0, 0xD3))
REPLIES = rigs.REPLIES | {code: bytes([code]) for code in (0xC2, 0xC4, 0xC5, 0xCF)}
REST = Packet(0x03, 0, (13903, 6238, 6868, 4098, 3193, 8416))


def test_the_recorded_packet() -> None:
    for command in (None, wire.POLL):
        decoder = PacketDecoder(command)
        assert decoder.feed(AT_REST + AT_REST[:3]) == [REST]
        assert (decoder.damaged, decoder.pending) == (0, 3)
    assert wire.encode_packet(REST) == AT_REST


@pytest.mark.parametrize(
    ("command", "header", "length"),
    [(0x03, 0x83, 13), (0x23, 0xA3, 15), (0x01, 0x81, 11), (0x02, 0x82, 15), (0, 0x80, 1)],
)
def test_packet_lengths_of_the_sheet(command: int, header: int, length: int) -> None:
    counts = (1,) * {0x03: 6, 0x23: 6, 0x01: 5, 0x02: 7, 0: 0}[command]
    data = wire.encode_packet(Packet(command, 1, counts, ticks=5 if command & 0x20 else None))
    assert data[0] == header
    assert len(data) - 1 == length == wire.payload_length(command)


def test_a_time_stamp_and_analogs_come_before_the_encoders_and_the_eighth_has_no_low_bit() -> None:
    # 0x25: stamp, two analogs, five encoders. Analog 0xFF is 7F and low bit 1, at bit 6; 0x80 is 40
    # and low bit 0.
    data = bytes.fromhex("A5 02 01 02 7F 40 40 00 01 00 02 00 03 00 04 00 05")
    packet = Packet(0x25, 2, (1, 2, 3, 4, 5), ticks=130, analogs=(0xFF, 0x80))
    assert PacketDecoder().feed(data) == [packet]
    eight = wire.encode_packet(Packet(0x0C, 0, (), analogs=(255,) * 8))
    assert PacketDecoder().feed(eight) == [Packet(0x0C, 0, (), analogs=(255,) * 7 + (254,))]


def test_a_lost_byte_costs_one_packet_and_a_lost_header_also_the_one_before() -> None:
    decoder = PacketDecoder(0x03)
    assert decoder.feed(AT_REST[:-1] + AT_REST + AT_REST) == [REST, REST]
    assert decoder.damaged == 1
    # which of the 26 bytes are surplus can't be told
    assert decoder.feed(AT_REST + AT_REST[1:] + AT_REST) == [REST]
    assert decoder.damaged == 2


MOVED = Packet(0x03, 1, (1, 300, 16383, 129, 8192, 77))


@pytest.mark.parametrize("place", range(len(AT_REST)))
def test_a_byte_that_comes_twice_costs_its_packet_and_none_is_wrong(place: int) -> None:
    for sent in (REST, MOVED):
        whole_one = wire.encode_packet(sent)
        doubled = whole_one[: place + 1] + whole_one[place:]
        decoder = PacketDecoder(0x03)
        assert decoder.feed(AT_REST + doubled + AT_REST) in ([REST, REST], [REST, sent, REST])
        assert decoder.damaged == 1


def kept(
    stream: bytes, cuts: list[int], decoder: PacketDecoder | None = None
) -> tuple[list[Packet], int]:
    """The packets of a stream in pieces, without those that were withdrawn; and how many came
    damaged. All of a stream that ends with a packet is used up.
    """
    decoder = decoder or PacketDecoder()
    got: list[Packet] = []
    places = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    for a, b in itertools.pairwise(places):
        withdrawn = decoder.withdrawn
        came = decoder.feed(stream[a:b])
        got = [*(got[:-1] if decoder.withdrawn > withdrawn else got), *came]
    assert decoder.pending == 0 or not stream.endswith(AT_REST)
    return got, decoder.damaged


def test_echoes_and_markers_are_no_packets() -> None:
    stream = bytes([Code.HOME, Code.END, Code.MARKER, 0x07]) + AT_REST
    assert PacketDecoder().feed(stream) == [REST]


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    command = draw(st.integers(0, 63)) & ~wire.UNUSED
    fourteen = st.integers(0, 16383)
    count, channels = wire.encoder_count(command), wire.analog_count(command)
    return Packet(
        command,
        draw(st.integers(0, 127)),
        tuple(draw(fourteen) for _ in range(count)),
        draw(fourteen) if command & wire.TIME_STAMP else None,
        tuple(2 * draw(st.integers(0, 127)) for _ in range(channels)),
    )


@pytest.mark.slow
@given(st.lists(packets(), max_size=8), st.lists(st.integers(0, 200), max_size=10))
def test_any_packets_cut_anywhere_come_back(sent: list[Packet], cuts: list[int]) -> None:
    stream = b"".join(map(wire.encode_packet, sent))
    assert kept(stream, cuts) == (sent, 0)


@given(st.binary(max_size=200), st.lists(st.integers(0, 200), max_size=5))
def test_after_any_garbage_the_second_packet_is_right(garbage: bytes, cuts: list[int]) -> None:
    got, _ = kept(garbage + AT_REST + AT_REST, cuts, PacketDecoder(0x03))
    assert got[-1] == REST


@pytest.mark.slow
@given(
    st.lists(st.one_of(st.binary(max_size=20), packets().map(wire.encode_packet)), max_size=6).map(
        b"".join
    ),
    st.lists(st.integers(0, 200), max_size=4),
)
def test_cutting_changes_nothing(data: bytes, cuts: list[int]) -> None:
    assert kept(data, []) == kept(data, cuts)


# Configuration


def test_names_in_the_makers_order() -> None:
    replies = {code: reply for code, reply in rigs.REPLIES.items() if code in conf.NAMES}
    names = [conf.decode_name(code, reply) for code, reply in replies.items()]
    known = "MicroScribe3D, MSCR, DX, 40937, Standard+Beta, Format DH0.5, HCI 2.0"
    assert ", ".join(names) == known
    assert list(replies) == list(conf.NAMES)
    assert list(map(conf.encode_name, conf.NAMES, names)) == list(replies.values())


@pytest.mark.parametrize(
    "name", [b"\xc9MSCR\0", b"\xc8Micro", b"\xc8A\0B\0", b"\xc8" + b"A" * 32 + b"\0", b"\xc8\xff\0"]
)
def test_a_name_that_is_none_is_refused(name: bytes) -> None:
    with pytest.raises(WireError):
        conf.decode_name(0xC8, name)


def test_maxima_and_parameters() -> None:
    maxima = Maxima(3, 16383, (0,) * 8, 0, (16383, 16383, 8191, 4095, 4095, 0))
    assert conf.decode_maxima(MAXIMA) == maxima
    assert conf.encode(Code.MAXIMA, *astuple(maxima)) == MAXIMA
    assert maxima.turns == (16384, 16384, 8192, 4096, 4096, 0)
    parameters = conf.decode_parameters(PARAMETERS)
    assert conf.encode(Code.PARAMETERS, *astuple(parameters)) == PARAMETERS
    assert parameters.d == (8300, -878, -3, 9244, 320, -5274)
    assert conf.decode(Code.EXTENDED, EXTENDED) == (3,)
    assert conf.encode(Code.EXTENDED, 3) == EXTENDED
    assert conf.decode(Code.EXTENDED, bytes.fromhex("D3 02 FFFD")) == (-3,)
    with pytest.raises(WireError, match="doesn't fit"):
        conf.encode(Code.EXTENDED, 40000)


@pytest.mark.parametrize(
    ("reply", "message", "another_length"),
    [
        (PARAMETERS[:-1], "has 35 bytes, not the 36", False),
        (b"\xc0\x26" + PARAMETERS[2:] + b"\0\0", "says it has 38 bytes; 36 are understood", True),
        (b"\xc0", "says it has no bytes", True),
        (EXTENDED, "begin with C0", False),
    ],
)
def test_a_parameter_block_of_another_length_is_refused_and_told_from_a_short_one(
    reply: bytes, message: str, another_length: bool
) -> None:
    with pytest.raises(WireError, match=message) as refused:
        conf.decode_parameters(reply)
    assert isinstance(refused.value, BlockLengthError) is another_length


def test_the_stream_command_has_25_bytes_or_27() -> None:
    fixed = StreamRequest(10, 0x03)
    assert conf.encode(Code.STREAM, *astuple(fixed)) == bytes.fromhex("CF 000A 03") + bytes(21)
    assert fixed.fixed_rate
    sevenfold = StreamRequest(258, 0x02, 3, (1, 2, 3, 4, 5, 6, 7, 8), (1, 2, 3, 4, 5, 6, 7))
    data = conf.encode(Code.STREAM, *astuple(sevenfold))
    assert len(data) == 27
    assert conf.decode_stream(data) == sevenfold
    assert not sevenfold.fixed_rate


@pytest.mark.parametrize(
    ("code", "reply"), REPLIES.items(), ids=[f"{code:02X}" for code in REPLIES]
)
def test_where_a_reply_ends_whole_byte_by_byte_and_with_what_follows(
    code: int, reply: bytes
) -> None:
    assert conf.reply_length(code, reply) == len(reply)
    assert {conf.reply_length(code, reply[:end]) for end in range(len(reply))} == {None}
    assert conf.reply_length(code, reply + AT_REST) == len(reply)


def test_a_name_without_an_end_is_given_up_after_its_longest() -> None:
    assert conf.reply_length(0xC8, b"\xc8" + b"A" * 31) is None
    assert conf.reply_length(0xC8, b"\xc8" + b"A" * 40) == 33


# The session

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


@pytest.mark.parametrize("byte", [0xC3, 0xC7, 0xD0, 0xD1])
def test_eeprom_writes_are_refused_with_bit_7_and_without(byte: int) -> None:
    for state in State:
        with pytest.raises(WireError, match="EEPROM"):
            wire.refuse_forbidden(bytes([0xC5, byte]), state)
    for state in (S, M):
        with pytest.raises(WireError, match="EEPROM"):
            wire.refuse_forbidden(bytes([byte & 0x7F]), state)
    wire.refuse_forbidden(wire.SYNC + wire.BEGIN, F)


@pytest.mark.parametrize(
    "data",
    [bytes.fromhex("CF 0042 03") + bytes(21), b"\xd2\x45", b"\xcf\x00\x0a\x03\x00\xc2" + bytes(19)],
)
def test_what_follows_a_command_in_a_session_may_not_configure(data: bytes) -> None:
    for state in (S, M):
        with pytest.raises(WireError, match="if the byte before it were lost"):
            wire.refuse_forbidden(data, state)
    wire.refuse_forbidden(bytes([Code.END]) + wire.SYNC, F)


# The 14-bit clock

TICK_S, WRAP = 0.001111, 16384  # of the sheet


@given(
    st.integers(0, WRAP - 1),
    st.lists(st.tuples(st.integers(0, 200_000), st.floats(0.0, 4.0)), min_size=1, max_size=30),
)
def test_any_steps_add_up_whatever_the_hosts_delays(
    first: int, steps: list[tuple[int, float]]
) -> None:
    arm, made = ArmTime(), 0
    assert arm.seconds(first, 0.0) == 0.0
    for step, late_s in steps:
        made += step
        assert arm.seconds((first + made) % WRAP, made * TICK_S + late_s) == pytest.approx(
            made * TICK_S
        )
