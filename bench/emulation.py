"""Stands up an emulated rig in this process: one world, and an emulator on a loopback port for each instrument."""

from __future__ import annotations

import tomllib
from types import TracebackType

from bench.config import read_text
from bench.rig import LoadedRig
from instruments.bath.emulator import BathEmulator
from instruments.camera.emulator import EmulatedCameras
from instruments.clock import Clock
from instruments.listener import Device, Listener
from instruments.microscribe.emulator import ArmEmulator
from instruments.operators.emulated import EmulatedOperator
from instruments.stage.emulator import StageEmulator
from instruments.world.optics import cameras_from_calibration
from instruments.world.scene import Renderer
from instruments.world.world import World


class EmulatedRig:
    """The emulators of ``rig``; ``urls`` says where each listens. To be closed, or used with ``with``."""

    def __init__(self, rig: LoadedRig, clock: Clock, seed: int, *, host: str = "127.0.0.1") -> None:
        emulation = rig.rig.emulation
        cameras = cameras_from_calibration(tomllib.loads(read_text(rig.calibration_path)))
        self.world = World(clock, seed, Renderer(cameras, seed), ambient_c=emulation.ambient_c, bath_start_c=emulation.bath_start_c)
        self.cameras = EmulatedCameras(self.world)
        self.operator = EmulatedOperator(self.world, hand_error_mm=emulation.hand_error_mm)
        self._clock = clock
        self._host = host
        self._listeners: list[Listener] = []
        arm = ArmEmulator(self.world, clock, seed=seed, accuracy_mm=emulation.arm_accuracy_mm, tremor_mm=emulation.hand_tremor_mm)
        self.urls = {"arm": self._listen("arm", arm)}
        bath = BathEmulator(self.world.plant, rig.profile, clock)
        self.urls["bath"] = self._listen("bath", bath).replace("socket://", "tcp://")
        if rig.rig.stage:
            stage = StageEmulator(clock)
            reference_x, reference_y = rig.rig.stage.reference_mm

            def moved() -> tuple[float, float]:
                x, y, _ = stage.position_mm()
                return x - reference_x, y - reference_y

            self.world.stage_mm = moved
            self.urls["stage"] = self._listen("stage", stage)

    def close(self) -> None:
        """Close all listeners."""
        for listener in self._listeners:
            listener.close()

    def __enter__(self) -> EmulatedRig:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _listen(self, name: str, device: Device) -> str:
        listener = Listener(device, self._clock, lock=self.world.lock, name=name, host=self._host)
        self._listeners.append(listener)
        return listener.url
