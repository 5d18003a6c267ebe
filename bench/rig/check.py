"""Connects to every instrument of a rig, one by one: who it is and one reading, or what is wrong.
Nothing moves or heats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, is_dataclass
from typing import Any

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig
from bench.rig.opening import driver_openers
from bench.rig.stage_alone import shown
from instruments.bath.profile import PUMP
from instruments.bath.sequence import has_own_pump
from instruments.captures.capture import NO_CAPTURE, Captures
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import InstrumentError


def check_rig(
    rig: LoadedRig, capture: Captures = NO_CAPTURE
) -> Iterator[tuple[str, bool, list[str]]]:
    """For each instrument: its name, whether it has a fault, and lines to print."""
    if rig.rig.emulated:
        clock = VirtualClock()
        with EmulatedRig(rig, clock, rig.rig.seed) as twin:
            yield from _check_all(rig, clock, twin.urls, {"cameras": lambda: twin.cameras}, capture)
        return
    real = RealClock()
    try:
        yield from _check_all(rig, real, rig.rig.urls, {}, capture)
    finally:
        real.close()


def _check_all(
    rig: LoadedRig,
    clock: Clock,
    urls: dict[str, str],
    more: dict[str, Callable[[], Any]],
    capture: Captures,
) -> Iterator[tuple[str, bool, list[str]]]:
    for name, opener in {**driver_openers(rig, clock, urls, capture), **more}.items():
        try:
            device = opener()
            try:
                yield (
                    name,
                    False,
                    [
                        *(f"{key}: {value}" for key, value in _READ[name](device)),
                        *_identity(device),
                        *_safe_state(device),
                    ],
                )
            finally:
                device.close()
        except InstrumentError as error:
            yield name, True, [str(error)]


def _identity(device: Any) -> list[str]:
    identity = (
        asdict(device.identity)
        if is_dataclass(device.identity) and not isinstance(device.identity, type)
        else dict(device.identity)
    )
    return [f"{key}: {value}" for key, value in identity.items()]


def _safe_state(device: Any) -> list[str]:
    """As the driver declares it; cameras have none."""
    return [f"safe state: {device.safe_state}"] if hasattr(device, "safe_state") else []


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
    for name in ("left", "right", "thermal"):
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
