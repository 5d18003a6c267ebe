"""The emulated controller by its bytes, typed from the Modbus specification and the fact sheet, and
by an independent client.
"""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient

from instruments.bath import protocol
from instruments.bath.emulator import FAULTS, BathEmulator
from instruments.bath.profile import load_profile
from instruments.clock import VirtualClock
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant, PlantConstants


@dataclass
class Stand:
    plant: Plant
    emulator: BathEmulator
    listener: Listener
    clock: VirtualClock

    def runs(self) -> bool:
        return self.plant.running

    def ask(self, text: str, answers: int = 1) -> str:
        """Hex bytes to a fresh connection; hex of what comes back, which is nothing when it hangs
        up or stays silent.
        """
        with socket.create_connection(("127.0.0.1", self.listener.port), timeout=5.0) as link:
            link.sendall(bytes.fromhex(text))
            link.shutdown(socket.SHUT_WR)
            data = b""
            while more := link.recv(4096):
                data += more
        return data.hex(" ").upper()


@pytest.fixture
def stand() -> Iterator[Stand]:
    clock, plant = VirtualClock(), Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
    emulator = BathEmulator(plant, load_profile("julabo-presto"), clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    yield Stand(plant, emulator, listener, clock)
    listener.close()


FAHRENHEIT = "00 1C 00 00 00 07 01 04 04 42 88 00 00"  # 68
LOW_WORD_FIRST = "00 1C 00 00 00 07 01 04 04 00 00 41 A0"
# bath, external; power and a gap; safety
POLLED = " 41 A0 00 00 41 A0 00 00 00 00 00 00 41 A0 00 00"


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
        ("0004 0000 0006 01 04 0005 000D", "00 04 00 00 00 1D 01 04 1A 00 04" + " 00" * 8 + POLLED),
        ("0005 0000 0006 01 06 0000 0001", "00 05 00 00 00 06 01 06 00 00 00 01"),  # start
        # set point 33
        ("0006 0000 000B 01 10 0002 0002 04 4204 0000", "00 06 00 00 00 06 01 10 00 02 00 02"),
        ("0007 0000 0006 01 04 000B 0001", "00 07 00 00 00 05 01 04 02 00 00"),  # half a float
        ("0008 0000 0006 02 04 000A 0002", ""),  # another unit: silence
        ("0009 0000 0006 00 04 000A 0002", ""),
        ("000A 0000 0006 01 04 0063 0001", "00 0A 00 00 00 03 01 84 02"),  # no such address
        ("000B 0000 0006 01 04 0011 0002", "00 0B 00 00 00 03 01 84 02"),  # the last one is outside
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
def test_bytes_on_the_wire(stand: Stand, request_: str, answer: str) -> None:
    assert stand.ask(request_) == answer


def test_a_value_written_acts(stand: Stand) -> None:
    stand.ask("0001 0000 000B 01 10 0002 0002 04 4204 0000 0002 0000 0006 01 06 0000 0001")
    assert stand.runs()
    assert stand.plant.set_point_c == 33.0
    stand.clock.sleep(3600.0)
    stand.ask("0003 0000 0006 01 04 000A 0002")  # looking moves the plant on
    assert stand.plant.pv_c == pytest.approx(33.0, abs=0.05)
    stand.ask("0001 0000 0006 01 06 0000 0000")
    assert not stand.runs()


def test_registers_written_together_are_all_or_nothing(stand: Stand) -> None:
    assert (
        stand.ask("0001 0000 000F 01 10 0000 0004 08 0001 0009 4204 0000")
        == "00 01 00 00 00 03 01 90 03"
    )
    assert not stand.runs()
    assert (
        stand.ask("0001 0000 000F 01 10 0000 0004 08 0001 0000 4204 0000")
        == "00 01 00 00 00 06 01 10 00 00 00 04"
    )
    assert stand.runs()
    assert stand.plant.set_point_c == 33.0


def test_in_manual_mode_writes_are_confirmed_and_do_nothing(stand: Stand) -> None:
    stand.emulator.fault("manual mode")
    assert stand.ask("0001 0000 0006 01 06 0000 0001") == "00 01 00 00 00 06 01 06 00 00 00 01"
    assert not stand.runs()
    assert stand.ask("0002 0000 0006 01 04 0005 0001") == "00 02 00 00 00 05 01 04 02 00 00"


def test_digital_power_does_not_follow_the_set_point(stand: Stand) -> None:
    stand.ask("0001 0000 000F 01 10 0000 0004 08 0001 0001 4204 0000")
    stand.clock.sleep(600.0)
    stand.ask("0002 0000 0006 01 04 000A 0002")
    assert stand.plant.bath_c < 20.2


def test_pump_stage_and_heating_limit_reach_the_plant(stand: Stand) -> None:
    stand.ask("0001 0000 0006 01 06 0034 0002 0002 0000 0006 01 06 0029 0028")
    assert stand.plant.flow_l_per_min == pytest.approx(3.0)
    assert stand.plant.output_max == pytest.approx(0.4)
    assert stand.ask("0003 0000 0006 01 03 0034 0001") == "00 03 00 00 00 05 01 03 02 00 02"
    assert stand.ask("0004 0000 0006 01 03 0029 0001") == "00 04 00 00 00 05 01 03 02 00 28"


@pytest.mark.parametrize(
    ("fault", "request_", "answer"),
    [
        ("silence", "0001 0000 0006 01 04 000A 0002", ""),
        ("busy", "0001 0000 0006 01 04 000A 0002", "00 01 00 00 00 03 01 84 06"),
        ("wrong length", "0001 0000 0006 01 04 000A 0002", "00 01 00 00 00 05 01 04 02 41 A0"),
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
def test_faults_by_name(stand: Stand, fault: str, request_: str, answer: str) -> None:
    healthy = stand.ask(request_)
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    assert stand.ask(request_) == answer != healthy
    stand.emulator.fault(fault, on=False)
    stand.plant.acknowledge()
    stand.clock.sleep(1.0)
    assert stand.ask(request_) == healthy
    assert stand.emulator.faults == frozenset()


@pytest.mark.parametrize(
    ("fault", "attribute"),
    [
        ("stuck heater", "stuck_heater"),
        ("dead heater", "dead_heater"),
        ("pump stopped", "stopped_pump"),
    ],
)
def test_faults_of_the_plant(stand: Stand, fault: str, attribute: str) -> None:
    stand.emulator.fault(fault)
    assert getattr(stand.plant, attribute) is True
    stand.emulator.fault(fault, on=False)
    assert getattr(stand.plant, attribute) is False


def test_an_unknown_fault_is_refused(stand: Stand) -> None:
    with pytest.raises(ValueError, match="no fault 'gremlins'; there are silence, busy"):
        stand.emulator.fault("gremlins")
    assert len(set(FAULTS)) == len(FAULTS)


def test_an_independent_client_reads_and_writes(stand: Stand) -> None:
    with ModbusTcpClient("127.0.0.1", port=stand.listener.port, timeout=5, retries=0) as client:

        def number(registers: list[int]) -> object:
            return client.convert_from_registers(
                registers, client.DATATYPE.FLOAT32, word_order="big"
            )

        assert number(client.read_input_registers(10, count=2).registers) == 20.0
        registers = client.convert_to_registers(33.5, client.DATATYPE.FLOAT32, word_order="big")
        assert not client.write_registers(2, registers).isError()
        assert not client.write_register(0, 1).isError()
        assert number(client.read_holding_registers(2, count=2).registers) == 33.5
        assert stand.plant.set_point_c == 33.5
        stand.clock.sleep(60.0)
        assert 20.5 < float(str(number(client.read_input_registers(10, count=2).registers))) < 22.5
        assert client.read_input_registers(14, count=1).registers == [100]
        assert client.read_input_registers(99, count=1).exception_code == 2
        assert client.read_coils(0).exception_code == 1
        assert client.read_input_registers(0, count=2).registers == [0, 10400]


class Sink:
    """Takes what a device sends."""

    def __init__(self) -> None:
        self.got = b""
        self.open = True

    def send(self, data: bytes) -> None:
        self.got += data

    def hang_up(self) -> None:
        self.open = False


def answers_to(pieces: list[bytes]) -> bytes:
    """What the device sends when its bytes come in these pieces."""
    emulator = BathEmulator(Plant(1), load_profile("julabo-presto"), VirtualClock())
    sink = Sink()
    connection: Connection = sink  # type: ignore[assignment]
    emulator.connect(connection)
    for piece in pieces:
        emulator.receive(connection, piece)
    emulator.disconnect(connection)
    return sink.got


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


@given(cuts=st.lists(st.integers(0, len(STREAM))))
def test_bytes_may_be_cut_anywhere(cuts: list[int]) -> None:
    edges = [0, *sorted(cuts), len(STREAM)]
    assert answers_to([STREAM[a:b] for a, b in itertools.pairwise(edges)]) == SAID


def test_bytes_one_by_one_and_with_a_rest() -> None:
    assert answers_to([bytes((byte,)) for byte in STREAM]) == SAID
    assert answers_to([STREAM + STREAM[:5]]) == SAID


@settings(max_examples=300)
@given(pdu=st.binary(min_size=1, max_size=253))
def test_any_request_gets_one_whole_answer(pdu: bytes) -> None:
    answer = answers_to([protocol.Frame(1, b"", 7).answer(pdu)])
    assert int.from_bytes(answer[4:6], "big") == len(answer) - 6
    assert answer[:4] == bytes.fromhex("0007 0000")
    assert answer[6] == 1
    assert answer[7] & 0x7F == pdu[0] & 0x7F


@given(data=st.binary(max_size=600))
def test_garbage_never_crashes_it(data: bytes) -> None:
    answers_to([data])
