"""Bytes of the arm: golden ones typed from the fact sheet, round trips, and garbage."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import Maxima, Parameters, StreamRequest
from instruments.microscribe.protocol import Code, Packet, PacketDecoder, WireError

AT_REST = bytes.fromhex("83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60")
MAXIMA = bytes.fromhex("C6 03 3FFF 00 00 00 00 00 00 00 00 00 3FFF 3FFF 1FFF 0FFF 0FFF 0000")
PARAMETERS = bytes.fromhex(
    "C0 24 0000 3FF5 FFF9 3FE5 C002 C00C 0000 03C0 2810 0215 FE6F 018F 206C FC92 FFFD 241C 0140"
    " EB66"
)
EXTENDED = bytes.fromhex("D3 02 0003")
NAMES = {
    0xC8: "MicroScribe3D",
    0xC9: "MSCR",
    0xCA: "DX",
    0xCB: "40937",
    0xCC: "Standard+Beta",
    0xCD: "Format DH0.5",
    0xCE: "HCI 2.0",
}
REST = Packet(0x03, 0, (13903, 6238, 6868, 4098, 3193, 8416))


def whole(data: bytes) -> Iterable[bytes]:
    return [data]


def byte_by_byte(data: bytes) -> Iterable[bytes]:
    return [data[i : i + 1] for i in range(len(data))]


def with_trailing(data: bytes) -> Iterable[bytes]:
    return [data + b"\x83\x00\x6c"]


@pytest.mark.parametrize("cut", [whole, byte_by_byte, with_trailing])
@pytest.mark.parametrize("command", [None, wire.POLL])
def test_the_recorded_packet_three_ways(
    cut: Callable[[bytes], Iterable[bytes]], command: int | None
) -> None:
    decoder = PacketDecoder(command)
    packets = [packet for piece in cut(AT_REST) for packet in decoder.feed(piece)]
    assert packets == [REST]
    assert decoder.damaged == 0
    assert decoder.pending == (3 if cut is with_trailing else 0)


def test_the_recorded_packet_is_what_we_encode() -> None:
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


def test_a_time_stamp_and_analogs_come_before_the_encoders() -> None:
    # 0x25: stamp, two analogs, five encoders. Analog 0xFF is 7F and low bit 1, at bit 6; 0x80 is 40
    # and low bit 0.
    data = bytes.fromhex("A5 02 01 02 7F 40 40 00 01 00 02 00 03 00 04 00 05")
    assert PacketDecoder().feed(data) == [
        Packet(0x25, 2, (1, 2, 3, 4, 5), ticks=130, analogs=(0xFF, 0x80))
    ]


def test_the_eighth_analog_has_no_low_bit() -> None:
    packet = Packet(0x0C, 0, (), analogs=(255,) * 8)
    assert PacketDecoder().feed(wire.encode_packet(packet)) == [
        Packet(0x0C, 0, (), analogs=(255,) * 7 + (254,))
    ]


@pytest.mark.parametrize(
    "packet", [Packet(0x03, 0, (1,) * 5), Packet(0x23, 0, (1,) * 6), Packet(0x07, 0, (1,) * 6)]
)
def test_a_packet_that_does_not_fit_its_command_is_refused(packet: Packet) -> None:
    with pytest.raises(WireError, match=f"command {packet.command:02X} has"):
        wire.encode_packet(packet)


def test_damage_costs_one_packet_and_is_counted() -> None:
    decoder = PacketDecoder(0x03)
    bad = AT_REST[:5] + b"\xde" + AT_REST[6:]
    assert decoder.feed(AT_REST + bad + AT_REST) == [REST, REST]
    assert decoder.damaged == 1


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


def kept(stream: bytes, cuts: list[int]) -> tuple[list[Packet], int]:
    """The packets of a stream in pieces, without those that were withdrawn; and how many came
    damaged.
    """
    decoder = PacketDecoder()
    got: list[Packet] = []
    for a, b in itertools.pairwise([0, *sorted(cuts), len(stream)]):
        withdrawn = decoder.withdrawn
        came = decoder.feed(stream[a:b])
        got = [*(got[:-1] if decoder.withdrawn > withdrawn else got), *came]
    return got, decoder.damaged


def test_an_unfinished_packet_is_given_up_by_reset() -> None:
    decoder = PacketDecoder(0x03)
    decoder.feed(AT_REST[:-1])
    decoder.reset()
    decoder.reset()
    assert decoder.feed(AT_REST[-1:] + AT_REST) == [REST]
    assert decoder.damaged == 1


def test_configuration_echoes_are_no_packets() -> None:
    assert PacketDecoder().feed(bytes([Code.HOME]) + bytes([Code.END]) + AT_REST) == [REST]


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    command = draw(st.integers(0, 63)) & ~wire.UNUSED
    fourteen = st.integers(0, 16383)
    count, channels = wire.encoder_count(command), wire.analog_count(command)
    return Packet(
        command,
        draw(st.integers(0, 127)),
        tuple(draw(st.lists(fourteen, min_size=count, max_size=count))),
        draw(fourteen) if command & wire.TIME_STAMP else None,
        tuple(
            draw(
                st.lists(
                    st.integers(0, 127).map(lambda v: v * 2), min_size=channels, max_size=channels
                )
            )
        ),
    )


@given(st.lists(packets(), max_size=8), st.data())
def test_any_packets_cut_anywhere_come_back(sent: list[Packet], data: st.DataObject) -> None:
    stream = b"".join(map(wire.encode_packet, sent))
    cuts = [0, *sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10))), len(stream)]
    decoder = PacketDecoder()
    assert [p for a, b in itertools.pairwise(cuts) for p in decoder.feed(stream[a:b])] == sent
    assert (decoder.damaged, decoder.pending) == (0, 0)


@given(st.binary(max_size=200), st.lists(st.integers(0, 200), max_size=5))
def test_after_any_garbage_the_second_packet_is_right(garbage: bytes, cuts: list[int]) -> None:
    stream = garbage + AT_REST + AT_REST
    places = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    decoder = PacketDecoder(0x03)
    got = [p for a, b in itertools.pairwise(places) for p in decoder.feed(stream[a:b])]
    assert got[-1] == REST
    assert decoder.pending == 0


@given(
    st.lists(st.one_of(st.binary(max_size=20), packets().map(wire.encode_packet)), max_size=6).map(
        b"".join
    ),
    st.data(),
)
def test_cutting_changes_nothing(data: bytes, drawn: st.DataObject) -> None:
    assert kept(data, []) == kept(data, drawn.draw(st.lists(st.integers(0, len(data)), max_size=4)))


# Configuration


@pytest.mark.parametrize(("code", "name"), NAMES.items())
def test_names(code: int, name: str) -> None:
    reply = bytes([code]) + name.encode("ascii") + b"\0"
    assert conf.decode_name(code, reply) == name
    assert conf.encode_name(code, name) == reply


def test_the_names_are_asked_in_the_makers_order() -> None:
    assert bytes(conf.NAMES) == bytes.fromhex("C8 C9 CA CB CC CD CE")


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"\xc9MSCR\0",
        b"\xc8MicroScribe",
        b"\xc8A\0B\0",
        b"\xc8" + b"A" * 32 + b"\0",
        b"\xc8\xff\0",
    ],
)
def test_a_name_that_is_none_is_refused(reply: bytes) -> None:
    with pytest.raises(WireError):
        conf.decode_name(0xC8, reply)


def test_maxima() -> None:
    maxima = Maxima(3, 16383, (0,) * 8, 0, (16383, 16383, 8191, 4095, 4095, 0))
    assert conf.decode_maxima(MAXIMA) == maxima
    assert conf.encode_maxima(maxima) == MAXIMA
    assert maxima.turns == (16384, 16384, 8192, 4096, 4096, 0)


def test_parameters() -> None:
    parameters = conf.decode_parameters(PARAMETERS)
    assert conf.encode_parameters(parameters) == PARAMETERS
    assert parameters.d == (8300, -878, -3, 9244, 320, -5274)
    assert parameters.d_mm[0] == pytest.approx(210.82)
    assert parameters.alpha_rad[4] == pytest.approx(-16382 / 32768 * math.pi)
    assert parameters.a_mm[2] == pytest.approx(260.5024)


def test_extended_parameters() -> None:
    assert conf.decode_extended(EXTENDED) == 3
    assert conf.encode_extended(3) == EXTENDED
    assert conf.decode_extended(bytes.fromhex("D3 02 FFFD")) == -3


@pytest.mark.parametrize("reply", [MAXIMA[:-1], MAXIMA + b"\0", b"\xc0" + MAXIMA[1:], b""])
def test_maxima_of_another_shape_are_refused(reply: bytes) -> None:
    with pytest.raises(WireError):
        conf.decode_maxima(reply)


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (PARAMETERS[:-1], "has 35 bytes, not the 36"),
        (b"\xc0\x26" + PARAMETERS[2:] + b"\0\0", "says it has 38 bytes; 36"),
        (b"\xc0", "says it has no bytes"),
        (EXTENDED, "begin with C0"),
    ],
)
def test_a_parameter_block_of_another_length_is_refused(reply: bytes, message: str) -> None:
    with pytest.raises(WireError, match=message):
        conf.decode_parameters(reply)


SHORTS = st.lists(st.integers(-32768, 32767), min_size=6, max_size=6).map(tuple)


@given(SHORTS, SHORTS, SHORTS)
def test_any_parameters_come_back(
    alpha: tuple[int, ...], a: tuple[int, ...], d: tuple[int, ...]
) -> None:
    parameters = Parameters(alpha, a, d)
    assert conf.decode_parameters(conf.encode_parameters(parameters)) == parameters


@pytest.mark.parametrize(
    "decode", [conf.decode_maxima, conf.decode_parameters, conf.decode_extended, conf.decode_stream]
)
@given(
    st.sampled_from([b"", b"\xc6", b"\xc0", b"\xc0\x24", b"\xd3\x02", b"\xcf"]),
    st.binary(max_size=50),
)
def test_garbage_raises_nothing_but_ours(
    decode: Callable[[bytes], object], head: bytes, rest: bytes
) -> None:
    with contextlib.suppress(WireError):
        decode(head + rest)


def test_a_value_that_does_not_fit_is_refused() -> None:
    with pytest.raises(WireError, match="doesn't fit"):
        conf.encode_extended(40000)


def test_the_stream_command_has_25_bytes_or_27() -> None:
    fixed = StreamRequest(10, 0x03)
    assert conf.encode_stream(fixed) == bytes.fromhex("CF 000A 03") + bytes(21)
    assert fixed.fixed_rate
    sevenfold = StreamRequest(258, 0x02, 3, (1, 2, 3, 4, 5, 6, 7, 8), (1, 2, 3, 4, 5, 6, 7))
    data = conf.encode_stream(sevenfold)
    assert len(data) == 27
    assert conf.decode_stream(data) == sevenfold
    assert not sevenfold.fixed_rate
