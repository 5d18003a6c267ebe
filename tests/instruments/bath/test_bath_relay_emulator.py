"""The emulated relay of a pump: bytes as public notes on such boards print them, the plant's pump
behind, and what goes wrong.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from instruments.bath.driver import Bath, PumpAt
from instruments.bath.emulator import BathEmulator, Framing
from instruments.bath.profile import load_profile, load_relay, relay_names
from instruments.bath.relay_emulator import POWER_CUT, RELAY_FAULTS, RelayEmulator
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LinkError
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant, PlantConstants
from tests.instruments.bath.far_end import rtu

SCHEMES = {"tcp": "tcp", "rtu": "rtu+tcp"}


class Deaf:
    """A port that keeps what is sent."""

    def __init__(self) -> None:
        self.sent = b""

    def write(self, data: bytes) -> None:
        self.sent += data

    def hang_up(self) -> None:
        """Nobody is there."""

    def baud(self) -> int | None:
        return None


class Asked:
    """A relay and one host, by the byte."""

    def __init__(self, framing: Framing) -> None:
        self.clock, self.plant, self.port = VirtualClock(), Plant(1), Deaf()
        self.plant.fit(circulator=False)
        self.relay = RelayEmulator(
            self.plant, load_relay("modbus-relay"), self.clock, framing=framing
        )
        self.host = Connection(self.port, self.clock, threading.RLock())  # type: ignore[arg-type]
        self.relay.connect(self.host)

    def ask(self, frame: bytes) -> bytes:
        self.port.sent = b""
        self.clock.sleep(0.1)
        self.relay.receive(self.host, frame)
        return self.port.sent


def test_one_ships() -> None:
    assert relay_names() == ["modbus-relay"]
    profile = load_relay("modbus-relay")
    assert [(row.name, row.table, row.address, row.evidence) for row in profile.rows] == [
        ("pump", "coil", 0, "FIELD")
    ]
    assert (profile.functions, profile.baud, profile.parity, profile.transports) == (
        (1, 5),
        9600,
        "N",
        ("rtu", "tcp"),
    )


def test_bytes_as_they_are_printed_for_such_boards() -> None:
    board = Asked("rtu")
    for question, answer, turns in (
        ("01 05 00 00 FF 00 8C 3A", "01 05 00 00 FF 00 8C 3A", True),
        ("01 01 00 00 00 01 FD CA", "01 01 01 01 90 48", True),
        ("01 05 00 00 00 00 CD CA", "01 05 00 00 00 00 CD CA", False),
        ("01 01 00 00 00 01 FD CA", "01 01 01 00 51 88", False),
    ):
        assert board.ask(bytes.fromhex(question)) == bytes.fromhex(answer)
        assert (board.plant.pump == "on") == turns
        assert board.plant.pump_on == turns


def test_the_same_over_tcp() -> None:
    board = Asked("tcp")
    assert board.ask(bytes.fromhex("0001 0000 0006 01 05 0000 FF00")) == bytes.fromhex(
        "0001 0000 0006 01 05 0000 FF00"
    )
    assert board.ask(bytes.fromhex("0002 0000 0006 01 01 0000 0001")) == bytes.fromhex(
        "0002 0000 0004 01 01 01 01"
    )


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("01 05 0001 FF00", "01 85 02"),  # another relay than the profile has
        ("01 05 0000 1234", "01 85 03"),
        ("01 03 0000 0001", "01 83 02"),  # no registers
        ("01 07", "01 87 01"),
        ("02 05 0000 FF00", ""),
    ],
)
def test_what_it_does_not_do(question: str, answer: str) -> None:
    board = Asked("rtu")
    assert board.ask(rtu(question)) == (rtu(answer) if answer else b"")
    assert board.plant.pump == "off"


# ---- through the driver, beside a controller without a pump


@contextmanager
def bath_and_relay(
    family: str, framing: Framing
) -> Iterator[tuple[Bath, BathEmulator, RelayEmulator, VirtualClock]]:
    clock, lock = VirtualClock(), threading.RLock()
    plant, profile, board = (
        Plant(1, constants=PlantConstants(sensor_noise_k=0.0)),
        load_profile(family),
        load_relay("modbus-relay"),
    )
    emulator = BathEmulator(plant, profile, clock)
    relay = RelayEmulator(plant, board, clock, framing=framing)
    with (
        closing(Listener(emulator, clock, lock=lock, name="bath")) as bath_port,
        closing(Listener(relay, clock, lock=lock, name="pump")) as pump_port,
        closing(
            Bath(
                f"{SCHEMES[emulator.framing]}://127.0.0.1:{bath_port.port}",
                profile,
                clock,
                pump=PumpAt(f"{SCHEMES[framing]}://127.0.0.1:{pump_port.port}", board),
            )
        ) as bath,
    ):
        yield bath, emulator, relay, clock


FAMILIES = ["eurotherm-2400", "eurotherm-3200", "watlow-pm-map1", "watlow-pm-map2", "omega-cn7"]


@pytest.mark.parametrize("framing", ["tcp", "rtu"])
@pytest.mark.parametrize("family", FAMILIES)
def test_no_heat_before_the_pump_turns(family: str, framing: Framing) -> None:
    with bath_and_relay(family, framing) as (bath, emulator, _, clock):
        plant = emulator.plant
        assert bath.pump == "own"
        with pytest.raises(DeviceError, match="not started: the pump is off"):
            bath.start(33.0)
        assert (plant.running, plant.pump_on) == (False, False)
        bath.set("pump", "on")
        assert plant.pump_on
        bath.start(33.0)
        clock.sleep(1800.0)
        assert bath.read().temp_c == pytest.approx(33.0, abs=0.15)
        assert float(plant.teat_c.min()) == pytest.approx(33.0 - 0.32, abs=0.1)
        bath.safe()
        assert (plant.running, plant.pump_on) == (False, True)
        bath.set("pump", "off")
        assert not plant.pump_on


WIRED: list[tuple[str, Framing]] = [
    *((fault, "rtu") for fault in RELAY_FAULTS if fault != POWER_CUT),
    *((fault, "tcp") for fault in RELAY_FAULTS if fault not in (POWER_CUT, "bad CRC")),
]


@pytest.mark.parametrize(("fault", "framing"), WIRED)
def test_whatever_is_wrong_with_its_wire_no_wrong_state_is_told(
    fault: str, framing: Framing
) -> None:
    with bath_and_relay("eurotherm-3200", framing) as (bath, emulator, relay, clock):
        for label in ("on", "off", "on"):
            relay.fault(fault)
            try:
                bath.set("pump", label)
                assert emulator.plant.pump == label
                assert bath.get("pump") == float(label == "on")
            except InstrumentError:
                with pytest.raises(InstrumentError):
                    bath.start(33.0)
                assert not emulator.plant.running, "heat without a pump that is known to be on"
            relay.fault(fault, on=False)
            clock.sleep(10.0)
            bath.set("pump", label)
            assert bath.get("pump") == float(label == "on")
        assert relay.faults == frozenset()


@pytest.mark.parametrize("framing", ["tcp", "rtu"])
def test_a_power_cut_opens_the_contact_and_is_told(framing: Framing) -> None:
    with bath_and_relay("omega-cn7", framing) as (bath, emulator, relay, _):
        bath.set("pump", "on")
        relay.fault(POWER_CUT)
        assert relay.faults == {POWER_CUT}
        assert not emulator.plant.pump_on
        with pytest.raises(LinkError):
            bath.get("pump")
        bath.safe()  # the heater does not wait for the pump
        relay.fault(POWER_CUT, on=False)
        assert bath.get("pump") == 0.0, "it stays off until somebody switches it"
        bath.set("pump", "on")
        assert emulator.plant.pump_on


def test_faults_that_it_can_not_have_are_refused() -> None:
    board = Asked("tcp")
    with pytest.raises(
        ValueError, match="the pump's relay speaks Modbus TCP, which has no check sum"
    ):
        board.relay.fault("bad CRC")
    with pytest.raises(ValueError, match="no fault 'low level'; there are silence"):
        board.relay.fault("low level")
    with pytest.raises(ValueError, match="no framing 'ascii'"):
        RelayEmulator(Plant(1), load_relay("modbus-relay"), VirtualClock(), framing="ascii")  # type: ignore[arg-type]
