"""The relay that switches a pump: the emulated one, by bytes as public notes on such boards print them;
and a driver with a relay on the controller's line and elsewhere."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import cycle
from pathlib import Path

import pytest

from instruments.bath.driver import OwnBath, PumpAt
from instruments.bath.emulator import POWER_CUT, BathEmulator, Framing, RelayEmulator
from instruments.bath.profile import RelayProfile, load_relay, relay_names
from instruments.clock import VirtualClock
from instruments.device_file import DeviceFileError
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.instruments.bath.devices import NO_PUMP, Stand, Wire, load_register_profile, url_of
from tests.instruments.bath.far_end import FarEnd, rtu, served
from tests.instruments.bath.test_bath_profile_rig import RELAY


class Asked:
    """A relay and one host, by the byte."""

    def __init__(self, framing: Framing) -> None:
        self.plant, clock = Plant(1), VirtualClock()
        self.plant.fit(circulator=False)
        self.relay = RelayEmulator(self.plant, load_relay("modbus-relay"), clock, framing=framing)
        self.ask = Wire(self.relay, clock).send


def test_one_ships() -> None:
    assert relay_names() == ["modbus-relay"]
    profile = load_relay("modbus-relay")
    assert [(row.name, row.table, row.address, row.evidence) for row in profile.rows] == [
        ("pump", "coil", 0, "FIELD")
    ]
    assert (profile.functions, profile.transports) == ((1, 5), ("rtu", "tcp"))
    assert (profile.baud, profile.parity) == (9600, "N")


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
) -> Iterator[tuple[OwnBath, BathEmulator, RelayEmulator, VirtualClock]]:
    board = load_relay("modbus-relay")
    with Stand(profile=load_register_profile(family)) as stand:
        relay = RelayEmulator(stand.plant, board, stand.clock, framing=framing)
        listener = Listener(relay, stand.clock, lock=threading.RLock(), name="pump")
        with closing(listener):
            bath = stand.bath(pump=PumpAt(url_of(relay, listener), board))
            yield bath, stand.emulator, relay, stand.clock
            bath.close()


@pytest.mark.parametrize(
    ("family", "framing"), [*zip(NO_PUMP, cycle(["tcp", "rtu"]), strict=False)]
)
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


def test_a_power_cut_opens_the_contact_and_is_reported() -> None:
    with bath_and_relay("omega-cn7", "rtu") as (bath, emulator, relay, _):
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


SHOWN = {0x1000: 200, 0x1001: 200, 0x0810: 1, 0x0811: 1}


@pytest.fixture
def relay(tmp_path: Path) -> RelayProfile:
    path = tmp_path / "relay.toml"
    path.write_text(RELAY, encoding="utf-8")
    return load_relay(path)


class Multidrop(FarEnd):
    """A controller at unit 1 and a relay at unit 5 on one line, each with a memory of its own."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__(clock)
        self.relay = FarEnd(clock)
        self.units: list[int] = []

    def answer_of(self, unit: int, pdu: bytes) -> bytes:
        self.units.append(unit)
        return super().answer(pdu) if unit == 1 else self.relay.answer(pdu)


@pytest.fixture
def line(relay: RelayProfile) -> Iterator[tuple[Multidrop, OwnBath]]:
    far_end = Multidrop(VirtualClock())
    far_end.memory = dict(SHOWN)
    with served(far_end) as url:
        pump, profile = PumpAt(f"{url}?unit=5", relay), load_register_profile("omega-cn7")
        bath = OwnBath(url, profile, far_end.clock, pump=pump)
        yield far_end, bath
        bath.close()


def test_on_one_line_the_relay_and_the_controller_share_a_link(
    line: tuple[Multidrop, OwnBath],
) -> None:
    far_end, bath = line
    assert bath.pump == "own"
    assert bath.get("pump") == 0.0
    with pytest.raises(DeviceError, match="not started: the pump is off"):
        bath.start(33.0)
    assert far_end.memory.get(0x0814, 0) == 0
    bath.set("pump", "on")
    bath.start(33.0)
    assert (far_end.relay.memory[2], far_end.memory[0x0814]) == (1, 1)
    bath.safe()
    assert (far_end.relay.memory[2], far_end.memory[0x0814]) == (1, 0)  # it may run on
    assert len(far_end.hosts) == 1
    assert {1, 5} == set(far_end.units)


