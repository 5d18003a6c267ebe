"""Where replies end, the commands that carry a byte or two, and what would be a command by
accident.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.microscribe import configuration as conf
from instruments.microscribe import errors, protocol
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import BlockLengthError
from instruments.microscribe.protocol import Code, Marker, Packet, PacketDecoder, State, WireError

AT_REST = bytes.fromhex("83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60")
REST = Packet(0x03, 0, (13903, 6238, 6868, 4098, 3193, 8416))
REPLIES = {
    0xC8: b"\xc8MicroScribe3D\0",
    0xCB: b"\xcb40937\0",
    0xCC: b"\xccStandard+Beta\0",
    0xC6: bytes.fromhex("C6 03 3FFF 00 00 00 00 00 00 00 00 00 3FFF 3FFF 1FFF 0FFF 0FFF 0000"),
    0xC0: bytes.fromhex(
        "C0 24 0000 3FF5 FFF9 3FE5 C002 C00C 0000 03C0 2810 0215 FE6F 018F 206C FC92 FFFD 241C 0140"
        " EB66"
    ),
    0xD3: bytes.fromhex("D3 02 0003"),
    0xC2: b"\xc2",
    0xC4: b"\xc4",
    0xC5: b"\xc5",
    0xCF: b"\xcf",
    0xD2: b"\xd2\xa3",
}


@pytest.mark.parametrize(
    ("code", "reply"), REPLIES.items(), ids=[f"{code:02X}" for code in REPLIES]
)
def test_where_a_reply_ends_whole_byte_by_byte_and_with_what_follows(
    code: int, reply: bytes
) -> None:
    assert conf.reply_length(code, reply) == len(reply)
    assert [conf.reply_length(code, reply[:end]) for end in range(len(reply))] == [None] * len(
        reply
    )
    assert conf.reply_length(code, reply + AT_REST) == len(reply)


def test_a_name_without_an_end_is_given_up_after_its_longest() -> None:
    assert conf.reply_length(0xC8, b"\xc8" + b"A" * 31) is None
    assert conf.reply_length(0xC8, b"\xc8" + b"A" * 40) == 33
    with pytest.raises(WireError, match="32 bytes at most"):
        conf.decode_name(0xC8, b"\xc8" + b"A" * 32)


def test_another_length_of_a_block_is_told_from_a_short_one() -> None:
    with pytest.raises(BlockLengthError, match="38 bytes; 36 are understood"):
        conf.decode_parameters(b"\xc0\x26" + bytes(38))
    with pytest.raises(WireError) as short:
        conf.decode_parameters(b"\xc0\x24" + bytes(35))
    assert not isinstance(short.value, BlockLengthError)


# Rates


@pytest.mark.parametrize(
    ("baud", "code"),
    [
        (115200, 0x00),
        (57600, 0x01),
        (28800, 0x02),
        (14400, 0x03),
        (38400, 0x10),
        (19200, 0x11),
        (9600, 0x12),
    ],
)
def test_the_rates_of_the_sheet(baud: int, code: int) -> None:
    assert protocol.encode_set_baud(baud) == bytes([0xC4, code])
    assert protocol.decode_set_baud(bytes([0xC4, code])) == baud


@pytest.mark.parametrize("data", [b"", b"\xc4", b"\xc4\x04", b"\xc4\x00\x00", b"\xc5\x00"])
def test_a_rate_that_is_none_is_refused(data: bytes) -> None:
    with pytest.raises(WireError, match="a rate is"):
        protocol.decode_set_baud(data)
    with pytest.raises(WireError, match="no rate 300"):
        protocol.encode_set_baud(300)


# Markers


def test_markers_keep_their_place_among_packets() -> None:
    decoder = PacketDecoder(0x03, markers=True)
    # a marker's byte may look like a header
    stream = AT_REST + b"\xd2\x83" + AT_REST + b"\xd2\x00" + AT_REST
    assert decoder.feed_all(stream) == [REST, Marker(0x83), REST, Marker(0), REST]
    assert decoder.damaged == 0


@given(
    st.lists(st.one_of(st.just(REST), st.builds(Marker, st.integers(0, 255))), max_size=10),
    st.lists(st.integers(0, 150), max_size=8),
)
def test_markers_and_packets_cut_anywhere_come_back(
    items: list[Packet | Marker], cuts: list[int]
) -> None:
    stream = b"".join(
        AT_REST if isinstance(item, Packet) else protocol.encode_marker(item) for item in items
    )
    places = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    decoder = PacketDecoder(0x03, markers=True)
    assert [
        item for a, b in itertools.pairwise(places) for item in decoder.feed_all(stream[a:b])
    ] == items
    assert (decoder.damaged, decoder.pending) == (0, 0)


@pytest.mark.parametrize(
    "cut",
    [lambda data: [data], lambda data: [data[i : i + 1] for i in range(len(data))]],
    ids=["whole", "by byte"],
)
def test_who_waits_for_no_marker_takes_none(cut: Callable[[bytes], Iterable[bytes]]) -> None:
    decoder = PacketDecoder(0x03)
    assert [packet for piece in cut(b"\xd2\x07" + AT_REST) for packet in decoder.feed(piece)] == [
        REST
    ]


def test_a_marker_is_a_byte() -> None:
    assert protocol.decode_marker(b"\xd2\xff") == Marker(255)
    for data in (b"\xd2", b"\xd2\x00\x00", b"\xc2\x00", b""):
        with pytest.raises(WireError, match="a marker is"):
            protocol.decode_marker(data)
    with pytest.raises(WireError, match="not 256"):
        protocol.encode_marker(Marker(256))


# What would be a command by accident


@given(st.floats(0.0, 100.0))
def test_no_delay_configures_anything_and_none_is_longer_than_asked(period_s: float) -> None:
    delay = protocol.harmless_delay_ms(period_s)
    assert 1 <= delay <= max(1.0, period_s * 1000 + 1e-5)
    assert all(
        wire.event_of(byte) is not wire.Event.CONFIGURE and not byte & wire.CONFIGURE
        for byte in delay.to_bytes(2, "big")
    )


@pytest.mark.parametrize(
    ("period_s", "delay_ms"),
    [(0.01, 10), (0.001, 1), (0.0001, 1), (0.063, 63), (0.066, 63), (0.1, 63), (0.13, 130)],
)
def test_delays(period_s: float, delay_ms: int) -> None:
    assert protocol.harmless_delay_ms(period_s) == delay_ms


@pytest.mark.parametrize(
    "data",
    [bytes.fromhex("CF 0042 03") + bytes(21), b"\xd2\x45", b"\xcf\x00\x0a\x03\x00\xc2" + bytes(19)],
)
def test_what_follows_a_command_in_a_session_may_not_configure(data: bytes) -> None:
    for state in (State.SESSION, State.STREAMING):
        with pytest.raises(WireError, match="if the byte before it were lost"):
            wire.refuse_forbidden(data, state)
    wire.refuse_forbidden(bytes([Code.END]) + wire.SYNC, State.FINDING_BAUD)


# Who else may answer


@pytest.mark.parametrize(
    ("seen", "hint"),
    [
        (b"\r\nGrbl 1.1h ['$' for help]\r\n", "GRBL board"),
        (b"\xc5IMMC", "sends back what it hears"),
        (b"ok\r\nok\r\n", "motion controller"),
        (bytes.fromhex("01 83 02 C0 F1"), "Modbus"),
        (bytes.fromhex("FE FE 01 04 02 FF FF B8 80"), "Modbus"),
        (b"23.05\r\n", "plain text"),
        (bytes.fromhex("F8 80 00 FC FE"), "baud rate"),
        (b"A", "baud rate"),
    ],
)
def test_a_guess_at_who_answers(seen: bytes, hint: str) -> None:
    assert hint in errors.what_to_try(seen)
    assert errors.known(seen) is (hint != "baud rate")
