"""Sign-on at other rates: found, told, and not trusted with a word about homing."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from instruments.errors import LimitError
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.errors import NoMicroScribeError, NotHomedError
from instruments.microscribe.faults import Fault
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.driver_rig import Rig
from tests.instruments.microscribe.impostors import Parrot, sign_on_to


class AtRate:
    """An arm whose session was left at another rate than the
    link's: it understands only that one.
    """

    def __init__(self, rig: Rig, baud: int) -> None:
        self.rig, self.baud = rig, baud
        self.link: Link | None = None
        self.spoken: list[int] = []

    def connect(self, connection: Connection) -> None:
        self.rig.ear.connect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        assert self.link is not None
        if self.link.baud not in self.spoken:
            self.spoken.append(self.link.baud)
        if self.link.baud == self.baud:
            self.rig.ear.receive(connection, data)
        else:
            connection.send(b"\xf8\x80")  # what comes back at the wrong rate is noise

    def disconnect(self, connection: Connection) -> None:
        self.rig.ear.disconnect(connection)


@pytest.fixture
def at_rate(rig: Rig) -> Callable[[int], tuple[MicroScribe, AtRate]]:
    def build(baud: int) -> tuple[MicroScribe, AtRate]:
        device = AtRate(rig, baud)
        rig.listener.close()
        rig.listener = Listener(device, rig.clock, lock=rig.lock, name="arm")
        device.link = Link(rig.listener.url, rig.clock, who="arm", baud=115200)
        rig.drivers.append(MicroScribe(device.link, rig.clock, rates=(115200, 38400, 9600)))
        return rig.drivers[-1], device

    return build


def test_a_session_at_another_rate_is_found(
    rig: Rig, at_rate: Callable[[int], tuple[MicroScribe, AtRate]]
) -> None:
    driver, device = at_rate(9600)
    rig.arm.faults.inject(Fault.OLD_SESSION, 1)
    driver.sign_on()
    assert device.spoken == [115200, 38400, 9600]
    assert (driver.baud, driver.record()["baud"]) == (9600, 9600)
    assert driver.warnings == ("the arm answers at 9600 baud, not at 115200",)
    assert driver.poll().counts == UNIT_40937.home


def test_after_a_search_for_the_rate_a_word_is_not_enough(
    at_rate: Callable[[int], tuple[MicroScribe, AtRate]],
) -> None:
    driver, _ = at_rate(9600)
    driver.sign_on()
    with pytest.raises(NotHomedError, match=r"may have re-homed it.*on its peg and home the arm"):
        driver.confirm_homed()
    with pytest.raises(NotHomedError, match="may have re-homed it"):
        driver.read()
    driver.home()
    driver.read()


def test_no_rate_that_works_is_told_with_all_that_were_tried(
    rig: Rig, at_rate: Callable[[int], tuple[MicroScribe, AtRate]]
) -> None:
    driver, device = at_rate(57600)
    with pytest.raises(NoMicroScribeError, match="at 115200 or 38400 or 9600 baud"):
        driver.sign_on()
    assert rig.clock.now() == pytest.approx(4.0, abs=0.1)
    assert device.link is not None
    assert device.link.baud == 115200


def test_a_neighbour_that_is_known_ends_the_search(rig: Rig) -> None:
    with pytest.raises(NoMicroScribeError, match="GRBL"):
        sign_on_to(Parrot(lambda _: b"Grbl 1.1h\r\n"), rates=(115200, 9600))


def test_another_rate_within_a_session(rig: Rig) -> None:
    driver = rig.signed_on()
    driver.set_baud(38400)
    assert rig.ear.heard.endswith(bytes.fromhex("C4 10 03"))
    assert driver.baud == 38400
    driver.read()
    with pytest.raises(LimitError, match="no rate 4800"):
        driver.set_baud(4800)
