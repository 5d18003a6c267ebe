"""What every instrument's driver keeps to, on its emulator: open, identify, read, lose the link,
come back, make safe twice, close twice, Ctrl-C.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from typing import Any, ClassVar

import pytest

from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_register_profile
from instruments.camera.cameras import CameraSet
from instruments.camera.emulator import EmulatedCameras
from instruments.camera.frame import FrameError, FrameFault, FrameSet
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.listener import Connection, Device, Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.protocol import State
from instruments.stage.driver import Spoken, Stage
from instruments.stage.emulator import CLASSIC, MARLIN, ZABER, Dialect, StageEmulator
from instruments.stage.zaber import Motor
from instruments.world.plant import Plant
from tests.instruments.camera.small_world import GalleryWorld
from tests.instruments.interrupts import interrupts
from tests.instruments.microscribe.rigs import Hand

pytestmark = pytest.mark.slow


class Cable:
    """Hands bytes on to a device, ``late_s`` late."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.late_s = 0.0

    def connect(self, connection: Connection) -> None:
        self.device.connect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        if self.late_s:
            connection.after(self.late_s, lambda: self.device.receive(connection, data))
        else:
            self.device.receive(connection, data)

    def disconnect(self, connection: Connection) -> None:
        self.device.disconnect(connection)


class Wired:
    """An instrument on loopback, under virtual time: its driver, not opened yet, and its emulator
    on a link that can be cut. ``read`` is something that it measures, the same while nothing
    happens; ``work`` has it do what ``safe`` ends; ``is_safe`` asks the emulator.
    """

    driver: Any

    def __init__(self, clock: VirtualClock, device: Device, name: str, late_s: float) -> None:
        self.clock = clock
        self.late_s = late_s
        self.cable = Cable(device)
        self.listen = partial(Listener, self.cable, clock, lock=threading.RLock(), name=name)
        self.listener = self.listen()

    def link(self, who: str) -> Link:
        return Link(self.listener.url, self.clock, who=who)

    def safe(self) -> None:
        self.driver.safe()

    def close(self) -> None:
        self.driver.close()

    def cut(self) -> None:
        self.listener.close()

    def mend(self) -> None:
        self.listener = self.listen(port=self.listener.port)

    def read(self) -> object:
        raise NotImplementedError

    def read_interrupted(self) -> None:
        """Read, with Ctrl-C while the answer is waited for."""

        def interrupt() -> None:
            raise KeyboardInterrupt

        self.cable.late_s = self.late_s
        self.clock.call_at(self.clock.now() + self.late_s / 2, interrupt)
        try:
            self.read()
        finally:
            self.cable.late_s = 0.0

    def end(self) -> None:
        self.listener.close()


class Arm(Wired):
    def __init__(self) -> None:
        clock = VirtualClock()
        self.emulator = ArmEmulator(Hand(clock), clock, seed=5)
        super().__init__(clock, self.emulator, "arm", late_s=0.02)

    def open(self) -> None:
        self.driver = MicroScribe(self.link("arm"), self.clock)

    def identify(self) -> str:
        return str(self.driver.sign_on().serial_number)

    def read(self) -> object:
        return self.driver.poll().counts

    def work(self) -> None:
        self.driver.confirm_homed()

    def recover(self) -> None:
        self.driver.recover()

    def is_safe(self) -> bool:
        return self.emulator.state is State.FINDING_BAUD


class WaterBath(Wired):
    def __init__(self) -> None:
        clock = VirtualClock()
        self.plant = Plant(1)
        self.profile = load_register_profile("julabo-presto")
        super().__init__(clock, BathEmulator(self.plant, self.profile, clock), "bath", late_s=1.0)

    def open(self) -> None:
        self.driver = Bath(f"tcp://127.0.0.1:{self.listener.port}", self.profile, self.clock)

    def identify(self) -> str:
        return str(self.driver.identity)

    def read(self) -> object:
        return round(self.driver.read().temp_c)

    def work(self) -> None:
        self.driver.start(33.0)

    def recover(self) -> None:
        self.driver.read()

    def is_safe(self) -> bool:
        return not self.plant.running


