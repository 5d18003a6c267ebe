"""Connects the drivers of a rig by URL. A bring-up that fails names every instrument that failed, not only the first."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.arm.pedals import pedal_watch
from bench.devices import Cameras, Devices
from bench.emulation import EmulatedRig
from bench.rig import EMULATED, LoadedRig
from instruments.bath.driver import Bath
from instruments.bath.relay import PumpAt
from instruments.camera.opencv import OpenCvCameras
from instruments.camera.recording import Recording, RecordingCameras
from instruments.capture import NO_CAPTURE, Captures
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import InstrumentError
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.operators.console import ConsoleOperator
from instruments.operators.operator import Operator
from instruments.stage.driver import Stage


class BringUpError(InstrumentError):
    """One or more instruments did not come up. The message lists each with its own fault."""

    def __init__(self, faults: dict[str, InstrumentError]) -> None:
        self.faults = faults
        lines = [f"{len(faults)} instrument{'s' if len(faults) > 1 else ''} did not come up"]
        super().__init__("rig", "\n  ".join([*lines, *(str(fault) for fault in faults.values())]))


@dataclass(frozen=True, slots=True)
class Hookup:
    """An open rig; ``exact_ends`` is there on an emulated one only."""

    devices: Devices
    exact_ends: Callable[[], NDArray[np.float64]] | None


@contextmanager
def open_rig(rig: LoadedRig, *, seed: int, realtime: bool = False, capture: Captures = NO_CAPTURE) -> Iterator[Hookup]:
    """The drivers of ``rig``, with its emulators where it is an emulated one; ``capture`` taps links. Raises BringUpError."""
    emulated = bool(rig.rig.emulated)
    clock: Clock = VirtualClock() if emulated and not realtime else RealClock()
    try:
        if emulated:
            with (
                EmulatedRig(rig, clock, seed) as twin,
                _connected(rig, clock, twin.urls, twin.cameras, twin.operator, capture) as devices,
            ):
                yield Hookup(devices, twin.world.ends_mm)
        else:
            operator = ConsoleOperator(sys.stdin, sys.stdout)
            with _connected(rig, clock, rig.rig.urls, None, operator, capture) as devices:
                operator.watch_pedals(lambda: pedal_watch(devices.arm, clock))
                yield Hookup(devices, None)
    finally:
        if isinstance(clock, RealClock):
            clock.close()


@contextmanager
def _connected(
    rig: LoadedRig, clock: Clock, urls: dict[str, str], cameras: Cameras | None, operator: Operator, capture: Captures
) -> Iterator[Devices]:
    openers = driver_openers(rig, clock, urls, capture)
    if cameras is not None:
        openers["cameras"] = lambda: cameras
    opened, faults = {}, {}
    for name, opener in openers.items():
        try:
            opened[name] = opener()
        except InstrumentError as fault:
            faults[name] = fault
    try:
        if faults:
            raise BringUpError(faults)
        yield Devices(clock, opened["arm"], opened["bath"], opened.get("stage"), opened["cameras"], operator)
    finally:
        for device in opened.values():
            device.close()


def driver_openers(rig: LoadedRig, clock: Clock, urls: dict[str, str], capture: Captures = NO_CAPTURE) -> dict[str, Callable[[], Any]]:
    """For each instrument of the rig, what opens its driver, with a tap of ``capture``; each may raise InstrumentError."""
    r = rig.rig

    def link(name: str, baud: int) -> Link:
        return Link(urls[name], clock, who=name, baud=baud, tap=capture.tap(name, clock))

    pump = PumpAt(r.bath.pump_url, rig.relay, capture.tap("pump", clock)) if rig.relay else None
    openers: dict[str, Callable[[], Any]] = {
        "arm": lambda: MicroScribe(link("arm", r.arm.baud), clock),
        "bath": lambda: Bath(
            urls["bath"], rig.profile, clock, allow_inferred=r.bath.allow_inferred, tap=capture.tap("bath", clock), pump=pump
        ),
    }
    if r.stage:
        baud = r.stage.baud
        openers["stage"] = lambda: Stage(link("stage", baud), clock)
    if r.cameras.url != EMULATED:
        openers["cameras"] = lambda: open_cameras(r.cameras.url, rig.path.parent, clock)
    return openers


def open_cameras(url: str, folder: Path, clock: Clock) -> Cameras:
    """Real cameras or a recording by their URL; a recording's path is taken from ``folder``."""
    kind, _, rest = url.partition(":")
    if kind == "recording":
        return RecordingCameras(Recording(folder / rest))
    names = ("left", "right", "thermal")
    sources = [int(part) if part.isdecimal() else part for part in rest.split(",")]
    return OpenCvCameras(dict(zip(names, sources, strict=False)), clock)
