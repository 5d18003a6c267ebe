"""Opens the instruments of a rig, real or emulated: the only place that does. A bring-up that fails
names every instrument that failed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, cast

from bench.record.recording import Recording, RecordingCameras
from bench.rig.devices import Devices
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.leaving import Leaving, Opened, to_stderr
from bench.rig.loading import LoadedRig
from bench.rig.model import Emulation, OneCamera, Operator, Rig, ThermalTable
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import BROWSER, CONSOLE, ELSEWHERE, EMULATED, PEOPLE, SCRIPT
from detector.calibration import Calibration
from instruments.bath.driver import Bath, PumpAt
from instruments.bath.profile import Profile
from instruments.camera.cameras import KNOWN, Camera, CameraSet
from instruments.camera.files import FileCamera
from instruments.camera.frame import Conversion
from instruments.camera.genicam import DeviceTime, GenicamCamera
from instruments.camera.opencv import OpenCvCamera
from instruments.captures.capture import CaptureFile
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.drivers.protocols import Arm, Cameras
from instruments.errors import DeviceError, InstrumentError
from instruments.link import Link, Tap
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.pedals import Debouncer
from instruments.operators.console import Console
from instruments.operators.mailbox import Mailbox
from instruments.operators.prompted import PromptedOperator
from instruments.operators.remote import RemoteOperator
from instruments.points import PointArm, points_url
from instruments.stage.driver import Stage
from instruments.stage.zaber import Motor
from reports.sanitize import sanitized

ALL = ("arm", "bath", "stage", "operator", "cameras")
INTERVAL_S = 0.005

Screen = Callable[[], AbstractContextManager[None]]


class BringUpError(InstrumentError):
    """Instruments that did not come up, each with its own fault."""

    def __init__(self, faults: dict[str, InstrumentError]) -> None:
        self.faults = faults
        lines = [f"{len(faults)} instrument{'s' if len(faults) > 1 else ''} did not come up"]
        super().__init__("rig", "\n  ".join([*lines, *(str(fault) for fault in faults.values())]))


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
    capture: CaptureFile | None = None,
    screen: Screen = nullcontext,
    start_s: float = 0.0,
    identify: bool = True,
    folder: Path | None = None,
) -> AbstractContextManager[Devices]:
    """The instruments ``names`` of ``rig``, closed at the end; others are None. Without ``clock``
    time is virtual where all is emulated and no person takes part. ``twin``: emulators already up;
    ``screen`` is entered around a question; ``folder``: of a run with a browser. Raises
    BringUpError, or a single instrument's fault, and ConfigError.

    What was made to heat or to move is made safe at the end (NotSafeError where it could not be,
    which ``warn`` gets too), and by a guardian where the process dies. ``leave_running``: it goes
    on, which is noted beside the rig file; ``supervised``: the caller sees to all that.
    """
    if twin is None:
        rig.refuse_unfilled(*names)
    emulated = twin is not None or any(rig.rig.urls.get(name) == EMULATED for name in names)

    def leaving(devices: Devices) -> Leaving:
        # emulators of this process die with it
        guards = not emulated and not isinstance(devices.clock, VirtualClock)
        return Leaving(rig, devices, guards=guards, leave_running=leave_running, warn=warn)

    def clock_in(stack: ExitStack) -> Clock:
        person = "operator" in names and rig.rig.operator.url in PEOPLE
        if emulated and not realtime and not person:
            return VirtualClock()
        return stack.enter_context(closing(RealClock(start_s)))

    @contextmanager
    def opened() -> Iterator[Devices]:
        with ExitStack() as stack:
            time = clock or clock_in(stack)
            answerer = _answerer(rig, time, screen, folder) if "operator" in names else None
            seeded = rig.rig.seed if seed is None else seed
            world = twin
            if emulated and world is None:
                world = stack.enter_context(EmulatedRig(rig, time, seeded))
            openers = _openers(rig, time, world, capture, identify=identify)
            found = _opened(stack, names, openers)
            yield _together(found, time, world, answerer, names)

    return Opened(opened(), None if supervised else leaving)


def _opened(
    stack: ExitStack, names: Sequence[str], openers: Mapping[str, Callable[[], Any]]
) -> dict[str, Any]:
    """Each instrument, to be closed with ``stack``. Raises BringUpError, or a single fault."""
    found: dict[str, Any] = {}
    faults: dict[str, InstrumentError] = {}
    for name in names:
        if name in openers:
            try:
                found[name] = stack.enter_context(closing(openers[name]()))
            except InstrumentError as fault:
                faults[name] = fault
    if faults:
        raise next(iter(faults.values())) if len(names) == 1 else BringUpError(faults)
    return found


def _together(
    opened: Mapping[str, Any],
    clock: Clock,
    twin: EmulatedRig | None,
    answerer: PromptedOperator | None,
    names: Sequence[str],
) -> Devices:
    arm: Any
    bath: Any
    cameras: Any
    arm, bath, stage, cameras = (opened.get(n) for n in ("arm", "bath", "stage", "cameras"))
    if isinstance(answerer, Console) and twin is None and arm and arm.pedals:
        answerer.watch_pedals(lambda: pedal_watch(arm, clock))
    hands: Any = twin.operator if twin and "operator" in names else opened.get("operator")
    if answerer:
        answerer.hands = hands
    if arm:
        arm.asked_of(answerer or hands)
    exact_ends = twin.world.ends_mm if twin else None
    return Devices(clock, arm, bath, stage, cameras, answerer or hands, exact_ends)


def in_virtual_time(rig: LoadedRig, *, realtime: bool) -> bool:
    """Whether a run need not wait: all is emulated, and no person takes part."""
    return bool(rig.rig.emulated) and not realtime and rig.rig.operator.url not in PEOPLE


def rig_of(profile: Profile | None = None, **tables: Any) -> LoadedRig:
    """A rig without a file: ``tables`` by name, and the bath's ``profile``."""
    more = {"stage": None, "operator": Operator(url=CONSOLE), "emulation": Emulation(), "seed": 1}
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
    if kind == "files":
        return FileCamera(name, folder / rest, clock)
    beside = folder / rest
    source = str(beside) if "://" not in rest and beside.is_file() else rest
    return OpenCvCamera(name, int(rest) if rest.isdecimal() else source, clock, table.settings)