class Table(Wired):
    firmware: ClassVar[Dialect] = CLASSIC
    spoken: ClassVar[Spoken] = "grbl"
    place_mm: ClassVar[float] = -200.0

    def __init__(self) -> None:
        clock = VirtualClock()
        self.emulator = StageEmulator(clock, dialect=self.firmware)
        super().__init__(clock, self.emulator, "stage", late_s=0.2)

    def open(self) -> None:
        motors = [Motor(device, 1, 250.0) for device in (1, 2, 3)]
        self.driver = Stage(
            self.link("stage"), self.clock, "XYZ", dialect=self.spoken, motors=motors
        )

    def identify(self) -> str:
        return str(self.driver.connect())

    def read(self) -> object:
        return tuple(self.driver.position())

    def work(self) -> None:
        self.driver.home()
        self.driver.begin_move(self.place_mm, self.place_mm)
        self.clock.sleep(1.0)
        assert any(self.emulator.velocity())

    def recover(self) -> None:
        self.driver.reconnect()

    def is_safe(self) -> bool:
        return not any(self.emulator.velocity())


class MarlinTable(Table):
    firmware, spoken, place_mm = MARLIN, "marlin", 200.0


class ZaberTable(Table):
    firmware, spoken, place_mm = ZABER, "zaber", 200.0


class Cameras:
    """In real time, for streams have no other. Cameras have nothing to make safe."""

    def __init__(self) -> None:
        self.clock = RealClock()
        self.emulator = EmulatedCameras(GalleryWorld(clock=self.clock))
        self.silent = False
        self.emulator.capture()  # draws the gallery before anybody waits for it
        self.server = StreamServer(self, self.clock, fps=10.0)
        self.port = int(self.server.urls["left"].split(":")[2].split("/")[0])

    def capture(self) -> FrameSet:
        """For the server."""
        if self.silent:
            raise FrameError(FrameFault.DROPPED, "left", "left camera", "no frame came")
        return self.emulator.capture()

    def open(self) -> None:
        urls = self.server.urls
        openers = {
            name: partial(OpenCvCamera, name, urls[name], self.clock) for name in ("left", "right")
        }
        self.driver = CameraSet(openers, {})

    def identify(self) -> str:
        return self.driver.identity["left"]

    def read(self) -> object:
        while True:  # frames that were on their way, then the end of the stream
            try:
                return self.driver.capture().left.shape
            except FrameError:
                continue

    def work(self) -> None: ...

    def cut(self) -> None:
        self.server.close()

    def mend(self) -> None:
        self.server = StreamServer(self, self.clock, port=self.port, fps=10.0)

    def recover(self) -> None:
        self.driver.reopen()

    def safe(self) -> None: ...

    def is_safe(self) -> bool:
        return True

    def close(self) -> None:
        self.driver.close()

    def read_interrupted(self) -> None:
        self.silent = True
        try:
            with interrupts() as interrupt_in:
                interrupt_in(0.2)
                self.read()
        finally:
            self.silent = False

    def end(self) -> None:
        self.server.close()
        self.emulator.close()
        self.clock.close()


Instrument = Arm | WaterBath | Table | Cameras


@pytest.fixture(
    params=[Arm, WaterBath, Table, MarlinTable, ZaberTable, Cameras],
    ids=["arm", "bath", "stage", "Marlin", "Zaber", "cameras"],
)
def instrument(request: pytest.FixtureRequest) -> Iterator[Instrument]:
    made: Instrument = request.param()
    try:
        made.open()
        yield made
        made.close()
    finally:
        made.end()
    assert [t.name for t in threading.enumerate() if t.name.endswith("emulator")] == []


def test_it_says_who_it_is_and_measures(instrument: Instrument) -> None:
    assert instrument.identify()
    assert instrument.read() == instrument.read()


def test_a_lost_link_is_an_error_and_it_comes_back(instrument: Instrument) -> None:
    who, seen = instrument.identify(), instrument.read()
    instrument.cut()
    with pytest.raises(LinkError) as lost:
        instrument.read()
    assert " at " in lost.value.who
    with pytest.raises(LinkError):
        instrument.recover()
    instrument.mend()
    instrument.recover()
    assert instrument.read() == seen
    assert instrument.identify() == who


def test_making_safe_twice_leaves_it_safe_and_usable(instrument: Instrument) -> None:
    instrument.identify()
    instrument.work()
    instrument.safe()
    assert instrument.is_safe()
    instrument.safe()
    assert instrument.is_safe()
    assert instrument.identify()
    assert instrument.read() is not None


def test_closing_twice_is_no_error_and_it_can_be_opened_again(instrument: Instrument) -> None:
    who = instrument.identify()
    instrument.close()
    instrument.close()
    instrument.open()
    assert instrument.identify() == who


def test_ctrl_c_in_a_question_leaves_it_able_to_be_safe_and_to_answer(
    instrument: Instrument,
) -> None:
    who, seen = instrument.identify(), instrument.read()
    with pytest.raises(KeyboardInterrupt):
        instrument.read_interrupted()
    instrument.safe()
    assert instrument.is_safe()
    instrument.recover()
    assert instrument.identify() == who
    assert instrument.read() == seen