def test_a_late_answer_of_the_relay_is_never_the_controllers(
    line: tuple[Multidrop, OwnBath],
) -> None:
    far_end, bath = line
    bath.set("pump", "on")
    for late_s in (1.2, 1.7, 2.5, 4.0):
        far_end.delays_s = [late_s]
        for name, right in (("pump", 1.0), ("run", 0.0), ("set_point", 20.0), ("pump", 1.0)):
            try:
                assert bath.get(name) == right
            except InstrumentError:
                far_end.clock.sleep(1.0)
        far_end.clock.sleep(10.0)


@contextmanager
def elsewhere(
    relay: RelayProfile, *, allow_inferred: bool = False
) -> Iterator[tuple[OwnBath, FarEnd]]:
    """A bath whose pump's relay, the far end, has a line of its own."""
    clock = VirtualClock()
    controller, box = FarEnd(clock), FarEnd(clock, framing="tcp")
    controller.memory = dict(SHOWN)
    with served(controller) as url, served(box) as pump_url:
        pump, profile = PumpAt(pump_url, relay), load_register_profile("omega-cn7")
        bath = OwnBath(url, profile, clock, pump=pump, allow_inferred=allow_inferred)
        yield bath, box
        bath.close()


def test_elsewhere_it_has_a_link_of_its_own_that_is_mended(relay: RelayProfile) -> None:
    with elsewhere(relay) as (bath, box):
        bath.set("pump", "on")
        box.hosts[0].hang_up()
        assert bath.get("pump") == 1.0
        assert box.memory == {2: 1}
        assert all(pdu[0] in (1, 5) for pdu in box.asked)


def test_what_a_relay_does_not_do_is_reported(relay: RelayProfile) -> None:
    with elsewhere(relay) as (bath, box):

        def forget(frame: bytes) -> bytes:
            box.memory.clear()
            return frame

        box.spoils = [bytes, forget]
        with pytest.raises(
            DeviceError, match=r"pump at .*did not do it \(asked pump = on, got pump = off\)"
        ):
            bath.set("pump", "on")
        with pytest.raises(LimitError, match="pump has no value 'fast'"):
            bath.set("pump", "fast")


def test_a_family_with_a_pump_takes_no_relay(relay: RelayProfile) -> None:
    pump, profile = PumpAt("tcp://127.0.0.1:2", relay), load_register_profile("julabo-presto")
    with pytest.raises(
        LimitError,
        match=r"JULABO PRESTO: its pump \(with run\) is the family's own, and no relay switches it",
    ):
        OwnBath("tcp://127.0.0.1:1", profile, VirtualClock(), pump=pump)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "pump"', 'name = "pomp"', "the row 'pump' is missing"),
        ("{ off = 0, on = 1 }", "{ no = 0, yes = 1 }", "the labels 'on' and 'off' are needed"),
        ("functions = [1, 5]", "functions = [1]", "none of the functions 1 writes bit"),
    ],
)
def test_a_relays_profile_is_checked(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "relay.toml"
    path.write_text(RELAY.replace(old, new), encoding="utf-8")
    with pytest.raises(DeviceFileError, match=message):
        load_relay(path)


def test_an_inferred_relay_is_not_switched_unless_the_rig_says_so(relay: RelayProfile) -> None:
    rows = tuple(row.model_copy(update={"evidence": "INFERRED"}) for row in relay.rows)
    doubtful = relay.model_copy(update={"rows": rows})
    with elsewhere(doubtful) as (bath, box):
        with pytest.raises(LimitError, match="only infers where pump is"):
            bath.set("pump", "on")
        assert box.memory == {}
    with elsewhere(doubtful, allow_inferred=True) as (bath, box):
        bath.set("pump", "on")
        assert box.memory == {2: 1}


@pytest.mark.parametrize("off", ["off", 0.0, 0])
def test_the_pump_is_not_switched_off_before_the_heater(
    line: tuple[Multidrop, OwnBath], off: float | str
) -> None:
    far_end, bath = line
    bath.set("pump", "on")
    bath.start(33.0)
    what = "the pump is not switched off while the controller is started"
    with pytest.raises(LimitError, match=f"{what}.*Put the controller into standby"):
        bath.set("pump", off)
    assert far_end.relay.memory[2] == 1
    bath.safe()
    bath.set("pump", off)
    assert far_end.relay.memory[2] == 0
