"""The driver against the emulator, over loopback and under virtual time: what it does, and all that it refuses."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from instruments.clock import VirtualClock
from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.faults import Fault
from instruments.microscribe.kinematics import Floats
from instruments.microscribe.protocol import State
from instruments.microscribe.unit import UNIT_40937, ArmIdentity

POINT = np.array([-180.0, 240.0, 130.0])
UP = np.array([0.0, 0.0, 1.0])
MAKERS_ORDER = bytes.fromhex("C8 C9 CA CB CC CD CE C6 C0 D3")


class Hand:
    """Holds the tip at ``point`` with the stylus upright, or leaves it on its peg; ``drift`` mm along x a second."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.point: Floats | None = None
        self.drift = 0.0

    def arm_target(self) -> tuple[Floats, Floats] | None:
        if self.point is None:
            return None
        return self.point + np.array([self.drift * self.clock.now(), 0.0, 0.0]), UP


class Tap:
    """Notes what the emulator hears; ``late_s`` holds the next bytes up for so long, once."""

    def __init__(self, arm: ArmEmulator) -> None:
        self.arm = arm
        self.heard = b""
        self.late_s = 0.0

    def connect(self, connection: Connection) -> None:
        self.arm.connect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        self.heard += data
        late_s, self.late_s = self.late_s, 0.0
        if late_s:
            connection.after(late_s, lambda: self.arm.receive(connection, data))
        else:
            self.arm.receive(connection, data)

    def disconnect(self, connection: Connection) -> None:
        self.arm.disconnect(connection)


class Rig:
    """One emulated arm, plugged in."""

    def __init__(self, unit: ArmIdentity = UNIT_40937, *, echo_after: int = 1, accuracy_mm: float = 0.23) -> None:
        self.clock = VirtualClock()
        self.hand = Hand(self.clock)
        self.arm = ArmEmulator(self.hand, self.clock, unit=unit, seed=5, echo_after=echo_after, accuracy_mm=accuracy_mm)
        self.tap = Tap(self.arm)
        self.listener = Listener(self.tap, self.clock, lock=threading.RLock(), name="arm")
        self.drivers: list[MicroScribe] = []

    def driver(self) -> MicroScribe:
        self.drivers.append(MicroScribe(Link(self.listener.url, self.clock, who="arm"), self.clock))
        return self.drivers[-1]

    def signed_on(self) -> MicroScribe:
        driver = self.driver()
        driver.sign_on()
        driver.confirm_homed()
        return driver

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        self.listener.close()


@pytest.fixture
def make() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def build(*args: ArmIdentity, **options: float) -> Rig:
        rigs.append(Rig(*args, **options))  # type: ignore[arg-type]
        return rigs[-1]

    yield build
    for rig in rigs:
        rig.close()
        assert not {b for b in (0xC3, 0xC7, 0xD0, 0xD1) if bytes([b]) in rig.tap.heard}
        assert rig.tap.heard.count(b"IMMC") == rig.tap.heard.count(b"\xc5IMMC")
        assert rig.arm.eeprom_attempts == 0
    assert not [thread.name for thread in threading.enumerate() if thread.name.endswith("emulator")]


@pytest.fixture
def rig(make: Callable[..., Rig]) -> Rig:
    return make()


def renamed(**names: str) -> ArmIdentity:
    return dataclasses.replace(UNIT_40937, names=dataclasses.replace(UNIT_40937.names, **names))


def test_sign_on_goes_by_the_sheet_and_reads_who_it_is(rig: Rig) -> None:
    driver = rig.driver()
    identity = driver.sign_on()
    assert rig.tap.heard == b"\xc5IMMCBEGIN" + MAKERS_ORDER
    assert dataclasses.astuple(identity) == ("MicroScribe3D", "MSCR", "DX", "40937", "Standard+Beta", "Format DH0.5", "HCI 2.0")
    assert driver.identity == identity
    assert driver.maxima.turns == (16384, 16384, 8192, 4096, 4096, 0)
    assert driver.parameters.d == (8300, -878, -3, 9244, 320, -5274)
    assert driver.beta_rad == pytest.approx(3 / 32768 * np.pi)
    assert rig.clock.now() == pytest.approx(0.1)  # the silence that surplus echoes are waited for


