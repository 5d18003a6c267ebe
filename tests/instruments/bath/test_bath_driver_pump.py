"""A pump with a relay of its own, on the controller's line and elsewhere; and what is said where
there is no such thing.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.rig.loading import load_rig
from instruments.bath.driver import Bath, PumpAt
from instruments.bath.profile import ProfileError, RelayProfile, load_profile, load_relay
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LimitError
from tests.instruments.bath.far_end import FarEnd, served
from tests.instruments.bath.test_bath_profile_rig import (
    change,
    rig,  # noqa: F401 - a fixture
)

RELAY = """
family = "Relay box"
source = "made up for these tests"
transports = ["rtu", "tcp"]
functions = [1, 5]
unit_id = 5

[[rows]]
name = "pump"
table = "coil"
address = 2
type = "bit"
access = "rw"
values = { off = 0, on = 1 }
evidence = "CERTAIN"
"""
OMEGA = {0x1000: 200, 0x1001: 200}


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
def line() -> Iterator[tuple[Multidrop, str]]:
    far_end = Multidrop(VirtualClock())
    far_end.memory = dict(OMEGA)
    with served(far_end) as url:
        yield far_end, url


def test_on_one_line_the_relay_and_the_controller_share_a_link(
    line: tuple[Multidrop, str], relay: RelayProfile
) -> None:
    far_end, url = line
    bath = Bath(url, load_profile("omega-cn7"), far_end.clock, pump=PumpAt(f"{url}?unit=5", relay))
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
    bath.close()


def test_a_late_answer_of_the_relay_is_never_the_controllers(
    line: tuple[Multidrop, str], relay: RelayProfile
) -> None:
    far_end, url = line
    bath = Bath(url, load_profile("omega-cn7"), far_end.clock, pump=PumpAt(f"{url}?unit=5", relay))
    bath.set("pump", "on")
    for late_s in (1.2, 1.7, 2.5, 4.0):
        far_end.delays_s = [late_s]
        for name, right in (("pump", 1.0), ("run", 0.0), ("set_point", 20.0), ("pump", 1.0)):
            try:
                assert bath.get(name) == right
            except InstrumentError:
                far_end.clock.sleep(1.0)
        far_end.clock.sleep(10.0)
    bath.close()


def test_elsewhere_it_has_a_link_of_its_own_that_is_mended(relay: RelayProfile) -> None:
    clock = VirtualClock()
    controller, box = FarEnd(clock), FarEnd(clock, framing="tcp")
    controller.memory = dict(OMEGA)
    with served(controller) as url, served(box) as pump_url:
        bath = Bath(url, load_profile("omega-cn7"), clock, pump=PumpAt(pump_url, relay))
        bath.set("pump", "on")
        box.hosts[0].hang_up()
        assert bath.get("pump") == 1.0
        assert box.memory == {2: 1}
        assert all(pdu[0] in (1, 5) for pdu in box.asked)
        bath.close()


def test_what_a_relay_does_not_do_is_told(relay: RelayProfile) -> None:
    clock = VirtualClock()
    controller, box = FarEnd(clock), FarEnd(clock, framing="tcp")
    controller.memory = dict(OMEGA)
    with served(controller) as url, served(box) as pump_url:
        bath = Bath(url, load_profile("omega-cn7"), clock, pump=PumpAt(pump_url, relay))

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
        bath.close()


def test_a_family_with_a_pump_takes_no_relay(relay: RelayProfile) -> None:
    with pytest.raises(
        LimitError,
        match=r"JULABO PRESTO: its pump \(with run\) is the family's own, and no relay switches it",
    ):
        Bath(
            "tcp://127.0.0.1:1",
            load_profile("julabo-presto"),
            VirtualClock(),
            pump=PumpAt("tcp://127.0.0.1:2", relay),
        )


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
    with pytest.raises(ProfileError, match=message):
        load_relay(path)


PUMP = 'pump_url = "/dev/ttyUSB1?unit=5"\npump_profile = "relay.toml"\n'
REAL = {
    "operator": "console:",
    "arm": "COM1",
    "bath": "COM3?parity=E",
    "stage": "COM2",
    "cameras": "opencv:0,1,2",
}


@pytest.fixture
def real_rig(rig: Path) -> Path:  # noqa: F811 - the fixture
    """A rig of real instruments, with an Omega and its pump's relay."""
    rig.with_name("relay.toml").write_text(RELAY, encoding="utf-8")
    for name, url in REAL.items():
        change(rig, f'[{name}]\nurl = "emulator:"', f'[{name}]\nurl = "{url}"')
    change(rig, 'profile = "own.toml"', f'profile = "omega-cn7"\n{PUMP}')
    return rig


