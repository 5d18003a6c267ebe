"""Connects the drivers of a rig by URL, its cameras (all by one URL, or each by its table) and its
operator. A bring-up that fails names every instrument that failed, not only the first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError
from bench.rig.camera_model import Cameras as Tables
from bench.rig.camera_model import OneCamera, ThermalTable
from bench.rig.devices import Cameras, Devices
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import CONSOLE, ELSEWHERE, EMULATED, SCRIPT
from detector.calibration import Calibration
from instruments.bath.driver import Bath
from instruments.bath.relay import PumpAt
from instruments.camera.cameras import KNOWN, Camera, CameraSet
from instruments.camera.conversion import Conversion
from instruments.camera.genicam import GenicamCamera
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.recording import Recording, RecordingCameras
from instruments.captures.capture import NO_CAPTURE, Captures
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import DeviceError, InstrumentError
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.protocol import Packet
from instruments.microscribe.stream import Debouncer
from instruments.operators.console import Console
from instruments.operators.operator import Operator
from instruments.operators.prompted import PromptedOperator
from instruments.operators.remote import RemoteOperator
from instruments.stage.driver import Stage
from reports.sanitize import sanitized

INTERVAL_S = 0.005


class PolledArm(Protocol):
    """What is asked of the driver."""

    def poll(self) -> Packet: ...


def pedal_watch(arm: PolledArm, clock: Clock) -> Callable[[float], bool]:
    """For one prompt: what watches the pedals for some seconds, and says whether one was pressed
    since the first time it was asked.

    A foot that is down at first has to come up before its press counts. What is given back raises
    as polling does.
    """
    debouncer = Debouncer()

    def pressed(seconds: float) -> bool:
        end_s = clock.now() + seconds
        while True:
            if any(event.pressed for event in debouncer.feed(clock.now(), arm.poll().buttons)):
                return True
            if clock.now() >= end_s:
                return False
            clock.sleep(INTERVAL_S)

    return pressed


def open_cameras(
    tables: Tables, calibration: Calibration | None, folder: Path, clock: Clock
) -> Cameras:
    """The cameras of a rig file in ``folder``; paths are taken from there. Raises InstrumentError,
    RecordingError.
    """
    kind, _, rest = tables.url.partition(":")
    if kind == "recording":
        return RecordingCameras(Recording(folder / rest))
    if kind == "opencv":
        openers = _one_line(rest, folder, clock)
        return CameraSet(openers, {})
    conversions = {name: conversion_of(table, calibration) for name, table in tables.tables.items()}
    return CameraSet(
        {name: opener_of(name, table, folder, clock) for name, table in tables.tables.items()},
        conversions,
    )


def conversion_of(table: OneCamera, calibration: Calibration | None) -> Conversion:
    """What becomes of a camera's frames so that they are as the calibration has them; as delivered
    without one.
    """
    if not isinstance(table, ThermalTable):
        return table.conversion()
    if calibration is None:
        return table.calibrated(
            mirrored=bool(table.mirrored), hot_is_black=table.polarity == "hot_is_black"
        )
    thermal = calibration.thermal
    return table.calibrated(
        mirrored=thermal.mirrored, hot_is_black=thermal.polarity == "hot_is_black"
    )


def opener_of(name: str, table: OneCamera, folder: Path, clock: Clock) -> Callable[[], Camera]:
    """What opens one camera."""
    kind, _, rest = table.url.partition(":")
    if kind == "genicam":
        return lambda: GenicamCamera(name, rest, clock, table.settings)
    return lambda: OpenCvCamera(name, _source(rest, folder), clock, table.settings)


def _one_line(rest: str, folder: Path, clock: Clock) -> dict[str, Callable[[], Camera]]:
    sources = rest.split(",")
    if not 2 <= len(sources) <= len(KNOWN):
        hint = "Correct the cameras in the rig file."
        raise DeviceError(
            "OpenCV cameras",
            f"needs two or three sources for left, right and thermal, got {rest!r}",
            hint=hint,
        )

    def opener(name: str, source: str) -> Callable[[], Camera]:
        return lambda: OpenCvCamera(name, _source(source, folder), clock)

    return {name: opener(name, source) for name, source in zip(KNOWN, sources, strict=False)}


def _source(text: str, folder: Path) -> int | str:
    """A device's number, or a URL, or a path; a file that stands beside the rig file is taken from
    there.
    """
    if text.isdecimal():
        return int(text)
    beside = folder / text
    return str(beside) if "://" not in text and beside.is_file() else text


Screen = Callable[[], AbstractContextManager[None]]


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


@dataclass(frozen=True, slots=True)
class Parts:
    """Some instruments of a rig: its cameras, the arm where it was asked for, and who is asked to
    hold and to touch.
    """

    clock: Clock
    cameras: Cameras
    operator: Operator
    arm: MicroScribe | None


@contextmanager
def open_parts(
    rig: LoadedRig, *, seed: int, arm: bool = False, capture: Captures = NO_CAPTURE
) -> Iterator[Parts]:
    """The cameras of ``rig``, and its ``arm`` where asked for; nothing else of it is looked for.
    Raises BringUpError, ConfigError.
    """
    emulated = rig.rig.cameras.url == EMULATED
    clock: Clock = VirtualClock() if emulated and rig.rig.operator.url != CONSOLE else RealClock()
    answerer = _answerer(rig, clock, nullcontext)
    try:
        if emulated:
            with (
                EmulatedRig(rig, clock, seed) as twin,
                _opened(_wanted(rig, clock, twin.urls, arm, capture)) as opened,
            ):
                yield Parts(
                    clock, twin.cameras, _operator(rig, answerer, twin.operator), opened.get("arm")
                )
        else:
            with _opened(_wanted(rig, clock, rig.rig.urls, arm, capture)) as opened:
                found: MicroScribe | None = opened.get("arm")
                if isinstance(answerer, Console) and found is not None:
                    pedals = found
                    answerer.watch_pedals(lambda: pedal_watch(pedals, clock))
                hands = opened.get("operator")
                yield Parts(clock, opened["cameras"], _operator(rig, answerer, hands), found)
    finally:
        if isinstance(clock, RealClock):
            clock.close()


def _wanted(
    rig: LoadedRig, clock: Clock, urls: dict[str, str], arm: bool, capture: Captures
) -> dict[str, Callable[[], Any]]:
    openers = driver_openers(rig, clock, urls, capture)
    return {
        name: opener
        for name, opener in openers.items()
        if name in ("cameras", "operator") or (arm and name == "arm")
    }


@contextmanager
def open_rig(
    rig: LoadedRig,
    *,
    seed: int,
    realtime: bool = False,
    capture: Captures = NO_CAPTURE,
    screen: Screen = nullcontext,
    start_s: float = 0.0,
) -> Iterator[Hookup]:
    """The drivers of ``rig``, with its emulators where it is an emulated one; ``capture`` taps
    links. Raises BringUpError.

    ``screen`` is entered around each question at the terminal. Real time goes on from ``start_s``.
    """
    emulated = bool(rig.rig.emulated)
    clock: Clock = VirtualClock() if in_virtual_time(rig, realtime=realtime) else RealClock(start_s)
    answerer = _answerer(rig, clock, screen)
    try:
        if emulated:
            with (
                EmulatedRig(rig, clock, seed) as twin,
                _connected(rig, clock, twin, answerer, capture) as devices,
            ):
                yield Hookup(devices, twin.world.ends_mm)
        else:
            with _connected(rig, clock, None, answerer, capture) as devices:
                if isinstance(answerer, Console):
                    answerer.watch_pedals(lambda: pedal_watch(devices.arm, clock))
                yield Hookup(devices, None)
    finally:
        if isinstance(clock, RealClock):
            clock.close()


def in_virtual_time(rig: LoadedRig, *, realtime: bool) -> bool:
    """Whether a run on ``rig`` need not wait: all is emulated, and nobody takes part in person, who
    lives in real time.
    """
    return bool(rig.rig.emulated) and not realtime and rig.rig.operator.url != CONSOLE


@contextmanager
def _connected(
    rig: LoadedRig,
    clock: Clock,
    twin: EmulatedRig | None,
    answerer: PromptedOperator | None,
    capture: Captures,
) -> Iterator[Devices]:
    openers = driver_openers(rig, clock, twin.urls if twin else rig.rig.urls, capture)
    if twin:
        openers["cameras"] = lambda: twin.cameras
    with _opened(openers) as opened:
        operator = _operator(rig, answerer, twin.operator if twin else opened.get("operator"))
        yield Devices(
            clock, opened["arm"], opened["bath"], opened.get("stage"), opened["cameras"], operator
        )


@contextmanager
def _opened(openers: dict[str, Callable[[], Any]]) -> Iterator[dict[str, Any]]:
    """All of them open; closed again at the end. Raises BringUpError that names each that did not
    come up.
    """
    opened, faults = {}, {}
    for name, opener in openers.items():
        try:
            opened[name] = opener()
        except InstrumentError as fault:
            faults[name] = fault
    try:
        if faults:
            raise BringUpError(faults)
        yield opened
    finally:
        for device in opened.values():
            device.close()


def _answerer(rig: LoadedRig, clock: Clock, screen: Screen) -> PromptedOperator | None:
    """Who answers prompts; None where an emulated operator acts without being asked. Raises
    ConfigError.
    """
    url = rig.rig.operator.url
    # a progress bar's stand-in ends each question with a line
    out = getattr(sys.stdout, "rich_proxied_file", sys.stdout)
    if url == CONSOLE:
        return Console(sys.stdin, out, clock, screen=screen, remind_s=rig.rig.operator.remind_s)
    if url.startswith(EMULATED):
        return None

    def show(text: str) -> None:
        # rich reads colours out of what is written under its bar
        sys.stdout.write(f"{sanitized(text)}\n")

    return load_answers(rig.path.parent / url.removeprefix(SCRIPT), show)


def _operator(
    rig: LoadedRig, answerer: PromptedOperator | None, hands: Operator | None = None
) -> Operator:
    if answerer is not None:
        answerer.hands = hands
        return answerer
    if hands is None:
        raise ConfigError.plain(f"{rig.path}: an emulated operator can't work on real instruments")
    return hands


def driver_openers(
    rig: LoadedRig, clock: Clock, urls: dict[str, str], capture: Captures = NO_CAPTURE
) -> dict[str, Callable[[], Any]]:
    """For each instrument of the rig, what opens its driver, with a tap of ``capture``; each may
    raise InstrumentError.
    """
    r = rig.rig

    def link(name: str, baud: int) -> Link:
        return Link(urls[name], clock, who=name, baud=baud, tap=capture.tap(name, clock))

    pump = (
        PumpAt(urls.get("pump", r.bath.pump_url), rig.relay, capture.tap("pump", clock))
        if rig.relay
        else None
    )
    openers: dict[str, Callable[[], Any]] = {
        "arm": lambda: MicroScribe(link("arm", r.arm.baud), clock, answer_s=r.arm.answer_s),
        "bath": lambda: Bath(
            urls["bath"],
            rig.profile,
            clock,
            allow_inferred=r.bath.allow_inferred,
            tap=capture.tap("bath", clock),
            pump=pump,
        ),
    }
    if r.stage:
        baud, axes = r.stage.baud, r.stage.axes
        openers["stage"] = lambda: Stage(link("stage", baud), clock, axes)
    if r.operator.url.startswith(ELSEWHERE):
        port = r.operator.url.replace(ELSEWHERE, "socket://")
        openers["operator"] = lambda: RemoteOperator(port, clock)
    if r.cameras.url != EMULATED:
        openers["cameras"] = lambda: open_cameras(
            r.cameras, rig.made_calibration, rig.path.parent, clock
        )
    return openers
