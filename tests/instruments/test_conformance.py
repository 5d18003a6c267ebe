"""What every instrument's driver keeps to, on its emulator: open, identify, read, lose the link,
come back, make safe twice, close twice, Ctrl-C.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import pytest

from bench.testing.conformance import CHECKS, Check, Subject, Wired, abort_in, conform
from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.camera.cameras import CameraSet
from instruments.camera.emulator import EmulatedCameras
from instruments.camera.frame import FrameError, FrameFault, FrameSet
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock, VirtualClock
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.protocol import State
from instruments.stage.driver import Spoken, Stage
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import CLASSIC, MARLIN, ZABER, Dialect
from instruments.stage.zaber import Motor
from instruments.world.plant import Plant
from tests.instruments.bath.devices import load_register_profile
from tests.instruments.camera.small_world import GalleryWorld
from tests.instruments.microscribe.rigs import Hand

pytestmark = pytest.mark.slow


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


class Cameras(Subject):
    """In real time, for streams have no other. Cameras have nothing to make safe."""

    def __init__(self) -> None:
        self.clock: RealClock = RealClock()
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
        return str(self.driver.identity["left"])

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

    def read_interrupted(self) -> None:
        self.silent = True
        try:
            with abort_in(self.clock, 0.2):
                self.read()
        finally:
            self.silent = False

    def end(self) -> None:
        self.server.close()
        self.emulator.close()
        self.clock.close()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    "kind",
    [Arm, WaterBath, Table, MarlinTable, ZaberTable, Cameras],
    ids=["arm", "bath", "stage", "Marlin", "Zaber", "cameras"],
)
def test_our_drivers_conform(kind: Callable[[], Subject], check: Check) -> None:
    [found] = conform(kind, (check,))
    assert found.outcome == "passed", found.why
    assert [t.name for t in threading.enumerate() if t.name.endswith("emulator")] == []