def test_at_rest_the_recorded_counts_and_the_position_of_the_sheet(rig: Rig) -> None:
    driver = rig.signed_on()
    assert driver.poll().counts == (13903, 6238, 6868, 4098, 3193, 8416)
    reading = driver.read()
    assert np.hypot(*reading.tip_mm[:2]) == pytest.approx(np.hypot(73.6746, 14.0353), abs=1e-3)
    assert reading.tip_mm[2] == pytest.approx(212.2005, abs=1e-3)
    assert reading.axis[2] == pytest.approx(0.99996, abs=1e-5)
    assert (reading.n, reading.counts[3]) == (8, 4098)
    assert reading.spread_mm < 1e-9


def test_a_touch_is_right_within_the_stated_accuracy(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT
    reading = driver.read(32)
    assert np.linalg.norm(reading.tip_mm - POINT) < 0.8
    assert 0.0 < reading.spread_mm < 0.6
    np.testing.assert_allclose(reading.axis, UP, atol=0.01)


def test_the_same_seed_gives_the_same_readings(make: Callable[..., Rig]) -> None:
    readings = []
    for _ in range(2):
        rig = make()
        driver = rig.signed_on()
        rig.hand.point = POINT
        readings.append((driver.read().tip_mm.tobytes(), rig.clock.now()))
    assert readings[0] == readings[1]


@pytest.mark.parametrize("echo_after", [2, 6])
def test_an_arm_that_wants_to_hear_it_several_times(make: Callable[..., Rig], echo_after: int) -> None:
    rig = make(echo_after=echo_after)
    rig.driver().sign_on()
    assert rig.tap.heard == b"\xc5IMMC" * echo_after + b"BEGIN" + MAKERS_ORDER


@pytest.mark.parametrize("fault", [Fault.OLD_SESSION, Fault.SURPLUS_ECHOES])
def test_sign_on_in_spite_of(rig: Rig, fault: Fault) -> None:
    rig.arm.faults.inject(fault, 1)
    driver = rig.signed_on()
    assert driver.identity.serial_number == "40937"
    assert driver.poll().counts == UNIT_40937.home


def test_a_second_host_takes_over_a_session_that_was_left_streaming(rig: Rig) -> None:
    link = Link(rig.listener.url, rig.clock, who="other host")
    for words in (b"IMMC", b"BEGIN", bytes.fromhex("CF 000A 03") + bytes(21)):
        link.write(words)
        link.receive(1.0)
    link.drain(0.2, at_most_s=0.05)
    link.close()
    rig.tap.heard = b""
    assert rig.arm.state is State.STREAMING
    assert rig.signed_on().poll().counts == UNIT_40937.home


def test_an_arm_without_beta_is_not_asked_for_it(make: Callable[..., Rig]) -> None:
    rig = make(renamed(comment="Standard"))
    driver = rig.driver()
    driver.sign_on()
    assert driver.beta_rad == 0.0
    assert rig.tap.heard.endswith(MAKERS_ORDER[:-1])


def test_silence_at_sign_on(rig: Rig) -> None:
    rig.arm.faults.inject("silent")
    driver = rig.driver()
    with pytest.raises(LinkError, match=r"nothing answers the sign-on \(asked C5 49 4D 4D 43, got nothing, after 3 s\).*switched on"):
        driver.sign_on()
    assert rig.clock.now() == pytest.approx(3.0, abs=0.02)
    assert b"BEGIN" not in rig.tap.heard


def test_the_interface_box_is_refused(rig: Rig) -> None:
    rig.arm.faults.inject("IBOX")
    with pytest.raises(ProtocolError, match="Immersion Interface Box"):
        rig.driver().sign_on()
    assert rig.tap.heard.endswith(b"BEGIN\xc5")
    assert rig.arm.state is State.FINDING_BAUD


def test_another_parameter_format_is_refused(make: Callable[..., Rig]) -> None:
    rig = make(renamed(format="Format DH1.0"))
    with pytest.raises(ProtocolError, match=r"not understood: 'Format DH1.0', not 'Format DH0.5'"):
        rig.driver().sign_on()
    assert rig.tap.heard.endswith(b"\xc5")


def test_a_parameter_block_of_another_length_is_refused(rig: Rig) -> None:
    rig.arm.faults.inject("parameter block of another length")
    with pytest.raises(ProtocolError, match="says it has 34 bytes; 36 are understood"):
        rig.driver().sign_on()
    assert rig.tap.heard.endswith(b"\xc5")


class Parrot:
    """Sends back what it hears, as a loop-back plug does, after ``change``."""

    def __init__(self, change: Callable[[bytes], bytes]) -> None:
        self.change = change

    def connect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.change(data))

    def disconnect(self, connection: Connection) -> None: ...


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (bytes, ProtocolError, r"not that of a MicroScribe \(asked 42 45 47 49 4E, got 42 45 47 49 4E\).*loop-back"),
        (lambda _: b"ERROR\r\n", ProtocolError, "something answers, but not as a MicroScribe"),
        (lambda data: data if b"IMMC" in data else b"", LinkError, "echoed, then fell silent"),
        (lambda data: b"IMMC" if b"IMMC" in data else b"IMMCMSCR\0" if data == b"BEGIN" else b"", LinkError, "does not answer .asked C8"),
        (
            lambda data: b"IMMC" if b"IMMC" in data else b"MSCR\0" if data == b"BEGIN" else b"\xc9X\0",
            ProtocolError,
            "doesn't begin with C8 .asked C8, got C9 58 00",
        ),
    ],
    ids=["loop-back", "something else", "silent after the echo", "silent after a late echo", "wrong reply"],
)
def test_what_is_no_arm_is_refused(change: Callable[[bytes], bytes], error: type[Exception], message: str) -> None:
    clock = VirtualClock()
    listener = Listener(Parrot(change), clock, lock=threading.RLock(), name="parrot")
    driver = MicroScribe(Link(listener.url, clock, who="arm"), clock)
    with pytest.raises(error, match=message):
        driver.sign_on()
    with pytest.raises(LimitError, match="no session"):
        driver.poll()
    driver.close()
    listener.close()


