"""The emulated controller by its bytes, over TCP and RTU, typed from the Modbus specification and the
fact sheet; and by an independent client.
"""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from instruments.bath.emulator import FAULTS
from instruments.bath.protocol import Frame, RtuReader, crc, framed
from tests.instruments.bath.devices import Asked, Wire

# ---- Modbus TCP


@pytest.fixture
def tcp() -> Asked:
    return Asked("julabo-presto", framing="tcp")


FAHRENHEIT = "00 1C 00 00 00 07 01 04 04 42 88 00 00"  # 68
LOW_WORD_FIRST = "00 1C 00 00 00 07 01 04 04 00 00 41 A0"
# bath, external; power and a gap; safety
POLLED = " 41 A0 00 00 41 A0 00 00 00 00 41 A0 00 00"


# transaction, protocol, length, unit | function ... ; 33.0 as float32 is 4204 0000 and 20.0 is 41A0
# 0000
@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        # bath temperature
        ("0001 0000 0006 01 04 000A 0002", "00 01 00 00 00 07 01 04 04 41 A0 00 00"),
        ("FFFF 0000 0006 01 03 0002 0002", "FF FF 00 00 00 07 01 03 04 41 A0 00 00"),  # set point
        ("0002 0000 0006 01 03 005A 0001", "00 02 00 00 00 05 01 03 02 00 00"),  # degC
        # remote control by Modbus
        ("0003 0000 0006 01 04 0005 0001", "00 03 00 00 00 05 01 04 02 00 04"),
        ("0004 0000 0006 01 04 0005 000C", "00 04 00 00 00 1B 01 04 18 00 04" + " 00" * 8 + POLLED),
        ("0005 0000 0006 01 06 0000 0001", "00 05 00 00 00 06 01 06 00 00 00 01"),  # start
        # set point 33
        ("0006 0000 000B 01 10 0002 0002 04 4204 0000", "00 06 00 00 00 06 01 10 00 02 00 02"),
        ("0007 0000 0006 01 04 000B 0001", "00 07 00 00 00 05 01 04 02 00 00"),  # half a float
        ("0008 0000 0006 02 04 000A 0002", ""),  # another unit: silence
        ("0009 0000 0006 00 04 000A 0002", ""),
        ("000A 0000 0006 01 04 0063 0001", "00 0A 00 00 00 03 01 84 02"),  # no such address
        ("000B 0000 0006 01 04 0018 0002", "00 0B 00 00 00 03 01 84 02"),  # the last one is outside
        ("000C 0000 0006 01 04 FFFF 0002", "00 0C 00 00 00 03 01 84 02"),
        ("000D 0000 0006 01 04 000A 0000", "00 0D 00 00 00 03 01 84 03"),  # no register at all
        ("000E 0000 0006 01 04 000A 007E", "00 0E 00 00 00 03 01 84 03"),  # 126 are too many
        ("000F 0000 0006 01 01 0000 0001", "00 0F 00 00 00 03 01 81 01"),  # coils it has none
        ("0010 0000 0002 01 2B", "00 10 00 00 00 03 01 AB 01"),
        ("0011 0000 0006 01 06 0000 0002", "00 11 00 00 00 03 01 86 03"),  # run = 2
        ("0012 0000 0006 01 06 0002 4204", "00 12 00 00 00 03 01 86 02"),  # floats need function 16
        ("0013 0000 0009 01 10 0002 0001 02 4204", "00 13 00 00 00 03 01 90 02"),  # half a float
        # not a number
        ("0014 0000 000B 01 10 0002 0002 04 7FC0 0000", "00 14 00 00 00 03 01 90 03"),
        ("0015 0000 0006 01 06 005A 0002", "00 15 00 00 00 03 01 86 03"),  # a unit that is none
        (
            "001B 0000 0006 01 06 005A 0001 001C 0000 0006 01 04 000A 0002",
            "00 1B 00 00 00 06 01 06 00 5A 00 01 " + FAHRENHEIT,
        ),
        (
            "001D 0000 0006 01 06 005D 0003 001C 0000 0006 01 04 000A 0002",
            "00 1D 00 00 00 06 01 06 00 5D 00 03 " + LOW_WORD_FIRST,
        ),
        # a byte is missing
        ("0016 0000 000A 01 10 0002 0002 04 4204 00", "00 16 00 00 00 03 01 90 03"),
        ("0017 0000 0005 01 04 000A 00", "00 17 00 00 00 03 01 84 03"),
        ("0018 0001 0006 01 04 000A 0002", ""),  # no Modbus: it hangs up
        ("0019 0000 FFFF 01 04 000A 0002", ""),
        ("001A 0000 0001 01", ""),
    ],
)
def test_bytes_on_the_wire(tcp: Asked, request_: str, answer: str) -> None:
    assert tcp.ask_tcp(request_) == answer