def test_a_pump_in_the_rig_file(real_rig: Path) -> None:
    loaded = load_rig(real_rig)
    assert loaded.relay is not None
    assert loaded.relay.family == "Relay box"
    assert loaded.rig.bath.pump_url == "/dev/ttyUSB1?unit=5"


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "rig.toml",
            'profile = "omega-cn7"',
            'profile = "julabo-presto"',
            "JULABO PRESTO has a pump of its own: leave pump_url and pump_profile out",
        ),
        ("rig.toml", '"relay.toml"', '"rely.toml"', "no such file beside the rig file"),
        (
            "rig.toml",
            "ttyUSB1?unit=5",
            "ttyUSB1?unit=500",
            "unit=500: a whole number from 1 to 254",
        ),
        ("rig.toml", 'pump_profile = "relay.toml"\n', "", "pump_profile is missing"),
        ("rig.toml", 'pump_url = "/dev/ttyUSB1?unit=5"\n', "", "pump_url is missing"),
        ("relay.toml", 'name = "pump"', 'name = "pomp"', "the row 'pump' is missing"),
    ],
)
def test_faults_of_a_pump_are_shown_in_their_place(
    real_rig: Path, name: str, old: str, new: str, message: str
) -> None:
    path = real_rig.with_name(name)
    change(path, old, new)
    with pytest.raises(ConfigError) as caught:
        load_rig(real_rig)
    assert message in str(caught.value)
    assert f"{path}:" in str(caught.value)


def test_a_real_bath_has_no_emulated_pump(real_rig: Path) -> None:
    change(real_rig, 'pump_url = "/dev/ttyUSB1?unit=5"', 'pump_url = "emulator:"')
    with pytest.raises(
        ConfigError, match=r"bath\.pump_url: bath and pump are both emulated or both real"
    ):
        load_rig(real_rig)


def test_an_emulated_bath_has_no_real_pump(rig: Path) -> None:  # noqa: F811 - the fixture
    rig.with_name("relay.toml").write_text(RELAY, encoding="utf-8")
    change(rig, 'profile = "own.toml"', f'profile = "own.toml"\n{PUMP}')
    with pytest.raises(
        ConfigError, match=r"bath\.pump_url: bath and pump are both emulated or both real"
    ):
        load_rig(rig)


def test_a_shipped_relay_by_its_name(real_rig: Path) -> None:
    change(real_rig, 'pump_profile = "relay.toml"', 'pump_profile = "modbus-relay"')
    loaded = load_rig(real_rig)
    assert loaded.relay is not None
    assert loaded.relay.family == "Modbus relay board"
    change(real_rig, 'pump_profile = "modbus-relay"', 'pump_profile = "modbus-rely"')
    with pytest.raises(
        ConfigError, match=r'no such profile; did you mean "modbus-relay"\? .*shipped: modbus-relay'
    ):
        load_rig(real_rig)


def test_an_inferred_relay_is_not_switched_unless_the_rig_says_so(relay: RelayProfile) -> None:
    rows = tuple(row.model_copy(update={"evidence": "INFERRED"}) for row in relay.rows)
    doubtful = relay.model_copy(update={"rows": rows})
    clock = VirtualClock()
    controller, box = FarEnd(clock), FarEnd(clock, framing="tcp")
    controller.memory = dict(OMEGA)
    with served(controller) as url, served(box) as pump_url:
        bath = Bath(url, load_profile("omega-cn7"), clock, pump=PumpAt(pump_url, doubtful))
        with pytest.raises(LimitError, match="only infers where pump is"):
            bath.set("pump", "on")
        assert box.memory == {}
        bath.close()
        bath = Bath(
            url,
            load_profile("omega-cn7"),
            clock,
            pump=PumpAt(pump_url, doubtful),
            allow_inferred=True,
        )
        bath.set("pump", "on")
        assert box.memory == {2: 1}
        bath.close()


@pytest.mark.parametrize("off", ["off", 0.0, 0])
def test_the_pump_is_not_switched_off_before_the_heater(
    line: tuple[Multidrop, str], relay: RelayProfile, off: float | str
) -> None:
    far_end, url = line
    bath = Bath(url, load_profile("omega-cn7"), far_end.clock, pump=PumpAt(f"{url}?unit=5", relay))
    bath.set("pump", "on")
    bath.start(33.0)
    with pytest.raises(
        LimitError,
        match=(
            r"the pump is not switched off while the controller is started.*Put the controller into"
            r" standby"
        ),
    ):
        bath.set("pump", off)
    assert far_end.relay.memory[2] == 1
    bath.safe()
    bath.set("pump", off)
    assert far_end.relay.memory[2] == 0
    bath.close()
