"""Faults of emulated instruments, as a rig file names them: which there are, and the two actions of
each, one that breaks something and one that mends it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from bench.config import did_you_mean
from instruments.camera import emulator as camera_faults
from instruments.microscribe import faults as arm_faults

if TYPE_CHECKING:
    from instruments.bath.emulator import BathEmulator
    from instruments.bath.relay_emulator import RelayEmulator
    from instruments.camera.emulator import EmulatedCameras
    from instruments.microscribe.emulator import ArmEmulator
    from instruments.stage.emulator import StageEmulator

LATE_ANSWER = "late answer"
Actions = tuple[Callable[[], None], Callable[[], None]]


class Request(Protocol):
    """One fault of a rig file. ``times`` and ``amount`` are None where the file leaves them to the
    emulator.
    """

    @property
    def name(self) -> str: ...
    @property
    def times(self) -> int | None: ...
    @property
    def amount(self) -> float | None: ...
    @property
    def camera(self) -> str | None: ...


def fault_names(instrument: str) -> tuple[str, ...]:
    """What can go wrong with the emulated "arm", "bath", "pump"
    (its relay), "cameras" or "stage".
    """
    if instrument == "arm":
        return tuple(arm_faults.Fault)
    if instrument == "cameras":
        return tuple(camera_faults.FAULTS)
    if instrument == "bath":
        from instruments.bath.emulator import FAULTS

        return tuple(FAULTS)
    if instrument == "pump":
        from instruments.bath.relay_emulator import RELAY_FAULTS

        return RELAY_FAULTS
    from instruments.stage.emulator.board import Fault

    return tuple(fault.value for fault in Fault)


def check_wish(instrument: str, wish: Request) -> None:
    """Raise ValueError unless the instrument has that fault, so often and of that amount."""
    known = fault_names(instrument)
    if wish.name not in known:
        has = "have" if instrument == "cameras" else "has"
        raise ValueError(
            f'the {instrument} {has} no fault "{wish.name}"{did_you_mean(wish.name, known)} (there'
            f" are: {', '.join(known)})"
        )
    if wish.times is not None and instrument not in ("arm", "cameras"):
        raise ValueError(
            f'"times" is for faults of the arm and the cameras; one of the {instrument} lasts until'
            " for_s have passed"
        )
    if wish.camera is not None and instrument != "cameras":
        raise ValueError(f'"camera" is for faults of the cameras, the {instrument} has none')
    if instrument == "arm":
        arm_faults.check_amount(arm_faults.named(wish.name), wish.amount)
    elif instrument == "cameras":
        camera_faults.check_amount(camera_faults.named(wish.name), wish.amount)
        camera_faults.check_camera(camera_faults.named(wish.name), wish.camera)
    elif instrument == "stage":
        _check_stage_amount(wish)
    elif instrument in ("bath", "pump") and wish.amount is not None and wish.name != LATE_ANSWER:
        raise ValueError(
            f'of the {instrument}\'s faults only "{LATE_ANSWER}" has an amount, in seconds'
        )


def arm_actions(arm: ArmEmulator, wish: Request) -> Actions:
    """``amount`` is what `instruments.microscribe.faults.AMOUNTS` says."""
    times = arm_faults.FOREVER if wish.times is None else wish.times
    return lambda: arm.faults.inject(
        wish.name, times, amount=wish.amount
    ), lambda: arm.faults.clear(wish.name)


def camera_actions(cameras: EmulatedCameras, wish: Request) -> Actions:
    """``amount`` is what `instruments.camera.emulator_faults.AMOUNTS` says, ``times`` counts frame
    sets.
    """
    times = camera_faults.FOREVER if wish.times is None else wish.times
    faults = cameras.faults
    return lambda: faults.inject(
        wish.name, times, camera=wish.camera, amount=wish.amount
    ), lambda: faults.clear(wish.name)


def bath_actions(bath: BathEmulator, wish: Request) -> Actions:
    """``amount`` is how late a late answer is, in seconds."""
    return _modbus_actions(bath, wish)


def pump_actions(relay: RelayEmulator, wish: Request) -> Actions:
    """As `bath_actions`, for the relay of its pump."""
    return _modbus_actions(relay, wish)


def _modbus_actions(device: BathEmulator | RelayEmulator, wish: Request) -> Actions:
    def break_it() -> None:
        if wish.amount is not None:
            device.late_s = wish.amount
        device.fault(wish.name)

    return break_it, lambda: device.fault(wish.name, on=False)


def stage_actions(stage: StageEmulator, wish: Request) -> Actions:
    """``amount`` is what `instruments.stage.emulator.board.AMOUNTS` says."""
    from instruments.stage.emulator.board import LATE_S, LOST_MM, Fault

    fault, amount = Fault(wish.name), wish.amount
    if fault is Fault.LOST_STEP:
        return lambda: stage.inject(
            fault, lost_mm=LOST_MM if amount is None else amount
        ), lambda: stage.cure(fault)
    after_s = amount if amount is not None else LATE_S if fault is Fault.LATE_OK else 0.0
    return lambda: stage.inject(fault, after_s), lambda: stage.cure(fault)


def _check_stage_amount(wish: Request) -> None:
    from instruments.stage.emulator.board import AMOUNTS, Fault

    if wish.amount is not None and Fault(wish.name) not in AMOUNTS:
        having = ", ".join(f'"{fault.value}" ({unit})' for fault, unit in AMOUNTS.items())
        raise ValueError(f'the stage\'s fault "{wish.name}" has no amount; one have {having}')