def test_nothing_is_known_before_sign_on(rig: Rig) -> None:
    driver = rig.driver()
    known: list[Callable[[], object]] = [lambda: driver.identity, lambda: driver.maxima, lambda: driver.parameters, lambda: driver.geometry]
    asks: list[Callable[[], object]] = [driver.poll, driver.read, driver.confirm_homed, driver.home]
    for ask in known + asks:
        with pytest.raises(LimitError, match="Sign on first"):
            ask()
    assert rig.tap.heard == b""


def test_no_position_before_homing_is_confirmed(rig: Rig) -> None:
    driver = rig.driver()
    driver.sign_on()
    assert driver.poll().counts == UNIT_40937.home
    with pytest.raises(LimitError, match=r"before homing is confirmed.*stylus on its peg"):
        driver.read()
    driver.confirm_homed()
    assert driver.homed
    driver.read()


def test_every_sign_on_asks_for_homing_anew(rig: Rig) -> None:
    driver = rig.signed_on()
    driver.sign_on()
    assert not driver.homed
    with pytest.raises(LimitError, match="homing"):
        driver.read()


def test_home_reloads_the_counts_on_the_peg(make: Callable[..., Rig]) -> None:
    rig = make(accuracy_mm=0.0)
    rig.hand.point = POINT
    rig.arm.power_cycle()
    rig.hand.point = None
    driver = rig.driver()
    driver.sign_on()
    assert driver.poll().counts != UNIT_40937.home
    driver.home()
    assert driver.homed
    assert driver.poll().counts == UNIT_40937.home
    rig.hand.point = POINT
    assert np.linalg.norm(driver.read(32).tip_mm - POINT) < 0.3


