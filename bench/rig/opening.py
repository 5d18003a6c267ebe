"""Opens the instruments of a rig, real or emulated: the only place that does. A bring-up that fails
names every instrument that failed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import (
    AbstractContextManager,
    ExitStack,
    closing,
    contextmanager,
    nullcontext,
    suppress,
)
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from bench.record.recording import Recording, RecordingCameras
from bench.rig.devices import Devices
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.leaving import Leaving, OpenInstruments, to_stderr
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.rig.model import Emulation, OneCamera, OperatorTable, Rig, StageTable, ThermalTable
from bench.rig.practice import Practice, following
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import BROWSER, CONSOLE, ELSEWHERE, EMULATED, PEOPLE, SCRIPT
from detector.calibration import Calibration
from instruments.bath.driver import OwnBath, PumpAt
from instruments.bath.profile import Profile
from instruments.camera.cameras import KNOWN, Camera, CameraSet
from instruments.camera.files import FileCamera
from instruments.camera.frame import Conversion
from instruments.camera.genicam import DeviceTime, GenicamCamera
from instruments.camera.opencv import OpenCvCamera
from instruments.captures.capture import CaptureFile
from instruments.clock import Clock, PacedClock, RealClock, VirtualClock
from instruments.drivers.arm import PluggedArm
from instruments.drivers.bath import PluggedBath
from instruments.drivers.camera import PluggedCamera, PluggedGroup
from instruments.drivers.entry_points import Kind, Plugin, load, plugin_url
from instruments.drivers.protocols import Arm, Bath, Cameras, Stage
from instruments.drivers.stage import PluggedStage
from instruments.errors import DeviceError, InstrumentError
from instruments.link import Link, Tap
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.pedals import Debouncer
from instruments.operators.console import Console
from instruments.operators.mailbox import Mailbox
from instruments.operators.prompted import PromptedOperator
from instruments.operators.remote import RemoteOperator
from instruments.points import PointArm, points_url
from instruments.stage.driver import OwnStage
from instruments.world.world import World
from reports.sanitize import sanitized
from textfiles.text import plural

ALL = ("arm", "bath", "stage", "operator", "cameras")
INTERVAL_S = 0.005

Screen = Callable[[], AbstractContextManager[None]]


class BringUpError(InstrumentError):
    """Instruments that did not come up, each with its own fault."""

    def __init__(self, faults: dict[str, InstrumentError]) -> None:
        self.faults = faults
        lines = [f"{plural(len(faults), 'instrument')} did not come up"]
        super().__init__("rig", "\n  ".join([*lines, *(str(fault) for fault in faults.values())]))


class AnswerTimes(Tap):
    """Notes when each instrument was asked the question that it answered last; everything goes on
    to ``then``. The time of reading is not used: an answer may have waited for long.
    """

    def __init__(self, name: str, clock: Clock, answered_s: dict[str, float], then: Tap) -> None:
        self._name, self._clock, self._answered_s, self._then = name, clock, answered_s, then
        self._asked_s = 0.0

    def opened(self, url: str) -> None:
        self._asked_s = self._clock.now()
        self._then.opened(url)

    def sent(self, data: bytes) -> None:
        self._asked_s = self._clock.now()
        self._then.sent(data)

    def closed(self, why: str = "") -> None:
        self._then.closed(why)

    def received(self, data: bytes) -> None:
        self._answered_s[self._name] = self._asked_s
        self._then.received(data)


def open_instruments(
    rig: LoadedRig,
    names: Sequence[str] = ALL,
    clock: Clock | None = None,
    *,
    leave_running: bool = False,
    supervised: bool = False,
    warn: Callable[[str], None] = to_stderr,
    twin: EmulatedRig | None = None,
    seed: int | None = None,
    realtime: bool = False,
    speed: float | None = None,
    capture: CaptureFile | None = None,
    screen: Screen = nullcontext,
    start_s: float = 0.0,
    identify: bool = True,
    folder: Path | None = None,
) -> AbstractContextManager[Devices]:
    """The instruments ``names`` of ``rig``, closed at the end; others are None. Without ``clock``
    time is virtual where all is emulated and no person takes part. ``twin``: emulators already up;
    ``screen`` is entered around a question; ``folder``: of a run with a browser; ``speed`` of
    emulators in real time. Raises BringUpError, or a single instrument's fault, and ConfigError.

    What was made to heat or to move is made safe at the end (NotSafeError where it could not be,
    which ``warn`` gets too), and by a guardian where the process dies. ``leave_running``: it goes
    on, which is noted beside the rig file; ``supervised``: the caller does all of that.
    """
    if twin is None:
        rig.refuse_unfilled(*names)
    emulated = set(names) & set(rig.rig.emulated)
    real = (set(names) & set(rig.rig.urls)) - emulated - ({"operator"} if emulated else set())

    def leaving(devices: Devices) -> Leaving:
        # emulators of this process die with it
        virtual = twin is not None or isinstance(devices.clock, VirtualClock)
        guards = set() if virtual else {"bath", "stage"} & real
        return Leaving(rig, devices, guards, leave_running, warn)

    def clock_in(stack: ExitStack) -> Clock:
        person = "operator" in names and rig.rig.by_person
        if (emulated or twin) and not real and not realtime and not person:
            return VirtualClock(start_s)
        if speed is not None and rig.rig.simulated:  # nothing real is hurried
            return PacedClock(speed, start_s)
        return stack.enter_context(closing(RealClock(start_s)))

    @contextmanager
    def opened() -> Iterator[Devices]:
        with ExitStack() as stack:
            time = clock or clock_in(stack)
            answerer = _answerer(rig, time, screen, folder) if "operator" in names else None
            if answerer:
                answerer.in_run = folder is not None
            seeded = rig.rig.seed if seed is None else seed
            world = twin
            if emulated and world is None:
                drawn = not {"cameras", "operator"}.isdisjoint(names)
                world = stack.enter_context(EmulatedRig(rig, time, seeded, drawn=drawn))
            together = _BringUp(rig, time, world, capture, identify).all(stack, names, answerer)
            if world and type(time) is not VirtualClock:
                practice = partial(following, Practice(world), time, speed or 1.0)
                together = replace(together, practice=practice)
            yield together

    return OpenInstruments(opened(), None if supervised else leaving)


@contextmanager
def emulated_world(clock: Clock, *, drawn: bool = False) -> Iterator[World]:
    """The world of the shipped emulated rig, for an emulator of another package. ``drawn``: once
    before, as the first picture loads what draws, and a driver's limit is real time.
    """
    with EmulatedRig(load_rig(find_rig(None)), clock, 1) as twin:
        if drawn:
            twin.cameras.capture()
        yield twin.world


def in_virtual_time(rig: LoadedRig, *, realtime: bool) -> bool:
    """Whether a run need not wait: all is emulated, and no person takes part."""
    return rig.rig.simulated and not realtime and not rig.rig.by_person


def rig_of(profile: Profile | None = None, **tables: Any) -> LoadedRig:
    """A rig without a file: ``tables`` by name, and the bath's ``profile``."""
    more = {
        "stage": None,
        "operator": OperatorTable(url=CONSOLE),
        "emulation": Emulation(),
        "seed": 1,
    }
    rig = Rig.model_construct(**(more | tables))
    return LoadedRig(Path(), "", rig, cast(Profile, profile), Path(), None)


