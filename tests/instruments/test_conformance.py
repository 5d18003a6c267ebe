"""What every instrument's driver keeps to, on its emulator: open, identify, read, lose the link,
come back, make safe twice, close twice, Ctrl-C.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest

from bench.testing.conformance import (
    CHECKS,
    Check,
    Subject,
    Wired,
    abort_in,
    closes_twice_and_opens_again,
    conform,
    lost_link_is_an_error_and_comes_back,
    safe_over_a_link_lost_is_safe,
)
from instruments.bath.driver import OwnBath
from instruments.bath.emulator import BathEmulator
from instruments.camera.cameras import CameraSet
from instruments.camera.emulator import EmulatedCameras
from instruments.camera.frame import FrameError, FrameFault, FrameSet
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock, VirtualClock
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.protocol import State
from instruments.stage.driver import OwnStage, Spoken
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import CLASSIC, MARLIN, Firmware
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
        packet = self.driver.poll()
        self.counts = packet.counts
        return packet.buttons, self.counts

    def change(self) -> object:
        self.emulator.buttons ^= 1
        return self.emulator.buttons, self.counts

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
        self.driver = OwnBath(f"tcp://127.0.0.1:{self.listener.port}", self.profile, self.clock)

    def identify(self) -> str:
        return str(self.driver.identity)

    def read(self) -> object:
        return round(self.driver.read().temp_c)

    def change(self) -> object:
        warm_c = 27.0 if self.plant.bath_c < 25.0 else 23.0
        self.plant.be_at(warm_c)
        self.clock.sleep(60.0)  # its sensor lags
        return round(warm_c)

    def work(self) -> None:
        self.driver.start(33.0)

    def recover(self) -> None:
        self.driver.read()

    def is_safe(self) -> bool:
        return not self.plant.running


class Table(Wired):
    firmware: ClassVar[Firmware] = CLASSIC
    spoken: ClassVar[Spoken] = "grbl"
    place_mm: ClassVar[float] = -200.0

    def __init__(self) -> None:
        clock = VirtualClock()
        self.emulator = StageEmulator(clock, dialect=self.firmware)
        super().__init__(clock, self.emulator, "stage", late_s=0.2)

    def open(self) -> None:
        self.driver = OwnStage(self.link("stage"), self.clock, "XYZ", dialect=self.spoken)

    def identify(self) -> str:
        return str(self.driver.connect())

    def read(self) -> object:
        return tuple(self.driver.position().round(2))

    def change(self) -> object:
        self.driver.connect()
        self.driver.home()
        self.driver.move_to(self.place_mm, self.place_mm)
        return tuple(self.emulator.position_mm().round(2))

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

    def change(self) -> object:
        """Each picture is another one, but for every fifth: so many may pass on a busy machine."""
        seen = self.driver.capture().left
        assert any(not np.array_equal(self.driver.capture().left, seen) for _ in range(4))
        return seen.shape

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


KINDS = {
    "arm": Arm, "bath": WaterBath, "stage": Table, "Marlin": MarlinTable,
    "cameras": Cameras,
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "check"),
    [
        pytest.param(kind, check, id=f"{name}-{check.__name__}")
        for name, kind in KINDS.items()
        for check in CHECKS
        # an arm without a motor has nothing that goes on over a lost link
        if (name, check) != ("arm", safe_over_a_link_lost_is_safe)
    ],
)
def test_our_drivers_conform(kind: Callable[[], Subject], check: Check) -> None:
    [found] = conform(kind, (check,))
    if found.outcome == "not checked" and not hasattr(signal, "setitimer"):
        pytest.skip(found.why)
    assert found.outcome == "passed", found.why
    assert [t.name for t in threading.enumerate() if t.name.endswith("emulator")] == []


def nothing(*_: object) -> None: ...


def connects_once(bath: Any) -> None:
    if "connected_once" not in vars(bath):
        bath.connected_once = True
        connect(bath)


connect = OwnBath._connect
# what our drivers do on a link that was lost, or as they close, left out
LEFT_OUT: list[tuple[str, type, str, Callable[..., None], Check]] = [
    ("arm", Link, "reopen", nothing, lost_link_is_an_error_and_comes_back),
    ("stage", Link, "reopen", nothing, lost_link_is_an_error_and_comes_back),
    ("bath", OwnBath, "_connect", connects_once, lost_link_is_an_error_and_comes_back),
    ("bath", OwnBath, "safe", lambda bath: bath._rows.stand_by(), safe_over_a_link_lost_is_safe),
    ("stage", OwnStage, "stop", nothing, safe_over_a_link_lost_is_safe),
    ("arm", MicroScribe, "close", nothing, closes_twice_and_opens_again),
    ("stage", OwnStage, "close", nothing, closes_twice_and_opens_again),
    ("bath", OwnBath, "close", nothing, closes_twice_and_opens_again),
    ("cameras", CameraSet, "reopen", nothing, lost_link_is_an_error_and_comes_back),
]


@pytest.mark.parametrize(("kind", "driver", "method", "instead", "check"), LEFT_OUT)
def test_what_a_driver_of_ours_leaves_out_fails(
    kind: str,
    driver: type,
    method: str,
    instead: Callable[..., None],
    check: Check,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(driver, method, instead)
    [found] = conform(KINDS[kind], (check,))
    assert found.outcome == "failed"