def test_a_reading_is_refused_while_the_arm_moves(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point, rig.hand.drift = POINT, 100.0
    with pytest.raises(LimitError, match=r"the arm moves: 8 packets spread by \d\.\d+ mm, more than 1 mm.*still"):
        driver.read()
    rig.hand.drift = 0.0
    driver.read()


def test_a_reading_of_nothing_is_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="one packet at least"):
        rig.signed_on().read(0)


@pytest.mark.parametrize("fault", [Fault.BIT_7, Fault.LOST_BYTE])
def test_a_damaged_packet_is_asked_for_again(rig: Rig, fault: Fault) -> None:
    driver = rig.signed_on()
    for _ in range(20):
        rig.arm.faults.inject(fault, 1)
        assert driver.poll().counts == UNIT_40937.home
    assert driver.damaged >= 15  # a lost header leaves no packet to call damaged


def test_garbage_before_a_packet_does_no_harm(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("garbage between packets")
    assert {driver.poll().counts for _ in range(50)} == {UNIT_40937.home}


def test_packets_that_are_always_damaged_are_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("bit 7 in payload")
    with pytest.raises(ProtocolError, match=r"3 packets in a row came damaged \(asked 03, got 83"):
        driver.poll()
    rig.arm.faults.clear("bit 7 in payload")
    driver.read()


def test_a_flipped_bit_shows_as_motion(rig: Rig) -> None:
    driver = rig.signed_on()
    refused = 0
    for _ in range(30):
        rig.arm.faults.inject("flipped bit", 1)
        try:
            tip = driver.read().tip_mm
        except LimitError:
            refused += 1
        else:  # a low bit, a joint that is none, or the buttons: no further off than the spread allows
            assert np.hypot(*tip[:2]) == pytest.approx(75, abs=1)
    assert refused > 5


def test_one_lost_question_is_asked_again(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("silent", 1)
    driver.read()


def test_a_late_answer_is_not_taken_for_the_next_one(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.tap.late_s = 0.15  # after the time-out, before the silence that the driver then waits for
    assert driver.poll().counts == UNIT_40937.home
    rig.clock.sleep(0.1)  # by now the late answer, from the peg, has come in any case
    rig.hand.point = POINT
    assert driver.poll().counts != UNIT_40937.home


def test_power_loss_is_noticed_and_costs_the_homing(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT
    driver.read()
    rig.arm.power_cycle()
    with pytest.raises(LinkError, match=r"fallen silent.*power.*peg"):
        driver.read()
    assert not driver.homed
    with pytest.raises(LimitError, match="no session"):
        driver.read()
    driver.sign_on()
    with pytest.raises(LimitError, match="homing"):
        driver.read()


def test_a_cable_that_is_pulled_is_noticed(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.listener.close()
    with pytest.raises(LinkError):
        driver.poll()
    with pytest.raises(LimitError, match="no session"):
        driver.read()


def test_safe_ends_the_session_once(rig: Rig) -> None:
    driver = rig.signed_on()
    assert not driver.moves
    driver.safe()
    assert rig.arm.state is State.FINDING_BAUD
    heard = rig.tap.heard
    driver.safe()
    assert rig.tap.heard == heard
    assert heard.endswith(b"\xc5")
    with pytest.raises(LimitError, match="no session"):
        driver.poll()
    driver.sign_on()


def test_close_ends_the_session_and_may_be_called_twice(rig: Rig) -> None:
    driver = rig.signed_on()
    driver.close()
    driver.close()
    assert rig.arm.state is State.FINDING_BAUD


def test_a_hand_that_reaches_too_far_breaks_the_link_rather_than_lies(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT * 10
    with pytest.raises(LinkError, match="hung up"):
        driver.read()
    assert "out of reach" in str(rig.arm.unreachable)
