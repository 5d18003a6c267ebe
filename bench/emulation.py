"""Stands up an emulated rig in this process: one world, and an emulator for each instrument, on a loopback port or a pty."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from bench.config import located, read_text
from bench.faults import Actions, arm_actions, bath_actions, stage_actions
from bench.rig import EmulatedFault, LoadedRig
from detector.geometry import Motion
from instruments.bath.emulator import BathEmulator, Framing
from instruments.camera.emulator import EmulatedCameras
from instruments.clock import Clock
from instruments.listener import Device, Listener
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.mechanics import Hand
from instruments.operators.emulated import EmulatedOperator
from instruments.pty_listener import PtyListener
from instruments.stage.emulator import StageEmulator
from instruments.world.optics import cameras_from_calibration
from instruments.world.scene import Renderer
from instruments.world.world import World


class PlacedHand:
    """The world's hand as an arm sees it that stands at ``world_from_arm`` on the table."""

    def __init__(self, hand: Hand, world_from_arm: Motion) -> None:
        self._hand = hand
        self._arm_from_world = world_from_arm.inverse()

    def arm_target(self) -> tuple[NDArray[np.float64], NDArray[np.float64] | None] | None:
        """Where the tip is held, in the arm's own frame."""
        target = self._hand.arm_target()
        if target is None:
            return None
        point, axis = target
        return self._arm_from_world.apply(point), None if axis is None else np.asarray(self._arm_from_world.R @ axis)


class EmulatedRig:
    """The emulators of ``rig``; ``urls`` says where each listens. To be closed, or used with ``with``.

    With ``pty``, what has a serial port is on a pseudo-terminal; with ``paced``, it speaks at the rig's rate in real time.
    Raises OSError for an address that can't be had, ValueError for either under virtual time, and ConfigError for a fault
    that the bath can't have there.
    """

    def __init__(self, rig: LoadedRig, clock: Clock, seed: int, *, host: str = "127.0.0.1", pty: bool = False, paced: bool = False) -> None:
        emulation = rig.rig.emulation
        cameras = cameras_from_calibration(tomllib.loads(read_text(rig.calibration_path)))
        self.world = World(clock, seed, Renderer(cameras, seed), ambient_c=emulation.ambient_c, bath_start_c=emulation.bath_start_c)
        self.cameras = EmulatedCameras(self.world)
        self.operator = EmulatedOperator(self.world, hand_error_mm=emulation.hand_error_mm, check_point_mm=rig.rig.arm.check_point_mm)
        self._clock = clock
        self._host, self._pty, self._paced = host, pty, paced
        self._listeners: dict[str, Listener | PtyListener] = {}
        hand = PlacedHand(self.world, Motion.from_vectors(emulation.arm_placed.om, emulation.arm_placed.T))
        unit, accuracy_mm, tremor_mm = rig.arm_unit, emulation.arm_accuracy_mm, emulation.hand_tremor_mm
        arm = self.arm = ArmEmulator(hand, clock, unit=unit, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm)
        framing: Framing | None = "rtu" if pty and "rtu" in rig.profile.transports else None
        bath = self.bath = BathEmulator(self.world.plant, rig.profile, clock, framing=framing)
        stage = self.stage = self._stage_at(*rig.rig.stage.reference_mm) if rig.rig.stage else None
        self._check_faults(rig)
        for fault in emulation.faults:
            self._plan(fault)
        try:
            self._listen("arm", arm, rig.rig.arm.baud)
            self._listen("bath", bath, rig.profile.baud if bath.framing == "rtu" else None)
            if stage and rig.rig.stage:
                self._listen("stage", stage, rig.rig.stage.baud)
        except BaseException:
            self.close()
            raise

    @property
    def urls(self) -> dict[str, str]:
        """What a driver opens, by instrument. One on a pseudo-terminal moves when the instrument itself hangs up."""
        urls = {name: listener.url for name, listener in self._listeners.items()}
        bath = "tcp://" if self.bath.framing == "tcp" else "rtu+tcp://"
        return {name: url.replace("socket://", bath) if name == "bath" else url for name, url in urls.items()}

    def close(self) -> None:
        """Close all listeners."""
        for listener in self._listeners.values():
            listener.close()

    def __enter__(self) -> EmulatedRig:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _stage_at(self, reference_x: float, reference_y: float) -> StageEmulator:
        """A stage that carries the world's phantom; at its reference place the phantom stands as its layout says."""
        stage = StageEmulator(self._clock)

        def moved() -> tuple[float, float]:
            x, y, _ = stage.position_mm()
            return x - reference_x, y - reference_y

        self.world.stage_mm = moved
        return stage

    def _listen(self, name: str, device: Device, serial_baud: int | None) -> None:
        """``serial_baud`` is the rate of the instrument's serial port; None where it has none, but a network."""
        clock, lock, baud = self._clock, self.world.lock, serial_baud if self._paced else None
        if self._pty and serial_baud is not None:
            self._listeners[name] = PtyListener(device, clock, lock=lock, name=name, baud=baud)
        else:
            self._listeners[name] = Listener(device, clock, lock=lock, name=name, host=self._host, baud=baud)

    def _check_faults(self, rig: LoadedRig) -> None:
        """Raise ConfigError, in its place, for a fault that a bath of this profile and on this port can't have."""
        for at, fault in enumerate(rig.rig.emulation.faults):
            if fault.instrument == "bath":
                try:
                    self.bath.check_fault(fault.name)
                except ValueError as error:
                    raise located(rig.path, rig.text, [(("emulation", "faults", at, "name"), str(error), False)]) from error

    def _plan(self, fault: EmulatedFault) -> None:
        """Have a fault come at its time, and go where it is said when; one that is there from the start comes at once."""
        break_it, mend_it = self._actions(fault)
        if fault.at_s:
            self._later(fault.at_s, break_it)
        else:
            break_it()
        if fault.for_s is not None:
            self._later(fault.at_s + fault.for_s, mend_it)

    def _actions(self, fault: EmulatedFault) -> Actions:
        if fault.instrument == "arm":
            return arm_actions(self.arm, fault)
        if fault.instrument == "bath":
            return bath_actions(self.bath, fault)
        if self.stage is None:
            raise ValueError("this rig has no stage that could fail")
        return stage_actions(self.stage, fault)

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        def run() -> None:
            with self.world.lock:
                action()

        self._clock.call_at(self._clock.now() + seconds, run)
