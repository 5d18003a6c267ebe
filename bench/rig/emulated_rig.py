"""Stands up an emulated rig: one world, an emulator for each instrument, on ports or ptys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.config import located, toml_of
from bench.rig.loading import LoadedRig
from bench.rig.model import EmulatedFault, EmulatedStage, Stage, make_renderer
from detector.geometry import Motion
from instruments.bath.emulator import BathEmulator, Framing, RelayEmulator
from instruments.bath.line_emulator import LineEmulator, dialect_of
from instruments.bath.profile import LineProfile, Profile, RegisterProfile, RelayProfile
from instruments.camera.emulator import EmulatedCameras
from instruments.clock import Clock
from instruments.listener import Device, Listener
from instruments.microscribe.emulator import ArmEmulator, Hand
from instruments.microscribe.faults import FOREVER
from instruments.operators.emulated import EmulatedOperator
from instruments.pty_listener import PtyListener
from instruments.stage.emulator import EMULATED as DIALECTS
from instruments.stage.emulator import Mounting, StageEmulator
from instruments.stage.emulator.board import LATE_S, LOST_MM
from instruments.stage.emulator.board import Fault as StageFault
from instruments.world.phantom import PlatePose
from instruments.world.world import World

AS_A_PTY = "?parity=N&bytesize=8&handshake=none"  # a pseudo-terminal has no other frames

Heated = BathEmulator | LineEmulator | RelayEmulator


def has_emulator(profile: Profile) -> bool:
    """Whether an emulated bath answers by this profile: a lab's own lines have none."""
    return not isinstance(profile, LineProfile) or dialect_of(profile) is not None


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
    """The emulators of ``rig``. ``pty``: serial ports are pseudo-terminals; ``paced``: real baud.
    Raises OSError, ValueError for either under virtual time, ConfigError for a fault.
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
        table = toml_of(rig.calibration_path)
        sensors = emulation.optical, emulation.thermal, emulation.depth
        renderer = make_renderer(table, seed, *sensors)
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
        self._clock, self._host, self._pty, self._paced = clock, host, pty, paced
        self._listeners: dict[str, Listener | PtyListener] = {}
        placed = Motion.from_vectors(emulation.arm_placed.om, emulation.arm_placed.T)
        self.arm = ArmEmulator(
            PlacedHand(self.world, placed),
            clock,
            unit=rig.arm_unit,
            seed=seed,
            accuracy_mm=emulation.arm_accuracy_mm,
            tremor_mm=emulation.hand_tremor_mm,
        )
        plant, r, relay = self.world.plant, rig.rig, rig.relay
        self.bath: BathEmulator | LineEmulator
        if isinstance(known := rig.profile, LineProfile):
            try:
                self.bath = LineEmulator(plant, known, clock)
            except ValueError as error:
                said = (("bath", "profile"), str(error), False)
                raise located(rig.path, rig.text, [said]) from error
        elif isinstance(known, RegisterProfile):
            self.bath = BathEmulator(plant, known, clock, framing=self._framing(known))
        # on a port of its own; without one, and with a controller that turns none, the pump stands
        framing = self._framing(relay) if relay else None
        self.pump = RelayEmulator(plant, relay, clock, framing=framing) if relay else None
        self.stage = self._stage(r.stage, emulation.stage) if r.stage else None
        try:
            for at, fault in enumerate(emulation.faults):
                try:
                    self._plan(fault)
                except ValueError as error:
                    key = ("emulation", "faults", at, "name")
                    raise located(rig.path, rig.text, [(key, str(error), False)]) from error
            # the rate of each serial port; a network has none
            self._listen("arm", self.arm, r.arm.baud)
            devices: tuple[tuple[str, Heated | None, Profile | RelayProfile | None], ...]
            devices = ("bath", self.bath, rig.profile), ("pump", self.pump, relay)
            for name, device, of in devices:
                if device and of:
                    self._listen(name, device, None if self._on_tcp(device) else of.baud)
            if self.stage and r.stage:
                self._listen("stage", self.stage, r.stage.baud)
        except BaseException:
            self.close()
            raise

    def _framing(self, profile: RegisterProfile | RelayProfile) -> Framing | None:
        return "rtu" if self._pty and "rtu" in profile.transports else None

    def _on_tcp(self, device: Heated) -> bool:
        """Whether it stays on TCP where serial ports are pseudo-terminals."""
        serial = {"rtu", "line"} if "serial" in device.profile.transports else {"rtu"}
        return device.framing not in serial

    @property
    def urls(self) -> dict[str, str]:
        """What a driver opens, by instrument; a pseudo-terminal's changes after a hang-up."""
        urls = {name: listener.url for name, listener in self._listeners.items()}
        for name, device in (("bath", self.bath), ("pump", self.pump)):
            if device and name in urls:
                scheme = "rtu+tcp://" if device.framing == "rtu" else "tcp://"
                urls[name] = urls[name].replace("socket://", scheme)
                if device.framing == "line" and "://" not in urls[name]:
                    urls[name] += AS_A_PTY
        return urls

    def close(self) -> None:
        for listener in self._listeners.values():
            listener.close()
        self.world.close()

    def __enter__(self) -> EmulatedRig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stage(self, said: Stage, errors: EmulatedStage) -> StageEmulator:
        """A stage that carries the phantom; at its reference place it stands as laid out."""
        axes = 4 if "A" in said.axes else 3
        steps = {100 + "XYZA".index(a): n for a, n in zip(said.axes, said.microsteps, strict=False)}
        play_mm = (*errors.backlash_mm, errors.backlash_deg)[:axes]
        stage = StageEmulator(
            self._clock,
            settings=errors.settings | steps,
            dialect=DIALECTS[errors.firmware(said)],
            axes=axes,
            play_mm=play_mm,
            high_mm=errors.high_mm and errors.high_mm[:axes],
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

    def _listen(self, name: str, device: Device, serial_baud: int | None) -> None:
        how: dict[str, Any] = {"lock": self.world.lock, "name": name}
        how["baud"] = serial_baud if self._paced else None
        self._listeners[name] = (
            PtyListener(device, self._clock, **how)
            if self._pty and serial_baud is not None
            else Listener(device, self._clock, host=self._host, **how)
        )

    def _plan(self, fault: EmulatedFault) -> None:
        """Put a fault in at its time and take it out at its end."""

        def later(seconds: float, action: Callable[[], None]) -> None:
            def run() -> None:
                with self.world.lock:
                    action()

            self._clock.call_at(self._clock.now() + seconds, run)

        break_it, mend_it = self._actions(fault)
        if fault.at_s:
            later(fault.at_s, break_it)
        else:
            break_it()
        if fault.for_s is not None:
            later(fault.at_s + fault.for_s, mend_it)

    def _actions(self, fault: EmulatedFault) -> tuple[Callable[[], None], Callable[[], None]]:
        """What puts a fault in, and out. Raises ValueError for a fault that can't be."""
        name, amount, stage = fault.name, fault.amount, self.stage
        times = FOREVER if fault.times is None else fault.times
        if fault.instrument == "cameras":
            faults, camera = self.cameras.faults, fault.camera
            return (
                lambda: faults.inject(name, times, camera=camera, amount=amount),
                lambda: faults.clear(name),
            )
        if fault.instrument == "arm":
            of_arm = self.arm.faults
            return lambda: of_arm.inject(name, times, amount=amount), lambda: of_arm.clear(name)
        if fault.instrument == "stage" and stage:
            kind = StageFault(name)
            key = "lost_mm" if kind is StageFault.LOST_STEP else "after_s"
            usual = {StageFault.LOST_STEP: LOST_MM, StageFault.LATE_OK: LATE_S}.get(kind, 0.0)
            how = {key: usual if amount is None else amount}
            return lambda: stage.inject(kind, **how), lambda: stage.cure(kind)
        device = self.bath if fault.instrument == "bath" else self.pump
        if device is None or fault.instrument == "stage":
            raise ValueError(f"this rig has no {fault.instrument} that could fail")
        device.check_fault(name)

        def break_it() -> None:
            device.late_s = device.late_s if amount is None else amount
            device.fault(name)

        return break_it, lambda: device.fault(name, on=False)
