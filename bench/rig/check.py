"""Connects to every instrument of a rig, one by one: who it is and one reading, or what is wrong.
Nothing moves or heats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict, is_dataclass
from typing import Any

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig
from bench.rig.opening import ALL, open_instruments
from bench.rig.stage_alone import shown
from bench.rig.urls import ELSEWHERE
from instruments.bath.profile import PUMP
from instruments.bath.sequence import has_own_pump
from instruments.camera.cameras import KNOWN
from instruments.captures.capture import NO_CAPTURE, Captures
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import InstrumentError


def check_rig(
    rig: LoadedRig, capture: Captures = NO_CAPTURE
) -> Iterator[tuple[str, bool, list[str]]]:
    """For each instrument: its name, whether it has a fault, and lines to print."""
    remote = rig.rig.operator.url.startswith(ELSEWHERE)
    names = [n for n in ALL if n in rig.rig.urls and (n != "operator" or remote)]
    with ExitStack() as stack:
        clock: Clock
        twin = None
        if rig.rig.emulated:
            clock = VirtualClock()
            twin = stack.enter_context(EmulatedRig(rig, clock, rig.rig.seed))
        else:
            clock = stack.enter_context(closing(RealClock()))
        for name in names:
            try:
                with open_instruments(rig, (name,), clock, twin=twin, capture=capture) as devices:
                    device = getattr(devices, name)
                    told = [*_READ[name](device)]
                    who: Any = device.identity
                    if is_dataclass(who) and not isinstance(who, type):
                        who = asdict(who)
                    told += who.items()
                    if hasattr(device, "safe_state"):  # cameras have none
                        told.append(("safe state", device.safe_state))
                    yield name, False, [f"{key}: {value}" for key, value in told]
            except InstrumentError as error:
                yield name, True, [str(error)]


def _arm(arm: Any) -> Iterator[tuple[str, str]]:
    arm.sign_on()
    packet = arm.poll()
    yield "counts", " ".join(str(count) for count in packet.counts)
    for warning in arm.warnings:
        yield "warning", warning
    yield "position", "only after homing is confirmed ('teatbench run' asks for it)"


def _bath(bath: Any) -> Iterator[tuple[str, str]]:
    reading = bath.read()
    yield "temperature", f"{reading.temp_c:.2f} degC, output {reading.power_percent} %"
    if has_own_pump(bath):
        yield "pump", bath.profile.row(PUMP).label(bath.get(PUMP))
    elif bath.pump == "none":
        yield "pump", "not fitted to the controller"


def _stage(stage: Any) -> Iterator[tuple[str, str]]:
    stage.connect()
    yield "position", shown(stage) + " (machine)" + ("" if stage.homed else ", not homed")


def _cameras(cameras: Any) -> Iterator[tuple[str, str]]:
    frames = cameras.capture()
    for name in KNOWN:
        image = getattr(frames, name)
        if image is not None:
            yield name, f"{image.shape[1]} x {image.shape[0]}, mean level {image.mean():.1f}"


_READ: dict[str, Callable[[Any], Iterator[tuple[str, str]]]] = {
    "arm": _arm,
    "bath": _bath,
    "stage": _stage,
    "cameras": _cameras,
    "operator": lambda _: iter(()),
}
