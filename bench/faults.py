"""Faults of emulated instruments, as a rig file names them: which there are, and how each instrument is told.

The instruments' emulators have words of their own for it; here they become two actions, one that breaks something and one
that mends it. Emulators are imported only where a file names a fault: a real rig needs none. It may not know what a fault
does, nor when it is time for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from bench.config import did_you_mean
from instruments.microscribe import faults as arm_faults

if TYPE_CHECKING:
    from instruments.bath.emulator import BathEmulator
    from instruments.microscribe.emulator import ArmEmulator
    from instruments.stage.emulator import StageEmulator

LATE_ANSWER = "late answer"
Actions = tuple[Callable[[], None], Callable[[], None]]


class Wish(Protocol):
    """One fault of a rig file. ``times`` and ``amount`` are None where the file leaves them to the emulator."""

    @property
    def name(self) -> str: ...
    @property
    def times(self) -> int | None: ...
    @property
    def amount(self) -> float | None: ...


def fault_names(instrument: str) -> tuple[str, ...]:
    """What can go wrong with the emulated "arm", "bath" or "stage"."""
    if instrument == "arm":
        return tuple(arm_faults.Fault)
    if instrument == "bath":
        from instruments.bath.emulator import FAULTS

        return tuple(FAULTS)
    from instruments.stage.emulator.faults import Fault

    return tuple(fault.value for fault in Fault)


def check_wish(instrument: str, wish: Wish) -> None:
    """Raise ValueError unless the instrument has that fault, so often and of that amount."""
    known = fault_names(instrument)
    if wish.name not in known:
        raise ValueError(f'the {instrument} has no fault "{wish.name}"{did_you_mean(wish.name, known)} (it has: {", ".join(known)})')
    if wish.times is not None and instrument != "arm":
        raise ValueError(f'"times" is for faults of the arm; one of the {instrument} lasts until for_s have passed')
    if instrument == "arm":
        arm_faults.check_amount(arm_faults.named(wish.name), wish.amount)
    elif instrument == "bath" and wish.amount is not None and wish.name != LATE_ANSWER:
        raise ValueError(f'of the bath\'s faults only "{LATE_ANSWER}" has an amount, in seconds')


def arm_actions(arm: ArmEmulator, wish: Wish) -> Actions:
    """``amount`` is what `instruments.microscribe.faults.AMOUNTS` says."""
    times = arm_faults.FOREVER if wish.times is None else wish.times
    return lambda: arm.faults.inject(wish.name, times, amount=wish.amount), lambda: arm.faults.clear(wish.name)


def bath_actions(bath: BathEmulator, wish: Wish) -> Actions:
    """``amount`` is how late a late answer is, in seconds."""

    def break_it() -> None:
        if wish.amount is not None:
            bath.late_s = wish.amount
        bath.fault(wish.name)

    return break_it, lambda: bath.fault(wish.name, on=False)


def stage_actions(stage: StageEmulator, wish: Wish) -> Actions:
    """``amount`` is how far into a motion it strikes, or how late a late answer is, in seconds."""
    from instruments.stage.emulator.faults import Fault

    fault = Fault(wish.name)
    return lambda: stage.inject(fault, wish.amount or 0.0), lambda: stage.cure(fault)
