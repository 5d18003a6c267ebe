"""Stands up an emulated rig in this process: one world, and an emulator for each instrument, on a
loopback port or a pty.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from bench.config import located, read_text
from bench.rig.emulated_faults import (
    Actions,
    arm_actions,
    bath_actions,
    camera_actions,
    pump_actions,
    stage_actions,
)
from bench.rig.emulation_model import EmulatedFault, EmulatedStage, make_renderer
from bench.rig.loading import LoadedRig
from bench.rig.model import Stage
from detector.geometry import Motion
from instruments.bath.emulator import BathEmulator, Framing
from instruments.bath.relay_emulator import RelayEmulator
from instruments.camera.emulator import EmulatedCameras
from instruments.clock import Clock
from instruments.listener import Device, Listener
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.mechanics import Hand
from instruments.operators.emulated import EmulatedOperator
from instruments.pty_listener import PtyListener
from instruments.stage.emulator import CLASSIC, GRBL_HAL, Mounting, StageEmulator
from instruments.world.phantom import PlatePose
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
        return self._arm_from_world.apply(point), (
            None if axis is None else np.asarray(self._arm_from_world.R @ axis)
        )


class EmulatedRig:
    """The emulators of ``rig``; ``urls`` says where each listens. To be closed, or used with
    ``with``.

    With ``pty``, what has a serial port is on a pseudo-terminal; with ``paced``, it speaks at the
    rig's rate in real time. Raises OSError for an address that can't be had, ValueError for either
    under virtual time, and ConfigError for a fault that the bath can't have there.
    """

    def __init__(
        self,
        rig: LoadedRig,
        clock: Clock,
        seed: int,
        *,
        host: str = "127.0.0.1",
        pty: bool = False,
        paced: bool = False,
    ) -> None:
        emulation = rig.rig.emulation
        table = tomllib.loads(read_text(rig.calibration_path))
        renderer = make_renderer(table, seed, emulation.optical, emulation.thermal)
        self.world = World(
            clock,
            seed,
            renderer,
            ambient_c=emulation.ambient_c,
            bath_start_c=emulation.bath_start_c,
        )
        self.cameras = EmulatedCameras(self.world)
        self.operator = EmulatedOperator(
            self.world,
            hand_error_mm=emulation.hand_error_mm,
            placement_error_mm=emulation.placement_error_mm,
            placement_error_rad=float(np.radians(emulation.placement_error_deg)),
            prompt_s=emulation.prompt_s,
            tip_radius_mm=rig.rig.arm.tip_radius_mm,
            check_point_mm=rig.rig.arm.check_point_mm,
            mistakes=emulation.mistakes,
        )
        self._clock = clock
        self._host, self._pty, self._paced = host, pty, paced
        self._listeners: dict[str, Listener | PtyListener] = {}
        hand = PlacedHand(
            self.world, Motion.from_vectors(emulation.arm_placed.om, emulation.arm_placed.T)
        )
        unit, accuracy_mm, tremor_mm = (
            rig.arm_unit,
            emulation.arm_accuracy_mm,
            emulation.hand_tremor_mm,
        )
        arm = self.arm = ArmEmulator(
            hand, clock, unit=unit, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm
        )
        framing: Framing | None = "rtu" if pty and "rtu" in rig.profile.transports else None
        bath = self.bath = BathEmulator(self.world.plant, rig.profile, clock, framing=framing)
        pump = self.pump = self._relay(rig)
        stage = self.stage = self._stage(rig.rig.stage, emulation.stage) if rig.rig.stage else None
        self._check_faults(rig)
        for fault in emulation.faults:
            self._plan(fault)
        try:
            self._listen("arm", arm, rig.rig.arm.baud)
            self._listen("bath", bath, rig.profile.baud if bath.framing == "rtu" else None)
            if pump:
                self._listen("pump", pump, pump.profile.baud if pump.framing == "rtu" else None)
            if stage and rig.rig.stage:
                self._listen("stage", stage, rig.rig.stage.baud)
        except BaseException:
            self.close()
            raise

    @property
    def urls(self) -> dict[str, str]:
        """What a driver opens, by instrument. One on a pseudo-terminal moves when the instrument
        itself hangs up.
        """
        spoken = {"bath": self.bath.framing, **({"pump": self.pump.framing} if self.pump else {})}
        scheme = {
            name: "tcp://" if framing == "tcp" else "rtu+tcp://" for name, framing in spoken.items()
        }
        return {
            name: listener.url.replace("socket://", scheme.get(name, "socket://"))
            for name, listener in self._listeners.items()
        }

    def close(self) -> None:
        """Close all listeners, and the world behind them."""
        for listener in self._listeners.values():
            listener.close()
        self.world.close()

    def __enter__(self) -> EmulatedRig:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _stage(self, said: Stage, errors: EmulatedStage) -> StageEmulator:
        """A stage that carries the world's phantom; at its reference place the phantom stands as
        its layout says.
        """
        axes, dialect = (
            4 if "A" in said.axes else 3,
            (GRBL_HAL if errors.dialect == "grblHAL" else CLASSIC),
        )
        play_mm = (*errors.backlash_mm, errors.backlash_deg)[:axes]
        stage = StageEmulator(
            self._clock, settings=errors.settings, dialect=dialect, axes=axes, play_mm=play_mm
        )
        reference = (*said.reference_mm, said.reference_z_mm, said.reference_a_deg)
        mounting = Mounting(
            said.axes, reference, errors.scale_errors, errors.squareness_rad, errors.yaw_rad
        )

        def pose() -> PlatePose:
            with self.world.lock:
                return mounting.pose(stage.position_mm().tolist())

        def velocity() -> tuple[float, float, float]:
            with self.world.lock:
                place, way = stage.position_mm(), stage.velocity()
                now, later = mounting.pose(place.tolist()), mounting.pose((place + way).tolist())
            return later.x_mm - now.x_mm, later.y_mm - now.y_mm, later.z_mm - now.z_mm

        self.world.stage_pose, self.world.stage_velocity = pose, velocity
        return stage

    def _relay(self, rig: LoadedRig) -> RelayEmulator | None:
        """The relay that switches the pump, on a port of its own; without one, and with a
        controller that turns none, the pump stands.
        """
        if rig.relay is None:
            return None
        framing: Framing | None = "rtu" if self._pty and "rtu" in rig.relay.transports else None
        return RelayEmulator(self.world.plant, rig.relay, self._clock, framing=framing)

    def _listen(self, name: str, device: Device, serial_baud: int | None) -> None:
        """``serial_baud`` is the rate of the instrument's serial port; None where it has none, but
        a network.
        """
        clock, lock, baud = self._clock, self.world.lock, serial_baud if self._paced else None
        if self._pty and serial_baud is not None:
            self._listeners[name] = PtyListener(device, clock, lock=lock, name=name, baud=baud)
        else:
            self._listeners[name] = Listener(
                device, clock, lock=lock, name=name, host=self._host, baud=baud
            )

    def _check_faults(self, rig: LoadedRig) -> None:
        """Raise ConfigError, in its place, for a fault that a bath of this profile, or its relay,
        can't have on this port.
        """
        modbus = {"bath": self.bath, "pump": self.pump}
        for at, fault in enumerate(rig.rig.emulation.faults):
            device = modbus.get(fault.instrument)
            if device:
                try:
                    device.check_fault(fault.name)
                except ValueError as error:
                    raise located(
                        rig.path,
                        rig.text,
                        [(("emulation", "faults", at, "name"), str(error), False)],
                    ) from error

    def _plan(self, fault: EmulatedFault) -> None:
        """Have a fault come at its time, and go where it is said when; one that is there from the
        start comes at once.
        """
        break_it, mend_it = self._actions(fault)
        if fault.at_s:
            self._later(fault.at_s, break_it)
        else:
            break_it()
        if fault.for_s is not None:
            self._later(fault.at_s + fault.for_s, mend_it)

    def _actions(self, fault: EmulatedFault) -> Actions:
        if fault.instrument == "cameras":
            return camera_actions(self.cameras, fault)
        if fault.instrument == "arm":
            return arm_actions(self.arm, fault)
        if fault.instrument == "bath":
            return bath_actions(self.bath, fault)
        if fault.instrument == "pump" and self.pump:
            return pump_actions(self.pump, fault)
        if self.stage is None:
            raise ValueError("this rig has no stage that could fail")
        return stage_actions(self.stage, fault)

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        def run() -> None:
            with self.world.lock:
                action()

        self._clock.call_at(self._clock.now() + seconds, run)
