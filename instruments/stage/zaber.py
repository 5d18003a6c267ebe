"""The conversation with Zaber devices on one chain, by their ASCII protocol.

A command has an id, which its reply repeats, so that a late one is never taken for another's, and a
checksum. Every reply carries the most serious warning flag: whatever is not known to be harmless
costs the position. Positions are microsteps; what a microstep is, the rig file says. Source: the
maker's ASCII protocol manual, firmware 6 and 7.

The maker's library (`zaber-motion`) is not used here: it opens ports itself, so that a capture
would have no bytes, and gives moves a speed of their own only from firmware 7.25 on. It is the
emulator's witness in the tests, and docs/examples/zaber_stage.py is a driver over it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import ClassVar, NamedTuple

from instruments.clock import Clock
from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.stage.connection import ANSWER_S, QUIET_S, Dialogue, whole
from instruments.stage.protocol import (
    AXES,
    HOME_AGAIN,
    MalformedLine,
    Message,
    Reply,
    Response,
    Status,
    Welcome,
    axis_words,
)
from instruments.stage.settings import StageIdentity, StageSettings, Target

GET_POSITIONS = b"/get pos\n"  # of all devices
POLL_S = 0.2
SPEED = 1.6384  # the unit of speeds: microsteps a second times this
ACCELERATION = SPEED / 10_000
STOP_S = 5.0


class Motor(NamedTuple):
    """The device and its axis that move an axis of the stage; microsteps per mm or degree."""

    device: int
    axis: int
    microsteps: float


_REPLY = re.compile(
    r"@(\d\d) (\d)(?: (\d\d))? (OK|RJ) (IDLE|BUSY) (--|[A-Z0-9]{2}) ([^:@]*)(?::([0-9A-F]{2}))?"
)
_PUSHED = re.compile(r"[!#]\d\d \d .*")
# flags that leave the position as it is: none, manual control, interrupted, stream, value, joystick
HARMLESS = frozenset({"--", "NC", "NI", "ND", "NR", "NT", "NU", "NJ"})
UNHOMED = frozenset({"WR", "WH"})
FLAGS = {
    "FD": "the driver is disabled",
    "FQ": "the encoder reports errors",
    "FS": "the axis stalled and was stopped",
    "FE": "the axis was stopped at a limit",
    "FT": "the lockstep axes are twisted",
    "FF": "the device reports a critical error",
    "FH": "the emergency stop is pressed",
    "WL": "a limit switch was hit where none is",
    "WM": "the axis was pushed while it stood",
    "WV": "the supply voltage is out of range",
    "WT": "the controller is too hot",
    "WR": "the axis has no reference position",
    "WH": "the axis has not been homed",
}
REFUSALS = {
    "AGAIN": "the device is not ready",
    "BADAXIS": "the device has no such axis",
    "BADCOMMAND": "the device does not know this command",
    "BADDATA": "a value is out of range",
    "DRIVERDISABLED": "the driver is disabled",
    "FULL": "the device has no room for the command",
    "LOCKSTEP": "the axis is locked to another",
    "PARKED": "the axis is parked",
    "STATUSBUSY": "the axis is moving",
}


def checksum(text: str) -> str:
    """Two hex digits: the two's complement of the sum of the bytes between the sign and ``:``."""
    return f"{-sum(text.encode('ascii')) & 0xFF:02X}"


def parse(line: bytes) -> Response:
    """The value of one line, without its end. Never raises."""
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return MalformedLine(line, "bytes that are not ASCII")
    if _PUSHED.fullmatch(text):
        return Message(text[0], text[1:])
    found = _REPLY.fullmatch(text)
    if not found:
        return MalformedLine(line, "no answer of a Zaber device looks like this")
    if found[8] and checksum(text[1 : found.start(8) - 1]) != found[8]:
        return MalformedLine(line, "its checksum is wrong")
    number = None if found[3] is None else int(found[3])
    taken, busy = found[4] == "OK", found[5] == "BUSY"
    return Reply(int(found[1]), int(found[2]), number, taken, busy, found[6], found[7])