def pedal_watch(arm: Arm, clock: Clock) -> Callable[[float], bool]:
    """Waits some seconds for a pedal; True once one was pressed since the first call. A pedal that
    is down at first must come up. Raises as polling.
    """
    debouncer = Debouncer()

    def pressed(seconds: float) -> bool:
        end_s = clock.now() + seconds
        while True:
            if any(event.pressed for event in debouncer.feed(clock.now(), arm.buttons())):
                return True
            if clock.now() >= end_s:
                return False
            clock.sleep(INTERVAL_S)

    return pressed


def conversion_of(table: OneCamera, calibration: Calibration | None) -> Conversion:
    """Conversion of a camera's frames to the calibration's; as delivered without one."""
    if not isinstance(table, ThermalTable):
        return table.conversion()
    thermal = calibration.thermal if calibration else None
    mirrored = thermal.mirrored if thermal else bool(table.mirrored)
    polarity = thermal.polarity if thermal else table.polarity
    return table.calibrated(mirrored=mirrored, hot_is_black=polarity == "hot_is_black")


def open_camera(
    name: str, table: OneCamera, folder: Path, clock: Clock, in_step: DeviceTime | None = None
) -> Camera:
    """One camera of a rig file in ``folder``. Raises InstrumentError."""
    kind, _, rest = table.url.partition(":")
    if kind == "genicam":
        return GenicamCamera(name, rest, clock, table.settings, in_step=in_step)
    if plug := plugin_url(table.url):
        return PluggedCamera(load("camera", plug), name, clock)
    if kind == "files":
        return FileCamera(name, folder / rest, clock)
    beside = folder / rest
    source = str(beside) if "://" not in rest and beside.is_file() else rest
    return OpenCvCamera(name, int(rest) if rest.isdecimal() else source, clock, table.settings)