@pytest.mark.parametrize("request_", ["0018 0001 0006 01 04 000A 0002", "0019 0000 FFFF 01 04"])
def test_it_hangs_up_on_what_is_no_modbus(tcp: Asked, request_: str) -> None:
    assert tcp.wire.send(bytes.fromhex(request_)) == b""
    assert not tcp.wire.sink.open


def test_registers_written_together_are_all_or_nothing(tcp: Asked) -> None:
    wrong, right = (
        f"0001 0000 000F 01 10 0000 0004 08 0001 {code} 4204 0000" for code in ("0009", "0000")
    )
    assert tcp.ask_tcp(wrong) == "00 01 00 00 00 03 01 90 03"
    assert not tcp.plant.running
    assert tcp.ask_tcp(right) == "00 01 00 00 00 06 01 10 00 00 00 04"
    assert (tcp.plant.running, tcp.plant.set_point_c) == (True, 33.0)


def test_pump_stage_and_heating_limit_reach_the_plant(tcp: Asked) -> None:
    tcp.ask_tcp("0001 0000 0006 01 06 0034 0002 0002 0000 0006 01 06 0029 0028")
    assert tcp.plant.flow_l_per_min == pytest.approx(3.0)
    assert tcp.plant.output_max == pytest.approx(0.4)
    assert tcp.ask_tcp("0003 0000 0006 01 03 0034 0001") == "00 03 00 00 00 05 01 03 02 00 02"
    assert tcp.ask_tcp("0004 0000 0006 01 03 0029 0001") == "00 04 00 00 00 05 01 03 02 00 28"


@pytest.mark.parametrize(
    ("fault", "request_", "answer"),
    [
        ("gaps refused", "0001 0000 0006 01 04 0005 000D", "00 01 00 00 00 03 01 84 02"),
        # 68
        ("fahrenheit", "0001 0000 0006 01 04 000A 0002", "00 01 00 00 00 07 01 04 04 42 88 00 00"),
        ("word order", "0001 0000 0006 01 04 000A 0002", "00 01 00 00 00 07 01 04 04 00 00 41 A0"),
        (
            "sensor break",
            "0001 0000 0006 01 04 000A 0002",
            "00 01 00 00 00 07 01 04 04 7F C0 00 00",
        ),
        ("low level", "0001 0000 0006 01 04 0006 0001", "00 01 00 00 00 05 01 04 02 00 01"),
    ],
)
def test_faults_by_name(tcp: Asked, fault: str, request_: str, answer: str) -> None:
    healthy = tcp.ask_tcp(request_)
    tcp.emulator.fault(fault)
    tcp.clock.sleep(1.0)
    assert tcp.ask_tcp(request_) == answer != healthy
    tcp.emulator.fault(fault, on=False)
    tcp.plant.acknowledge()
    tcp.clock.sleep(1.0)
    assert tcp.ask_tcp(request_) == healthy
    assert tcp.emulator.faults == frozenset()


def test_an_unknown_fault_is_refused(tcp: Asked) -> None:
    with pytest.raises(ValueError, match="no fault 'gremlins'; there are silence, busy"):
        tcp.emulator.fault("gremlins")
    assert len(set(FAULTS)) == len(FAULTS)


def answers_to(*pieces: bytes) -> bytes:
    """What the device sends when its bytes come in these pieces."""
    asked = Asked("julabo-presto", framing="tcp")
    return b"".join(asked.wire.send(piece) for piece in pieces)


# fmt: off - a message a line
STREAM = bytes.fromhex(
    "0001 0000 0006 01 04 000A 00020002 0000 0006 01 03 005A 00010003 0000 000B 01 10 0002 0002 04"
    " 4204 00000004 0000 0006 01 03 0002 0002"
)
SAID = bytes.fromhex(
    "0001 0000 0007 01 04 04 41A0 00000002 0000 0005 01 03 02 00000003 0000 0006 01 10 0002"
    " 00020004 0000 0007 01 03 04 4204 0000"
)
# fmt: on


@pytest.mark.slow
@given(cuts=st.lists(st.integers(0, len(STREAM))))
def test_bytes_may_be_cut_anywhere(cuts: list[int]) -> None:
    edges = [0, *sorted(cuts), len(STREAM)]
    assert answers_to(*(STREAM[a:b] for a, b in itertools.pairwise(edges))) == SAID


# ---- Modbus RTU


@given(data=st.binary(max_size=256))
def test_another_implementation_agrees_on_every_check_sum(data: bytes) -> None:
    assert crc(data) == int.from_bytes(FramerRTU.compute_CRC(data).to_bytes(2, "big"), "little")


# fmt: off - a request a line: each function with a length of its own, and one that nobody knows
REQUESTS = [
    framed(1, bytes.fromhex(pdu))
    for pdu in (
        "03 0002 0002",
        "04 000A 0001",
        "06 0000 0001",
        "10 0002 0002 04 4204 0000",
        "05 0814 FF00",
        "0F 0000 0009 02 FF 01",
        "07",
        "08 0000 1234",
        "16 0004 00F2 0025",
        "17 0000 0001 0002 0001 02 0001",
        "11",
        "2B 0E 01 00",
    )
]
# fmt: on


