"""Stands up an emulated rig: one world, an emulator for each instrument, on ports or ptys."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.config import located, toml_of
from bench.rig.hand_over import forget_guardian
from bench.rig.loading import LoadedRig
from bench.rig.model import EmulatedFault, EmulatedStage, Rig, StageTable, make_renderer
from detector.geometry import Motion
from instruments.bath.emulator import BathEmulator, Framing, RelayEmulator
from instruments.bath.line_emulator import LineEmulator, dialect_of
from instruments.bath.profile import LineProfile, Profile, RegisterProfile, RelayProfile
from instruments.bath.reading import BathReading
from instruments.camera.emulator import EmulatedCameras
from instruments.clock import Clock
from instruments.drivers.entry_points import Kind, emulator_of, load, plugin_url
from instruments.listener import Device, Listener
from instruments.microscribe.emulator import ArmEmulator, Hand
from instruments.microscribe.faults import FOREVER
from instruments.microscribe.kinematics import OutOfReachError
from instruments.operators.emulated import EmulatedOperator
from instruments.pty_listener import PtyListener
from instruments.stage.emulator.board import AMOUNTS, StageEmulator, StageFault
from instruments.stage.emulator.carriage import Mounting
from instruments.stage.emulator.store import EMULATED as DIALECTS
from instruments.world.phantom import PlatePose
from instruments.world.world import World

# from a first port on; at "streams" are the page and pictures that no plug-in takes
PORTS = ("arm", "bath", "pump", "stage", "streams", "operator", "cameras")
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
        return None if target is None else self.placed(*target)

    def placed(
        self, point_mm: NDArray[np.float64], axis: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """A point (3,) mm and a stylus's axis (3,) of the world in the arm's own frame."""
        return self._arm_from_world.apply(point_mm), (
            None if axis is None else np.asarray(self._arm_from_world.R @ axis)
        )


class EmulatedRig:
    """The emulators of ``rig``. ``pty``: serial ports are pseudo-terminals; ``paced``: real baud;
    ``port_base``: see ``port_of``; unless ``drawn``, the first picture takes longer. Raises
    OSError, ValueError for ``pty`` or ``paced`` under virtual time, ConfigError for a fault.
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
        port_base: int = 0,
        drawn: bool = True,
    ) -> None:
        self._port_base = port_base
        emulation = rig.rig.emulation
        table = toml_of(rig.calibration_path)
        sensors = emulation.optical, emulation.thermal, emulation.depth
        self.world = World(
            clock,
            seed,
            partial(make_renderer, table, seed, *sensors),
            ambient_c=emulation.ambient_c,
            bath_start_c=emulation.bath_start_c,
        )
        if drawn:  # what is wrong with the calibration is said at once
            _ = self.world.renderer
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
        if plugin_url(rig.rig.arm.url) is None:
            self.operator.way = self._way
        self._clock, self._host, self._pty, self._paced = clock, host, pty, paced
        self.listeners: dict[str, Listener | PtyListener] = {}  # each end of a cable
        placed = Motion.from_vectors(emulation.arm_placed.om, emulation.arm_placed.T)
        self._hand = PlacedHand(self.world, placed)
        self.arm = ArmEmulator(
            self._hand,
            clock,
            unit=rig.arm_unit,
            seed=seed,
            accuracy_mm=emulation.arm_accuracy_mm,
            tremor_mm=emulation.hand_tremor_mm,
        )
        plant, r, relay = self.world.plant, rig.rig, rig.relay
        self._bath = self._bath_controller(rig)
        # on a port of its own; without one, and with a controller that turns none, the pump stands
        framing = self._framing(relay) if relay else None
        self.pump = RelayEmulator(plant, relay, clock, framing=framing) if relay else None
        own = r.stage and plugin_url(r.stage.url) is None
        self.stage = self._stage(r, r.stage) if r.stage and own else None
        self._plugged = self._plugged_emulators(r)
        try:
            for at, fault in enumerate(emulation.faults):
                try:
                    self._plan(fault)
                except ValueError as error:
                    key = ("emulation", "faults", at, "name")
                    raise located(rig.path, rig.text, [(key, str(error), False)]) from error
            self._serve(rig)
            for name in {"bath", "stage"} & self.urls.keys():  # which of them a guardian has
                forget_guardian(self.urls[name])
        except BaseException:
            self.close()
            raise

    def _way(
        self, point_mm: NDArray[np.float64], axis: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Of the world: ``axis`` (3,) where the arm can hold its tip so at the point (3,) mm."""
        try:
            self.arm.check_reach(*self._hand.placed(point_mm, axis))
        except OutOfReachError:
            return None
        return axis

    def _bath_controller(self, rig: LoadedRig) -> BathEmulator | LineEmulator | None:
        """By the rig's profile; None where no emulator has its protocol (another bath is used)."""
        known, plant = rig.profile, self.world.plant
        if isinstance(known, RegisterProfile):
            return BathEmulator(plant, known, self._clock, framing=self._framing(known))
        if not isinstance(known, LineProfile):
            return None
        try:
            return LineEmulator(plant, known, self._clock)
        except ValueError as error:
            if "bath" not in rig.rig.emulated and rig.rig.emulated:
                return None
            said = (("bath", "profile"), str(error), False)
            raise located(rig.path, rig.text, [said]) from error

    def _serve(self, rig: LoadedRig) -> None:
        """Listen for each instrument, at the rate of its serial port; a network has none."""
        r = rig.rig
        served: dict[str, tuple[Device, int | None]] = {"arm": (self.arm, r.arm.baud)}
        heated: tuple[tuple[str, Heated | None, Profile | RelayProfile | None], ...]
        heated = ("bath", self._bath, rig.profile), ("pump", self.pump, rig.relay)
        for name, device, of in heated:
            if device and of:
                # the others stay on TCP where serial ports are pseudo-terminals
                serial = {"rtu", "line"} if "serial" in device.profile.transports else {"rtu"}
                served[name] = device, of.baud if device.framing in serial else None
        if self.stage and r.stage:
            served["stage"] = self.stage, r.stage.baud
        served |= {name: (device, None) for name, device in self._plugged.items()}
        for name, (one, baud) in served.items():
            how: dict[str, Any] = {"lock": self.world.lock, "name": name}
            how["baud"] = baud if self._paced else None
            if self._pty and baud is not None:
                self.listeners[name] = PtyListener(one, self._clock, **how)
            else:
                port = port_of(name, self._port_base)
                self.listeners[name] = Listener(one, self._clock, host=self._host, port=port, **how)

    def _plugged_emulators(self, rig: Rig) -> dict[str, Device]:
        """Of other packages, by instrument. Raises LimitError."""
        found: dict[str, Device] = {}
        urls = {"arm": rig.arm.url, "bath": rig.bath.url, "cameras": rig.cameras.url}
        urls |= {"stage": rig.stage.url} if rig.stage else {}
        for name, url in urls.items():
            plug = plugin_url(url)
            if plug is None or not plug.emulated:
                continue
            kind: Kind = "camera" if name == "cameras" else name  # type: ignore[assignment]
            make = load(kind, plug, emulator=True).make
            found[name] = made = emulator_of(make, self.world, self._clock)
            if isinstance(made, StageEmulator):
                self.stage = self._carrying(rig, made)
            elif name == "stage" and hasattr(made, "position_mm"):
                self.follow_stage(rig, made.position_mm)
        return found

    def follow_stage(self, rig: Rig, position_mm: Callable[[], Sequence[float]]) -> None:
        """Have the phantom stand where a stage that isn't emulated says it is."""
        assert rig.stage  # noqa: S101 - there is one
        self._mounted(rig.emulation.stage, rig.stage, position_mm)
        self.world.stage_velocity = lambda: (0.0, 0.0, 0.0)

    def follow_bath(self, reading: BathReading) -> None:
        """Have the emulated water be as warm as that of a bath which isn't emulated."""
        with self.world.lock:
            self.world.plant.be_at(reading.temp_c)

    def _framing(self, profile: RegisterProfile | RelayProfile) -> Framing | None:
        return "rtu" if self._pty and "rtu" in profile.transports else None

    @property
    def bath(self) -> BathEmulator | LineEmulator:
        """The bench's own emulator of the bath. Raises ValueError where a plug-in has its own."""
        if self._bath is None:
            raise ValueError("the bath is a plug-in's")
        return self._bath

    @property
    def urls(self) -> dict[str, str]:
        """What a driver opens, by instrument; a pseudo-terminal's changes after a hang-up."""
        urls = {name: listener.url for name, listener in self.listeners.items()}
        for name, device in (("bath", self._bath), ("pump", self.pump)):
            if device and name in urls:
                scheme = "rtu+tcp://" if device.framing == "rtu" else "tcp://"
                urls[name] = urls[name].replace("socket://", scheme)
                if device.framing == "line" and "://" not in urls[name]:
                    urls[name] += AS_A_PTY
        return urls

    def close(self) -> None:
        for listener in self.listeners.values():
            listener.close()
        self.world.close()

    def __enter__(self) -> EmulatedRig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stage(self, rig: Rig, said: StageTable) -> StageEmulator:
        """As the rig file has it."""
        errors = rig.emulation.stage
        axes = 4 if "A" in said.axes else 3
        play_mm = (*errors.backlash_mm, errors.backlash_deg)[:axes]
        stage = StageEmulator(
            self._clock,
            settings=errors.settings,
            dialect=DIALECTS[errors.firmware(said)],
            axes=axes,
            play_mm=play_mm,
            high_mm=errors.high_mm and errors.high_mm[:axes],
        )
        return self._carrying(rig, stage)

    def _carrying(self, rig: Rig, stage: StageEmulator) -> StageEmulator:
        """Have the phantom stand on ``stage``; at its reference place it stands as laid out."""
        assert rig.stage  # noqa: S101 - there is one
        errors, said = rig.emulation.stage, rig.stage
        mounting = self._mounted(errors, said, lambda: stage.position_mm().tolist())

        def velocity() -> tuple[float, float, float]:
            with self.world.lock:
                place, way = stage.position_mm(), stage.velocity()
                now, later = mounting.pose(place.tolist()), mounting.pose((place + way).tolist())
            return later.x_mm - now.x_mm, later.y_mm - now.y_mm, later.z_mm - now.z_mm

        self.world.stage_velocity = velocity
        return stage

    def _mounted(
        self, errors: EmulatedStage, said: StageTable, position_mm: Callable[[], Sequence[float]]
    ) -> Mounting:
        """Have the phantom stand on the stage; how it is mounted there."""
        reference = (*said.reference_mm, said.reference_z_mm, said.reference_a_deg)
        wrong = errors.scale_errors, errors.squareness_rad, errors.yaw_rad
        mounting = Mounting(said.axes, reference, *wrong)

        def pose() -> PlatePose:
            with self.world.lock:
                return mounting.pose(list(position_mm()))

        self.world.stage_pose = pose
        return mounting

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
            of, whose = self.cameras.faults, {"camera": fault.camera}
            return partial(of.inject, name, times, amount=amount, **whose), partial(of.clear, name)
        if fault.instrument == "arm":
            arm = self.arm.faults
            return partial(arm.inject, name, times, amount=amount), partial(arm.clear, name)
        if fault.instrument == "stage" and stage:
            kind = StageFault(name)
            key = "lost_mm" if kind is StageFault.LOST_STEP else "after_s"
            how = {key: AMOUNTS.get(kind, (0.0, ""))[0] if amount is None else amount}
            return partial(stage.inject, kind, **how), partial(stage.cure, kind)
        device = self._bath if fault.instrument == "bath" else self.pump
        if device is None or fault.instrument == "stage":
            raise ValueError(f"this rig has no {fault.instrument} that could fail")
        device.check_fault(name)

        def break_it() -> None:
            device.late_s = device.late_s if amount is None else amount
            device.fault(name)

        return break_it, lambda: device.fault(name, on=False)


def port_of(name: str, base: int) -> int:
    """The TCP port of what is called so in `PORTS`, whatever the rig lacks; 0: free."""
    return base and base + PORTS.index(name)