class ZaberDialogue(Dialogue):
    """The conversation on one link; ``motors`` in the order of the stage's axes."""

    firmware = "Zaber"
    jogs: ClassVar[bool] = False
    brakes_freely: ClassVar[bool] = False
    safe: ClassVar[str] = "at a stand and holding its position"
    _parse = staticmethod(parse)

    def __init__(self, link: Link, clock: Clock, motors: Iterable[Motor]) -> None:
        super().__init__(link, clock)
        self._given = tuple(motors)
        self._motors: dict[str, Motor] = {}
        self._speeds: dict[tuple[int, int], int] = {}
        self._number = 0

    def identify(self, axes: str) -> tuple[StageIdentity, StageSettings]:
        if len(self._given) != len(axes):
            hint = "Give zaber_axes and microsteps in the rig file's [stage], one each an axis."
            what = f"{len(self._given)} motors for the axes {axes}"
            raise LimitError(self.who, what, hint=hint)
        self._motors = dict(zip(axes, self._given, strict=True))
        self.start()
        devices = dict.fromkeys(motor.device for motor in self._given)
        asked = ("version", "system.serial")
        version, serial = (
            ", ".join(self._ask(device, 0, f"get {name}") for device in devices) for name in asked
        )
        if any(int(one.split(".")[0]) not in (6, 7) for one in version.split(", ")):
            hint = "Use devices with firmware 6 or 7, set to the ASCII protocol."
            raise DeviceError(self.who, f"firmware {version} is not known", hint=hint)
        figures = {axis: self._figures(motor) for axis, motor in self._motors.items()}
        for axis, (low, high, _, _) in figures.items():
            if not low < high:
                hint = "Set its limit.min and limit.max."
                raise DeviceError(self.who, f"axis {axis} has no travel", hint=hint)
        self._speeds = {
            motor[:2]: round(figures[axis][2] * motor.microsteps * SPEED)
            for axis, motor in self._motors.items()
        }
        return StageIdentity("Zaber", version, serial, ""), self._settings(figures)

    def _figures(self, motor: Motor) -> tuple[float, float, float, float]:
        """Lowest and highest place, speed and acceleration: mm (degrees) and seconds."""
        low, high, speed, accel = (
            self._integer(motor, name) / motor.microsteps
            for name in ("limit.min", "limit.max", "maxspeed", "accel")
        )
        return low, high, speed / SPEED, accel / ACCELERATION

    def _settings(self, figures: dict[str, tuple[float, float, float, float]]) -> StageSettings:
        letters = AXES if "A" in figures else AXES[:3]
        each = [figures.get(axis, (0.0, 0.0, float("inf"), float("inf"))) for axis in letters]
        slowest = 60 * min(figures[axis][2] for axis in figures)
        steps = [self._motors[a].microsteps if a in figures else 1.0 for a in letters]
        return StageSettings(
            travel_mm=tuple([high - low for low, high, _, _ in each]),
            rate_mm_min=tuple([60 * speed for _, _, speed, _ in each]),
            accel_mm_s2=tuple([accel for _, _, _, accel in each]),
            steps_per_mm=tuple(steps),
            homing_seek_mm_min=slowest / 4,
            homing_feed_mm_min=slowest / 4,
            low_mm=tuple([low for low, _, _, _ in each]),
        )

    @whole
    def command(self, text: str, timeout_s: float = ANSWER_S) -> list[Response]:
        """Send ``DEVICE AXIS WORDS`` and wait for its own reply. Raises as `Dialogue.command`."""
        device, axis, words = text.split(" ", 2)
        self.wait(0.0)
        self._number = self._number % 99 + 1
        line = f"{int(device):02d} {axis} {self._number:02d} {words}"
        self.write(f"/{line}:{checksum(line)}\n".encode("ascii"))
        wait = self._link.reception(self._clock.now() + timeout_s)
        asked = int(device), int(axis), self._number
        while (answer := self._next(wait)) is not None:
            if not isinstance(answer, Reply) or answer[:3] != asked:
                continue
            if not answer.taken:
                why = REFUSALS.get(answer.data, "see the maker’s manual")
                what, hint = f"refused, {answer.data}: {why}", "Call stop(), then try again."
                if answer.data == "PARKED":
                    hint = "Home it, which unparks it."
                raise DeviceError(self.who, what, asked=text, hint=hint)
            if answer.flag not in HARMLESS:
                self.upsets += 1
            return [answer]
        self.upsets += 1
        hint = "Check power, cable, baud rate, and the device's number and protocol."
        raise LinkError(self.who, "no answer", asked=text, seconds=timeout_s, hint=hint)

    def _ask(self, device: int, axis: int, words: str) -> str:
        [reply] = self.command(f"{device} {axis} {words}")
        return reply.data if isinstance(reply, Reply) else ""

    def _integer(self, motor: Motor, name: str) -> int:
        text = self._ask(motor.device, motor.axis, f"get {name}")
        try:
            return int(float(text))
        except ValueError:
            raise ProtocolError(self.who, f"{name} is not a number", seen=text) from None

    @whole
    def status(self) -> Status:
        """In motion "Run", without a reference "Alarm". Raises DeviceError for a fault."""
        if not self._motors:  # another program's stage, of which only its motion is known
            busy = any(self._where(motor)[0].busy for motor in self._given)
            return Status("Run" if busy else "Idle", None, (), None, None, {})
        replies = {axis: self._where(motor) for axis, motor in self._motors.items()}
        flags = {axis: reply.flag for axis, (reply, _) in replies.items()}
        for axis, flag in flags.items():
            if flag not in HARMLESS | UNHOMED:
                what = f"axis {axis}: {FLAGS.get(flag, f'a warning that is not known, {flag}')}"
                raise DeviceError(self.who, what, asked="get pos", seen=flag, hint=HOME_AGAIN)
        state = "Alarm" if UNHOMED & set(flags.values()) else "Idle"
        if any(reply.busy for reply, _ in replies.values()):
            state = "Run"
        letters = AXES if "A" in self._motors else AXES[:3]
        at = tuple([replies[a][1] if a in replies else 0.0 for a in letters])
        return Status(state, None, at, None, None, flags)

    def _where(self, motor: Motor) -> tuple[Reply, float]:
        text = f"{motor.device} {motor.axis} get pos"
        [reply] = self.command(text)
        assert isinstance(reply, Reply)  # noqa: S101 - nothing else answers a command
        try:
            return reply, int(reply.data) / motor.microsteps
        except ValueError:
            self.upsets += 1
            what = "a position is no number"
            raise ProtocolError(self.who, what, asked=text, seen=reply.data) from None

    @property
    def homing(self) -> bool:
        return False  # it is stopped while homing as in a move

    def home(self, axes: str, bound_s: float) -> None:  # noqa: ARG002 - its motors are these axes
        until_s = self._clock.now() + bound_s
        self.send(f"{motor.device} {motor.axis} home" for motor in self._motors.values())
        while (status := self.status()).state == "Run":
            if self._clock.now() > until_s:
                what, hint = "homing takes too long", "Does an axis stick? Call stop()."
                raise DeviceError(self.who, what, seen=status.name, seconds=bound_s, hint=hint)
            self.wait(POLL_S)

    def move_lines(self, target: Target, feed_mm_min: float) -> list[str]:
        axis_words(target, feed_mm_min, who=self.who)  # refuses what is no number
        lines = []
        for axis, place in target.items():
            device, number, microsteps = self._motors[axis]
            speed = round(feed_mm_min / 60 * microsteps * SPEED)
            if speed != self._speeds[device, number]:
                lines.append(f"{device} {number} set maxspeed {speed}")
            lines.append(f"{device} {number} move abs {round(place * microsteps)}")
        return lines

    def finish(self, timeout_s: float) -> None:
        """Each reply says whether its axis moves: nothing is to be waited for."""

    def brake(self) -> None:
        self.write(b"/stop\n")

    cancel_jog = brake

    def send(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.command(line)
            device, number, words = line.split(" ", 2)
            if words.startswith("set maxspeed "):
                self._speeds[int(device), int(number)] = int(words.rpartition(" ")[2])

    @whole
    def abort(self) -> None:
        """Stop all axes and wait until they stand. Raises LinkError."""
        self.upsets += 1
        self.brake()
        until_s = self._clock.now() + STOP_S
        while any(self._where(motor)[0].busy for motor in self._given):
            if self._clock.now() > until_s:
                raise LinkError(self.who, "the stage does not stop", hint="Cut its power.")
            self.wait(POLL_S)

    @whole
    def start(self) -> Welcome:
        """Opening a port resets no device: devices that move are stopped."""
        return self.restart()

    @whole
    def restart(self) -> Welcome:
        """Stop all axes and clear warnings; the stage has to be homed then."""
        self.upsets += 1
        self._link.drain(QUIET_S)
        self._forget()
        self.abort()
        for motor in self._given:
            self.command(f"{motor.device} {motor.axis} warnings clear")
        return Welcome("", "Zaber")