def frames(pieces: list[bytes]) -> list[bytes]:
    reader = RtuReader()
    return [framed(frame.unit, frame.pdu) for piece in pieces for frame in reader.feed(piece, 0.0)]


@given(
    order=st.lists(st.sampled_from(REQUESTS[:-1]), min_size=1, max_size=4),
    cuts=st.lists(st.integers(0, 60)),
)
def test_rtu_may_be_cut_anywhere(order: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(order)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert frames([stream[a:b] for a, b in itertools.pairwise(edges)]) == order


@given(data=st.binary(max_size=600))
def test_garbage_never_crashes_it_and_silence_cures_it(data: bytes) -> None:
    reader = RtuReader()
    list(reader.feed(data, 0.0))
    assert list(reader.feed(REQUESTS[0], 0.06)) == [Frame(1, bytes.fromhex("03 0002 0002"))]


@given(at=st.integers(0, 7), bit=st.integers(0, 7))
def test_no_frame_with_a_flipped_bit_is_answered(at: int, bit: int) -> None:
    broken = bytearray(REQUESTS[0])
    broken[at] ^= 1 << bit
    assert frames([bytes(broken)]) == []


def test_after_a_broken_frame_it_is_deaf_until_the_line_was_quiet() -> None:
    reader = RtuReader()
    broken = REQUESTS[0][:-1] + b"\0"
    assert list(reader.feed(broken + REQUESTS[1], 0.0)) == []
    assert list(reader.feed(REQUESTS[1], 0.04)) == []
    assert len(list(reader.feed(REQUESTS[1], 0.10))) == 1


def test_a_count_that_no_frame_can_hold_is_no_frame() -> None:
    assert frames([bytes.fromhex("01 10 0002 0002 FF") + bytes(259)]) == []


@pytest.fixture
def rtu() -> Asked:
    return Asked("julabo-presto")


def said(pdu: str) -> str:
    return framed(1, bytes.fromhex(pdu)).hex(" ").upper()


TWENTY = "01 04 04 41 A0 00 00 EF 9A"  # check sum and all
ASKED = framed(1, bytes.fromhex("04 000A 0002"))


def shown(wire: Wire, request: bytes = ASKED) -> str:
    return wire.send(request).hex(" ").upper()


def test_rtu_on_the_wire(rtu: Asked) -> None:
    assert shown(rtu.wire) == TWENTY
    assert shown(rtu.wire, framed(1, bytes.fromhex("06 0000 0001"))) == "01 06 00 00 00 01 48 0A"
    assert rtu.plant.running
    write = framed(1, bytes.fromhex("10 0002 0002 04 4204 0000"))
    assert shown(rtu.wire, write) == "01 10 00 02 00 02 E0 08"
    assert rtu.plant.set_point_c == 33.0
    assert rtu.ask("04 0063 0001") == "84 02"
    assert rtu.ask("01 0000 0001") == "81 01"


@pytest.mark.parametrize(("unit", "acts"), [(2, False), (0, True)])
def test_another_unit_and_what_is_for_all_units(rtu: Asked, unit: int, acts: bool) -> None:
    """Unit 0 is for all: it is done, and not answered."""
    assert rtu.ask("06 0000 0001", unit=unit) == ""
    assert rtu.plant.running == acts


@pytest.mark.parametrize(
    ("fault", "answer"),
    [
        ("garbage", "00 01 04 04 41 A0 00 00 EF 9A"),
        ("bad CRC", "01 04 04 41 A0 00 00 EF 65"),
        ("silence", ""),
        ("busy", "01 84 06 C3 02"),
        ("wrong length", said("04 02 41A0")),
        ("surplus", said("04 06 41A0 0000 0000")),
        ("controller reset", ""),
        ("late answer", ""),
    ],
)
def test_faults_of_the_wire(rtu: Asked, fault: str, answer: str) -> None:
    rtu.emulator.fault(fault)
    assert fault in rtu.emulator.faults
    assert shown(rtu.wire) == answer
    rtu.emulator.fault(fault, on=False)
    assert rtu.emulator.faults == frozenset()
    if fault == "late answer":
        rtu.clock.sleep(1.499)
        assert rtu.wire.sink.got == b""
        rtu.clock.sleep(0.002)
        assert rtu.wire.sink.got.hex(" ").upper() == TWENTY
    assert shown(rtu.wire) == TWENTY


def test_the_garbage_is_not_always_the_same(rtu: Asked) -> None:
    rtu.emulator.fault("garbage")
    assert [shown(rtu.wire)[:2] for _ in range(5)] == ["00", "FF", "01", "03", "00"]


def test_a_new_connection_is_a_new_line(rtu: Asked) -> None:
    rtu.wire.send(ASKED[:4])
    assert shown(Wire(rtu.emulator, rtu.clock)) == TWENTY
