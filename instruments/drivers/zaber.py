"""A Zaber stage over its maker's library, ``zaber-motion``, by entry point as drivers of others:
``url = "plugin:zaber?url=/dev/ttyUSB0&devices=1,2&microsteps=2015.748,2015.748"``.

``url`` is a serial port, at ``baud``, or ``socket://host:port``; ``devices`` are in the order of
``axes``, each an address or ``address.axis``; ``microsteps`` are per mm, per degree of A. The
library opens the port itself, so that a capture has no bytes of this stage. No call waits for the
end of a move, so that an emulator's virtual time takes no real time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from urllib.parse import urlsplit

from instruments.clock import Clock
from instruments.drivers.plugin import StageState
from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError

try:
    from zaber_motion import Units
    from zaber_motion import exceptions as zaber
    from zaber_motion.ascii import Axis, Connection, WarningFlags
except ImportError as error:
    raise ImportError(f"it needs zaber-motion: pip install 'teatbench[zaber]' ({error})") from error

SPEED = 1.6384  # the unit of speeds: microsteps a second times this
OWN_SPEEDS = (7, 25)  # the firmware from which a move may have a speed of its own
ANSWER_MS = 2000  # within which a device has to answer
# flags that leave the position as it is: none, manual control, interrupted, stream, value, joystick
HARMLESS = frozenset({"--", "NC", "NI", "ND", "NR", "NT", "NU", "NJ"})
UNHOMED = frozenset({WarningFlags.NO_REFERENCE_POSITION, WarningFlags.DEVICE_NOT_HOMED})
FLAGS = {flag: name.lower().replace("_", " ") for name, flag in vars(WarningFlags).items()}
LOST = (
    zaber.ConnectionClosedException,
    zaber.ConnectionFailedException,
    zaber.RequestTimeoutException,
    zaber.SerialPortBusyException,
)


class ZaberStage:
    """Places are the devices' own positions, in mm (A: degrees)."""

    def __init__(
        self,
        clock: Clock,
        url: str,
        devices: str,
        microsteps: str,
        axes: str = "XY",
        baud: str = "115200",
    ) -> None:
        del clock  # no call waits
        self.axes, self._url = axes, url
        steps = [float(one) for one in microsteps.split(",")]
        places = [one.partition(".")[::2] for one in devices.split(",")]
        if not len(axes) == len(places) == len(steps) or min(steps) <= 0.0:
            what = f"{len(places)} devices and {len(steps)} microsteps for the axes {axes}"
            raise LimitError("Zaber", what, hint="Give one above 0 for each axis.")
        self._steps = dict(zip(axes, steps, strict=True))
        with self._errors("open"):
            self._connection = _opened(url, int(baud))
        try:
            self._connection.default_request_timeout = ANSWER_MS
            self._axes = {
                letter: self._connection.get_device(int(address)).get_axis(int(number or 1))
                for letter, (address, number) in zip(axes, places, strict=True)
            }
            with self._errors("identify"):
                self._identify()
            self.stop()  # opening a port resets no device
        except BaseException:
            self.close()
            raise

    def _identify(self) -> None:
        own = {axis.device.device_address: axis.device for axis in self._axes.values()}.values()
        asked = {"serial_number": "system.serial", "firmware": "version"}
        said = {
            name: [device.generic_command(f"get {key}").data for device in own]
            for name, key in asked.items()
        }
        self.identity = {name: ", ".join(each) for name, each in said.items()}
        versions = [tuple(int(part) for part in one.split(".")[:2]) for one in said["firmware"]]
        self._own_speeds = min(versions) >= OWN_SPEEDS
        self._speeds = {
            letter: round(axis.settings.get("maxspeed")) for letter, axis in self._axes.items()
        }
        self._slowed = dict[str, Axis]()  # by us, with a firmware whose moves have no speed
        self.limits: Mapping[str, tuple[float, float]] = {
            letter: (
                axis.settings.get("limit.min") / self._steps[letter],
                axis.settings.get("limit.max") / self._steps[letter],
            )
            for letter, axis in self._axes.items()
        }
        self.feed_mm_min = min(
            60.0 * speed / SPEED / self._steps[letter] for letter, speed in self._speeds.items()
        )

    def read(self) -> StageState:
        """Of each axis one answer: its place, whether it moves, and its most serious flag."""
        place, flags, moving = dict[str, float](), dict[str, str](), False
        with self._errors("read"):
            for letter, axis in self._axes.items():
                said = axis.generic_command("get pos")
                try:
                    place[letter] = float(said.data) / self._steps[letter]
                except ValueError:
                    what = "a position is no number"
                    raise ProtocolError("Zaber", what, asked="get pos", seen=said.data) from None
                moving |= said.status == "BUSY"
                flags[letter] = said.warning_flag
            while self._slowed and not moving:
                letter, axis = self._slowed.popitem()
                axis.settings.set("maxspeed", self._speeds[letter])
        faults = [
            f"axis {letter}: {FLAGS.get(flag, 'a warning that is not known')} ({flag})"
            for letter, flag in flags.items()
            if flag not in HARMLESS | UNHOMED
        ]
        homed = not UNHOMED.intersection(flags.values())
        return StageState(place, moving, homed, ", ".join(faults))

    def home(self) -> None:
        """Old warnings end, then all axes home at once."""
        with self._errors("home"):
            for axis in self._axes.values():
                axis.warnings.clear_flags()
                axis.home(wait_until_idle=False)

    def move(self, place: Mapping[str, float], feed_mm_min: float) -> None:
        """Each axis at ``feed_mm_min``: they go at once, and it is no straight line."""
        with self._errors("move"):
            for letter, to in place.items():
                axis, steps = self._axes[letter], self._steps[letter]
                speed = round(feed_mm_min / 60.0 * steps * SPEED)
                if not self._own_speeds and speed != self._speeds[letter]:
                    self._slowed[letter] = axis
                    axis.settings.set("maxspeed", speed)
                own = speed if self._own_speeds else 0
                there = round(to * steps)
                axis.move_absolute(there, Units.NATIVE, wait_until_idle=False, velocity=own)

    def stop(self) -> None:
        """Of all devices on the chain, by one message without waiting for their answers."""
        with self._errors("stop"):
            self._connection.generic_command_no_response("stop")

    def close(self) -> None:
        self._connection.close()

    @contextmanager
    def _errors(self, asked: str) -> Iterator[None]:
        try:
            yield
        except zaber.MotionLibException as error:
            who, what = f"Zaber at {self._url}", error.message
            if isinstance(error, LOST):
                look = "Check power, cable and baud rate, and the devices' numbers and protocol."
                raise LinkError(who, what, asked=asked, hint=look) from error
            kind = LimitError if isinstance(error, zaber.BadDataException) else DeviceError
            hint = "A parked axis is unparked by homing." if "PARKED" in what else None
            raise kind(who, what, asked=asked, hint=hint) from error


def _opened(url: str, baud: int) -> Connection:
    """The chain at ``url``, which no other program then has."""
    at = urlsplit(url)
    if at.scheme in ("tcp", "socket"):
        return Connection.open_tcp(at.hostname or "", at.port or Connection.TCP_PORT_CHAIN)
    return Connection.open_serial_port(url, baud, direct=True)
