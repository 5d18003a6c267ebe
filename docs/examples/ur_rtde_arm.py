"""A Universal Robots arm that touches teat ends by itself, over RTDE.

    pip install ur_rtde
    [arm]
    url = "plugin:ur?host=192.168.0.30"
    accuracy_mm = 0.05          # of a point, one standard uncertainty: by your own verification
    accuracy_source = "ISO 9283 test of 2026-03-01"
    frame = "table-frame.toml"  # robot base to table

In pyproject.toml of your package:

    [project.entry-points."teatbench.arms"]
    ur = "ur_rtde_arm:UrArm"

The tool is a ball on a stylus; its centre is the TCP that is set at the robot. **A person is near:
limit force, speed and power in the robot's own safety configuration. This is no safety function.**
Keys: ``host``; ``approach_mm`` (from which it creeps), ``creep_mm_s``, ``speed_mm_s``.
"""

from __future__ import annotations

import numpy as np
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface

from instruments import ArmPoint, Clock, DeviceError, LimitError, LinkError

BEYOND_MM = 10.0  # it looks for the end so far behind where it is expected
ACCELERATION = 0.25  # m/s²
STILL_MM_S = 0.05
NORMAL, REDUCED = 1, 2  # safety modes in which it may move


class UrArm:
    """Points are the TCP in the robot's base frame."""

    homing = "See that the robot's TCP is the ball's centre, and that nobody is in its way."
    touches = True

    def __init__(
        self,
        clock: Clock,
        host: str,
        approach_mm: str = "25",
        creep_mm_s: str = "5",
        speed_mm_s: str = "100",
    ) -> None:
        self._clock, self._host = clock, host
        self._approach_mm, self._creep, self._speed = map(
            float, (approach_mm, creep_mm_s, speed_mm_s)
        )
        self._control = self._receive = None
        try:
            self._receive = RTDEReceiveInterface(host)
            self._control = RTDEControlInterface(host)
        except RuntimeError as error:
            self.close()
            hint = "Is it switched on, and in remote control?"
            raise LinkError("UR arm", f"{host}: {error}", hint=hint) from error
        self.identity = {"serial_number": f"UR at {host}", "model": "UR over RTDE"}

    def read(self) -> ArmPoint:
        """The TCP now; its stylus points away from the tool's flange."""
        receive = self._linked()
        pose = np.array(receive.getActualTCPPose())
        speed = np.array(receive.getActualTCPSpeed())
        moving = 1000.0 * float(np.linalg.norm(speed[:3])) > STILL_MM_S
        return ArmPoint(1000.0 * pose[:3], -_tool_axis(pose[3:]), moving)

    def touch(self, point_mm: np.ndarray, axis: np.ndarray) -> None:
        """Come from outside, against ``axis`` (which points out of the teat), until it touches."""
        receive = self._linked()
        if (mode := receive.getSafetyMode()) not in (NORMAL, REDUCED):
            raise DeviceError("UR arm", "its safety system stops it", seen=f"safety mode {mode}")
        turn = receive.getActualTCPPose()[3:]
        before = point_mm + self._approach_mm * axis
        if not self._control.isPoseWithinSafetyLimits([*(before / 1000.0), *turn]):
            raise LimitError("UR arm", f"({before.round(1)}) mm is outside its safety limits")
        if not self._control.moveL([*(before / 1000.0), *turn], self._speed / 1000.0, ACCELERATION):
            raise DeviceError("UR arm", "it did not reach the place before the teat")
        if not self._control.moveUntilContact([*(-axis * self._creep / 1000.0), 0.0, 0.0, 0.0]):
            raise DeviceError("UR arm", "its search for contact was ended")
        self._clock.sleep(0.2)  # until it stands
        beyond_mm = float((point_mm - self.read().tip_mm) @ axis)
        if beyond_mm > BEYOND_MM:
            self.stop()
            what = f"it touched nothing until {beyond_mm:.1f} mm behind the expected end"
            raise DeviceError("UR arm", what, hint="Does the phantom stand where the script says?")

    def stop(self) -> None:
        if self._control is not None:
            self._control.stopL(10.0)

    def close(self) -> None:
        control, receive = self._control, self._receive
        self._control = self._receive = None
        if control is not None:
            control.stopScript()
            control.disconnect()
        if receive is not None:
            receive.disconnect()

    def _linked(self) -> RTDEReceiveInterface:
        if self._receive is None or not self._receive.isConnected():
            hint = "Check the network, and that it is in remote control."
            raise LinkError("UR arm", f"{self._host}: the link is lost", hint=hint)
        return self._receive


def _tool_axis(rotation: np.ndarray) -> np.ndarray:
    """The tool's z in the base frame, of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(rotation))
    z = np.array([0.0, 0.0, 1.0])
    if angle < 1e-12:
        return z
    k = rotation / angle
    along = k * (k @ z) * (1.0 - np.cos(angle))
    return z * np.cos(angle) + np.cross(k, z) * np.sin(angle) + along