def _answerer(
    rig: LoadedRig, clock: Clock, screen: Screen, folder: Path | None
) -> PromptedOperator | None:
    """Who answers prompts; None for an emulated operator. Without a run's ``folder`` a browser's
    operator is asked at the terminal. Raises ConfigError.
    """
    url = rig.rig.operator.url
    if url in PEOPLE:
        # a progress bar's stand-in ends each question with a line
        out = getattr(sys.stdout, "rich_proxied_file", sys.stdout)
        mailbox = Mailbox(folder) if folder and url == BROWSER else None
        remind_s = rig.rig.operator.remind_s
        return Console(sys.stdin, out, clock, screen=screen, remind_s=remind_s, mailbox=mailbox)
    if url.startswith(EMULATED):
        return None

    def show(text: str) -> None:
        # rich reads colours out of what is written under its bar
        sys.stdout.write(f"{sanitized(text)}\n")

    return load_answers(rig.path.parent / url.removeprefix(SCRIPT), show)


@dataclass(eq=False)
class _BringUp:
    """Opens the instruments of ``rig``, by the rig file or on the emulators of ``twin``."""

    rig: LoadedRig
    clock: Clock
    twin: EmulatedRig | None
    capture: CaptureFile | None
    identify: bool

    def __post_init__(self) -> None:
        self._answered_s: dict[str, float] = {}
        self._ports = self.twin.urls if self.twin else {}  # of emulators
        # a port of an emulator for what is emulated, else what the rig file says
        r = self.rig.rig
        emulated = (*r.emulated, *(["pump"] if "bath" in r.emulated else []))
        ours = {name: url for name, url in self._ports.items() if name in emulated}
        self._urls = r.urls | ours

    def all(
        self, stack: ExitStack, names: Sequence[str], answerer: PromptedOperator | None
    ) -> Devices:
        """Those of ``names``, closed with ``stack``. Raises BringUpError, or a single fault."""
        opened: dict[str, Any] = {}
        faults: dict[str, InstrumentError] = {}
        openers = self._openers()
        for name in names:
            if name in openers:
                try:
                    opened[name] = stack.enter_context(closing(openers[name]()))
                except InstrumentError as fault:
                    faults[name] = fault
        if faults:
            raise next(iter(faults.values())) if len(names) == 1 else BringUpError(faults)
        one: Callable[[str], Any] = opened.get
        twin, hands, arm = self.twin, one("operator"), one("arm")
        if twin:
            self._follow(twin, one("bath"), one("stage"))
            hands = twin.operator if "operator" in names else hands
        if arm and isinstance(answerer, Console) and not twin and arm.pedals:
            answerer.watch_pedals(lambda: pedal_watch(arm, self.clock))
        if answerer:
            answerer.hands = hands
        if arm:
            arm.asked_of(answerer or hands)
        exact = twin and {"arm", "cameras"} <= set(self.rig.rig.emulated)
        devices = self.clock, arm, one("bath"), one("stage"), one("cameras")
        exact_ends = twin.world.ends_mm if twin and exact else None
        return Devices(*devices, answerer or hands, exact_ends, self._answered_s)

    def _follow(self, twin: EmulatedRig, bath: Bath | None, stage: Stage | None) -> None:
        """The emulated world follows what isn't emulated."""
        if bath and "bath" not in self.rig.rig.emulated:
            bath.on_reading = twin.follow_bath
        if stage and "stage" not in self.rig.rig.emulated:
            last = [0.0] * 4

            def place() -> list[float]:
                with suppress(InstrumentError):  # not connected yet, or lost: as it was
                    last[: len(stage.axes)] = stage.position().tolist()
                return last

            twin.follow_stage(self.rig.rig, place)

    def _openers(self) -> dict[str, Callable[[], Any]]:
        """By instrument, of those that the rig has."""
        r = self.rig.rig
        found: dict[str, Callable[[], Any]] = {"arm": self._arm, "bath": self._bath}
        found["cameras"] = self._cameras
        if r.stage:
            found["stage"] = partial(self._stage, r.stage)
        if r.operator.url.startswith(ELSEWHERE):
            port = r.operator.url.replace(ELSEWHERE, "socket://")
            found["operator"] = lambda: RemoteOperator(port, self.clock)
        return found

    def _driver(self, kind: Kind, url: str) -> Plugin | None:
        """The plug-in of ``url``, with its emulator's port; None where it names none."""
        if not (plug := plugin_url(url)):
            return None
        name = "cameras" if kind == "camera" else kind
        return load(kind, plug).with_keys(**{"url": self._ports[name]} if plug.emulated else {})

    def _tap(self, name: str) -> Tap:
        then = self.capture.tap(name, self.clock) if self.capture else Tap()
        return AnswerTimes(name, self.clock, self._answered_s, then)

    def _link(self, name: str, baud: int) -> Link:
        return Link(self._urls[name], self.clock, who=name, baud=baud, tap=self._tap(name))

    def _arm(self) -> Arm:
        table, clock = self.rig.rig.arm, self.clock
        if plugged := self._driver("arm", table.url):
            return PluggedArm(plugged, clock)
        if points := points_url(self._urls["arm"]):
            folder = self.rig.path.parent
            return PointArm(points, folder, clock, table.accuracy_mm, table.resolution_mm)
        return MicroScribe(self._link("arm", table.baud), clock, answer_s=table.answer_s)

    def _bath(self) -> Bath:
        r, relay = self.rig.rig, self.rig.relay
        if plugged := self._driver("bath", r.bath.url):
            return PluggedBath(plugged, self.clock, identify=self.identify)
        elsewhere = r.operator.url.startswith(ELSEWHERE) and r.bath_emulated
        emulated = elsewhere or "bath" in r.emulated
        pump_url = self._urls.get("pump", r.bath.pump_url)
        return OwnBath(
            self._urls["bath"],
            self.rig.profile,
            self.clock,
            allow_inferred=r.bath.allow_inferred,
            # an emulated controller has no display, and is in degC unless a fault changes it
            unit_confirmed=bool(r.bath.unit_confirmed or emulated),
            identify=self.identify,
            tap=self._tap("bath"),
            pump=PumpAt(pump_url, relay, self._tap("pump")) if relay else None,
        )

    def _stage(self, table: StageTable) -> Stage:
        if plugged := self._driver("stage", table.url):
            return PluggedStage(plugged, self.clock, table.axes)
        link = self._link("stage", table.baud)
        return OwnStage(link, self.clock, table.axes, dialect=table.dialect)

    def _cameras(self) -> Cameras:
        rig, clock = self.rig, self.clock
        if self.twin and rig.rig.cameras.url == EMULATED:
            return self.twin.cameras
        folder, tables = rig.path.parent, rig.rig.cameras.tables  # paths are from there
        plugged = self._driver("camera", rig.rig.cameras.url)
        group = partial(PluggedGroup, plugged, clock) if plugged else None
        kind, _, rest = rig.rig.cameras.url.partition(":")
        if kind == "recording":
            return RecordingCameras(Recording(folder / rest))
        if kind == "opencv":
            sources = rest.split(",")
            if not 2 <= len(sources) <= len(KNOWN):
                what = f"needs two or three sources for left, right and thermal, got {rest!r}"
                hint = "Correct the cameras in the rig file."
                raise DeviceError("OpenCV cameras", what, hint=hint)
            urls = dict(zip(KNOWN, sources, strict=False))
            tables = {name: OneCamera(url=f"opencv:{url}") for name, url in urls.items()}
        at = folder, clock, DeviceTime()
        openers = {name: partial(open_camera, name, t, *at) for name, t in tables.items()}
        made = rig.made_calibration
        conversions = {name: conversion_of(t, made) for name, t in tables.items()}
        return CameraSet(openers, conversions, group)
