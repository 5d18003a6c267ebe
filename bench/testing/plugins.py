"""A driver of another package as a subject of the conformance suite: on its emulator, where its
package has one, else on the device itself.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from bench.testing.conformance import NotCheckedError, Subject, Wired
from instruments.clock import Clock
from instruments.drivers.arm import PluggedArm
from instruments.drivers.bath import PluggedBath
from instruments.drivers.camera import PluggedCamera, PluggedGroup
from instruments.drivers.entry_points import EMULATORS, Kind, Plugin, PluginUrl, available, load
from instruments.drivers.stage import PluggedStage
from instruments.errors import InstrumentError

LATE_S = 1.0
SET_POINT_C = 30.0


class OfPlugin(Subject):
    """``plugged`` as it is; ``works``: it may heat and move."""

    def __init__(self, kind: Kind, plugged: Plugin, clock: Clock, *, works: bool) -> None:
        self.kind, self.plugged, self.clock, self.works = kind, plugged, clock, works

    def open(self) -> None:
        if self.kind == "bath":
            self.driver = PluggedBath(self.plugged, self.clock)
        elif self.kind == "stage":
            axes = getattr(self.plugged.maker, "axes", "XY")
            self.driver = PluggedStage(self.plugged, self.clock, axes)
        elif self.kind == "arm":
            self.driver = PluggedArm(self.plugged, self.clock)
        elif hasattr(self.plugged.maker, "capture"):
            self.driver = PluggedGroup(self.plugged, self.clock)
        else:
            self.driver = PluggedCamera(self.plugged, "left", self.clock)

    def identify(self) -> str:
        ask = {"stage": "connect", "arm": "sign_on"}.get(self.kind)
        return str(getattr(self.driver, ask)() if ask else self.driver.identity)

    def read(self) -> object:
        """What it measures, as steady as such a device is."""
        if self.kind == "bath":
            return round(self.driver.read().temp_c)
        if self.kind == "stage":
            return tuple(self.driver.position().round(2))
        if self.kind == "arm":
            return tuple(self.driver.glance().tip_mm.round(0))
        if isinstance(self.driver, PluggedGroup):
            shapes = {part: one.pixels.shape for part, one in self.driver.capture().items()}
            if stated := self.driver.makers_calibration():
                sizes = {part: shapes[part][1::-1] for part in stated.lenses if part in shapes}
                wanted = {part: lens.size_px for part, lens in stated.lenses.items()}
                assert sizes == wanted, f"its maker's lenses are of {wanted}, pictures {sizes}"  # noqa: S101
            return shapes
        self.driver.prepare()
        self.driver.begin()
        return self.driver.take().pixels.shape

    def work(self) -> None:
        if self.kind not in ("bath", "stage"):
            return
        if not self.works:
            does = "heat" if self.kind == "bath" else "move"
            raise NotCheckedError(f"it may not {does} here (--works)")
        if self.kind == "bath":
            self.driver.start(SET_POINT_C)
            return
        self.driver.connect()
        self.driver.home()
        limits = self.driver.limits
        self.driver.begin_move(limits["X"].high_mm - 1.0, limits["Y"].high_mm - 1.0)

    def recover(self) -> None:
        if self.kind == "stage":
            self.driver.reconnect()
        elif self.kind == "arm":
            self.driver.recover()
        elif self.kind == "camera":
            with suppress(InstrumentError):
                self.driver.close()
            self.open()
        else:
            self.driver.read()

    def safe(self) -> None:
        if self.kind != "camera":
            self.driver.safe()

    def is_safe(self) -> bool:
        """By its own word; its emulator knows better."""
        if self.kind == "bath":
            return bool(self.driver.read().running is False)
        if self.kind == "stage":
            return bool(self.driver.status().name != "Run")
        return True


class OnEmulator(OfPlugin, Wired):
    """The same on its package's emulator, whose ``is_safe``, where it has one, is asked."""

    def __init__(
        self, kind: Kind, plugged: Plugin, clock: Clock, emulator: Any, late_s: float = LATE_S
    ) -> None:
        Wired.__init__(self, clock, emulator, kind, late_s)
        self.emulator = emulator
        at = plugged.with_keys(url=self.listener.url)
        OfPlugin.__init__(self, kind, at, clock, works=True)

    def is_safe(self) -> bool:
        asked = getattr(self.emulator, "is_safe", None)
        return bool(asked()) if asked else super().is_safe()


def subject_of(kind: Kind, url: PluginUrl, clock: Clock, world: Any, *, works: bool) -> Subject:
    """On its emulator where there is one and no key names a device. Raises LimitError."""
    plugged = load(kind, url)
    if url.keys or url.name not in available(EMULATORS[kind]):
        return OfPlugin(kind, plugged, clock, works=works)
    emulator = load(kind, url, emulator=True).make(world, clock)
    return OnEmulator(kind, plugged, clock, emulator)
