"""RTU as the emulator hears and speaks it: golden frames, bytes cut anywhere, broken frames,
silence on the line.
"""

from __future__ import annotations

import itertools
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_profile
from instruments.bath.protocol import Frame, RtuReader, crc, framed
from instruments.clock import VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant, PlantConstants

# From the serial-line guide (status query to unit 2) and Modbus primers that many a maker prints.
GOLDEN = [
    "02 07 41 12",
    "01 04 02 FF FF B8 80",
    "11 03 00 6B 00 03 76 87",
    "11 06 00 01 00 03 9A 9B",
    "11 05 00 AC FF 00 4E 8B",
]


@pytest.mark.parametrize("frame", GOLDEN)
def test_check_sums_as_printed(frame: str) -> None:
    data = bytes.fromhex(frame)
    assert framed(data[0], data[1:-2]) == data
    assert crc(data) == 0


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


@pytest.mark.parametrize("request_", REQUESTS)
def test_each_request_ends_where_it_ends(request_: bytes) -> None:
    assert frames([request_]) == [request_]
    assert frames([bytes((byte,)) for byte in request_]) == [request_]
    assert frames([request_, REQUESTS[0][:3]]) == [request_]


@given(
    order=st.lists(st.sampled_from(REQUESTS[:-1]), min_size=1, max_size=4),
    cuts=st.lists(st.integers(0, 60)),
)
def test_bytes_may_be_cut_anywhere(order: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(order)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert frames([stream[a:b] for a, b in itertools.pairwise(edges)]) == order


@given(data=st.binary(max_size=600))
def test_garbage_never_crashes_it_and_silence_cures_it(data: bytes) -> None:
    reader = RtuReader()
    list(reader.feed(data, 0.0))
    assert list(reader.feed(REQUESTS[0], 0.06)) == [Frame(1, bytes.fromhex("03 0002 0002"))]


@given(at=st.integers(0, 7), bit=st.integers(0, 7))
def test_no_frame_with_a_flipped_bit_is_heard(at: int, bit: int) -> None:
    broken = bytearray(REQUESTS[0])
    broken[at] ^= 1 << bit
    assert frames([bytes(broken)]) == []


def test_after_a_broken_frame_it_is_deaf_until_the_line_was_quiet() -> None:
    reader = RtuReader()
    broken = REQUESTS[0][:-1] + b"\0"
    assert list(reader.feed(broken + REQUESTS[1], 0.0)) == []
    assert list(reader.feed(REQUESTS[1], 0.04)) == []
    assert len(list(reader.feed(REQUESTS[1], 0.10))) == 1


def test_half_a_request_is_forgotten() -> None:
    reader = RtuReader()
    assert list(reader.feed(REQUESTS[0][:5], 0.0)) == []
    assert len(list(reader.feed(REQUESTS[1], 1.0))) == 1


def test_a_count_that_no_frame_can_hold_is_no_frame() -> None:
    assert frames([bytes.fromhex("01 10 0002 0002 FF") + bytes(259)]) == []


# ---- the server


class Wired:
    """An emulated bath that speaks RTU, and a link to it."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.plant = Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
        self.emulator = BathEmulator(
            self.plant, load_profile("julabo-presto"), self.clock, unit_id=1, framing="rtu"
        )
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="bath")
        self.link = Link(self.listener.url, self.clock, who="test")

    def ask(self, pdu: str, unit: int = 1) -> str:
        self.link.write(framed(unit, bytes.fromhex(pdu)))
        answer = self.link.receive(0.1)
        self.clock.sleep(0.1)
        return answer.hex(" ").upper()

    def close(self) -> None:
        self.link.close()
        self.listener.close()


@pytest.fixture
def wired() -> Wired:
    return Wired()


@pytest.fixture(autouse=True)
def tidy(wired: Wired) -> object:
    before = threading.active_count() - 2  # accepting, serving
    yield
    wired.close()
    assert threading.active_count() == before


def says(pdu: str) -> str:
    return framed(1, bytes.fromhex(pdu)).hex(" ").upper()


def test_bytes_on_the_wire(wired: Wired) -> None:
    assert wired.ask("04 000A 0002") == "01 04 04 41 A0 00 00 EF 9A"  # 20.0, check sum and all
    assert wired.ask("06 0000 0001") == "01 06 00 00 00 01 48 0A"
    assert wired.plant.running
    assert wired.ask("10 0002 0002 04 4204 0000") == "01 10 00 02 00 02 E0 08"
    assert wired.plant.set_point_c == 33.0
    assert wired.ask("04 0063 0001") == says("84 02")
    assert wired.ask("01 0000 0001") == says("81 01")


def test_another_unit_is_not_answered(wired: Wired) -> None:
    assert wired.ask("04 000A 0002", unit=2) == ""
    assert wired.ask("06 0000 0001", unit=2) == ""
    assert not wired.plant.running


def test_what_is_said_to_all_is_done_and_not_answered(wired: Wired) -> None:
    assert wired.ask("06 0000 0001", unit=0) == ""
    assert wired.plant.running


@pytest.mark.parametrize(
    ("fault", "answer"),
    [
        ("garbage", "00 01 04 04 41 A0 00 00 EF 9A"),
        ("bad CRC", "01 04 04 41 A0 00 00 EF 65"),
        ("silence", ""),
        ("busy", "01 84 06 C3 02"),
        ("wrong length", says("04 02 41A0")),
        ("surplus", says("04 06 41A0 0000 0000")),
        ("controller reset", ""),
        ("late answer", ""),
    ],
)
def test_faults_of_the_wire(wired: Wired, fault: str, answer: str) -> None:
    wired.emulator.fault(fault)
    assert fault in wired.emulator.faults
    assert wired.ask("04 000A 0002") == answer
    wired.emulator.fault(fault, on=False)
    if fault == "late answer":
        assert wired.link.receive(2.0).hex(" ").upper() == "01 04 04 41 A0 00 00 EF 9A"
        assert wired.clock.now() == pytest.approx(1.5)
    assert wired.emulator.faults == frozenset()
    assert wired.ask("04 000A 0002") == "01 04 04 41 A0 00 00 EF 9A"


def test_the_garbage_is_not_always_the_same(wired: Wired) -> None:
    wired.emulator.fault("garbage")
    assert [wired.ask("04 000A 0002")[:2] for _ in range(5)] == ["00", "FF", "01", "03", "00"]


def test_a_cable_that_comes_back_is_a_new_line(wired: Wired) -> None:
    wired.link.write(framed(1, bytes.fromhex("04 000A 0002"))[:4])
    wired.link.reopen()
    assert wired.ask("04 000A 0002") == "01 04 04 41 A0 00 00 EF 9A"


def test_a_port_that_drops_comes_back(wired: Wired) -> None:
    hosts: list[Connection] = list(wired.emulator._readers)
    hosts[0].hang_up()
    with pytest.raises(LinkError):
        wired.link.receive(1.0)
    wired.link.reopen()
    assert wired.ask("04 000A 0002") == "01 04 04 41 A0 00 00 EF 9A"