def _open_cameras(rig: LoadedRig, clock: Clock) -> Cameras:
    """Paths are taken from the rig file's folder. Raises InstrumentError, RecordingError."""
    folder, tables = rig.path.parent, rig.rig.cameras.tables
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
    return CameraSet(openers, {name: conversion_of(t, made) for name, t in tables.items()})


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


def _openers(
    rig: LoadedRig,
    clock: Clock,
    twin: EmulatedRig | None,
    capture: CaptureFile | None,
    *,
    identify: bool,
) -> dict[str, Callable[[], Any]]:
    r = rig.rig
    urls = twin.urls if twin else r.urls

    def tap(name: str) -> Tap | None:
        return capture.tap(name, clock) if capture else None

    def link(name: str, baud: int) -> Link:
        return Link(urls[name], clock, who=name, baud=baud, tap=tap(name))

    def arm() -> Arm:
        if points := points_url(urls["arm"]):
            return PointArm(points, rig.path.parent, clock, r.arm.accuracy_mm, r.arm.resolution_mm)
        return MicroScribe(link("arm", r.arm.baud), clock, answer_s=r.arm.answer_s)

    def bath() -> Bath:
        pump_url = urls.get("pump", r.bath.pump_url)
        elsewhere = r.operator.url.startswith(ELSEWHERE) and r.bath_emulated
        emulated = elsewhere or (twin is not None and "bath" in twin.urls)
        return Bath(
            urls["bath"],
            rig.profile,
            clock,
            allow_inferred=r.bath.allow_inferred,
            # an emulated controller has no display, and is in degC unless a fault changes it
            unit_confirmed=bool(r.bath.unit_confirmed or emulated),
            identify=identify,
            tap=tap("bath"),
            pump=PumpAt(pump_url, rig.relay, tap("pump")) if rig.relay else None,
        )

    openers: dict[str, Callable[[], Any]] = {
        "arm": arm,
        "bath": bath,
        "cameras": lambda: twin.cameras if twin else _open_cameras(rig, clock),
    }
    if stage := r.stage:
        motors = [Motor(*motor) for motor in stage.motors]
        openers["stage"] = lambda: Stage(
            link("stage", stage.baud), clock, stage.axes, dialect=stage.dialect, motors=motors
        )
    if r.operator.url.startswith(ELSEWHERE):
        port = r.operator.url.replace(ELSEWHERE, "socket://")
        openers["operator"] = lambda: RemoteOperator(port, clock)
    return openers
