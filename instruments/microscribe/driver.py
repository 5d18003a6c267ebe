"""The host's end of a MicroScribe arm: identity, packets, and positions.

The protocol has no checksum: damaged packets are asked for again, and several make a reading. There
is no position before homing is confirmed, since an arm that was not homed gives plausible, wrong
ones. A broken link is closed at once, which frees its port's name, and opened by the next sign-on.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import DeviceInfo, Identity
from instruments.microscribe.connection import (
    ANSWER_S,
    ATTEMPTS,
    CABLE_HINT,
    SIGN_ON_S,
    ArmConnection,
)
from instruments.microscribe.errors import (
    AnotherArmError,
    ArmMovesError,
    NoSessionError,
    NotHomedError,
    SilentArmError,
    UnusableArmError,
)
from instruments.microscribe.protocol import ArmTime, Code, Packet
from instruments.microscribe.stream import Reading, Sample

# eight packets of a still arm spread by some 0.35 mm: rounding (0.31 mm a packet) and tremor
MAX_SPREAD_MM = 1.0
INTERVAL_S = 0.01
STREAMED = wire.POLL | wire.TIME_STAMP
RECOVER_S = 30.0
_RETRY_S = 0.25
_RETRY_SIGN_ON_S = 1.0  # a port that is back is noticed, and its arm signed on, well within 2 s
_RATES = (115200, 38400, 57600, 19200, 9600, 28800, 14400)  # the likely ones first
SYSFS = Path("/sys")
FTDI_DEVICES = r"SYSTEM\CurrentControlSet\Enum\FTDIBUS"  # in the registry
WANTED_MS = 1

_CONFIRM_HINT = (
    "Confirm it if the stylus sat on its peg when the arm was last switched on; "
    "else put the stylus on its peg, switch the arm off and on, sign on, and confirm"
)
_HOME_HINT = (
    "Put the stylus on its peg and home the arm ('teatbench arm home'), or switch it off and on"
    " there and sign on again"
)
_BACK_HINT = (
    "Check power and cable, and sign on again; if it lost its power, switch it on with its stylus"
    " on its peg"
)
_DOUBT = (
    "the arm was in a session at another baud rate, and what was sent at the wrong one may have"
    " re-homed it"
)


class MicroScribe:
    """One arm on one link, which it owns. ``rates``: tried by sign-on, the first one for longest;
    default the link's own, then on a serial port all others. ``answer_s``: time for an answer, of
    which three have to be missing before the arm counts as lost.
    """

    moves: ClassVar[bool] = False
    safe_state: ClassVar[str] = "session ended; it has no motor"
    homing: ClassVar[str] = (
        "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."
    )
    homing_again: ClassVar[str] = (
        "The arm was lost: put its stylus on its peg, see that it is switched on, and leave the"
        " stylus there."
    )

    def __init__(
        self,
        link: Link,
        clock: Clock,
        *,
        rates: Sequence[int] | None = None,
        answer_s: float = ANSWER_S,
    ) -> None:
        self.who = link.who
        self._link = link
        self._clock = clock
        if rates is None:  # a socket's far end keeps its own rate
            others = () if link.url.startswith("socket://") else _RATES
            rates = (link.baud, *(rate for rate in others if rate != link.baud))
        self._rates = tuple(rates)
        self._arm = ArmConnection(link, clock, answer_s)
        self._arm_time = ArmTime()
        self._info: DeviceInfo | None = None
        self._broken = False
        self._not_homed: str | None = "it has not been confirmed since sign-on"  # why; None: homed
        self._doubt = ""  # why a confirmation is not enough

    @property
    def info(self) -> DeviceInfo:
        """The arm's own data, as read at sign-on. Raises NoSessionError before it."""
        if self._info is None:
            raise NoSessionError(self.who, "it has not been identified yet", hint="Sign on first")
        return self._info

    @property
    def identity(self) -> Identity:
        """The seven names, as read at sign-on. Raises NoSessionError before it."""
        return self.info.names

    @property
    def baud(self) -> int:
        """The rate that the link is at: after sign-on, the one that worked."""
        return self._link.baud

    def record(self) -> dict[str, object]:
        """The arm's own data and how it was read. Raises NoSessionError before sign-on."""
        return {**self.info.record(), "baud": self.baud}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about a slow adapter, another rate, and joints that lose count."""
        found = [latency_warning(self._link.url)]
        if self._info and self.baud != self._rates[0]:
            found.append(f"the arm answers at {self.baud} baud, not at {self._rates[0]}")
        found += self._info.warnings() if self._info else []
        return tuple(warning for warning in found if warning)

    @property
    def homed(self) -> bool:
        """Whether homing has been confirmed in this session."""
        return self._not_homed is None and self.live

    @property
    def live(self) -> bool:
        """Whether a session is open, as far as the host can tell."""
        return self._arm.live

    @property
    def damaged(self) -> int:
        """Packets that came damaged since the driver was made."""
        return self._arm.damaged

    # Sessions

    def sign_on(self) -> Identity:
        """Find the arm and open a session, and before it a broken link; homing has to be confirmed
        afterwards. Raises LinkError (SilentArmError: no answer), NoMicroScribeError,
        UnusableArmError, ProtocolError for damaged answers.
        """
        return self._sign_on(self._rates, SIGN_ON_S)

    def recover(self, timeout_s: float = RECOVER_S) -> Identity:
        """After a loss: wait for port and arm, and sign on at the rate that worked. Raises what
        ``sign_on`` raised last once ``timeout_s`` have passed; at once UnusableArmError, and
        AnotherArmError for another serial number.
        """
        before, deadline = self._info, self._clock.now() + timeout_s
        try:
            while True:
                patience_s = min(_RETRY_SIGN_ON_S, max(_RETRY_S, deadline - self._clock.now()))
                try:
                    now = self._sign_on((self.baud,), patience_s)
                    break
                except UnusableArmError:
                    raise
                except (LinkError, ProtocolError):
                    if self._clock.now() + _RETRY_S >= deadline:
                        raise
                self._clock.sleep(_RETRY_S)
            there = now.serial_number
            if before and before.names.serial_number != there:
                self.safe()
                what = f"arm {before.names.serial_number} was lost, and arm {there} answers"
                hint = "Plug the first arm in again, or sign on to the new one"
                raise AnotherArmError(self.who, what, hint=hint)
        except BaseException:
            self._info = before  # still the arm that is waited for
            raise
        return now

    def _sign_on(self, rates: Sequence[int], patience_s: float) -> Identity:
        self._lose_homing("the session was opened anew")
        self._info = None
        self._arm_time = ArmTime()
        if self._broken:
            self._link.reopen()
            self._broken = False
        with self._noticing():
            self._info, baud = self._arm.open(rates, patience_s)
        self._doubt = _DOUBT if baud != rates[0] else ""
        return self._info.names

    def safe(self) -> None:
        """End the session, if any. Raises LinkError when the link is broken."""
        self._lose_homing("the session was ended")
        with self._noticing():
            self._arm.end()

    def close(self) -> None:
        """End the session and close the link; once more is no error."""
        try:
            with contextlib.suppress(LinkError):  # a broken link has no session to end
                self.safe()
        finally:
            self._link.close()

    @contextlib.contextmanager
    def _noticing(self) -> Iterator[None]:
        """A link that breaks in here costs the session and the homing."""
        try:
            yield
        except SilentArmError:
            raise  # the link is whole
        except LinkError:
            self._broken = True
            self._lose_homing("the link broke, and the arm may have lost its power")
            self._arm.lose()
            self._link.close()
            raise

    def _need_session(self, asked: str) -> None:
        """Raise NoSessionError without a session, LimitError within a stream."""
        if not self.live:
            raise NoSessionError(self.who, "there is no session", asked=asked, hint="Sign on first")
        if self._arm.streaming:
            raise LimitError(self.who, "a stream runs", asked=asked, hint="End the stream first")

    # Homing

    def confirm_homed(self) -> None:
        """The operator confirms that the stylus was on its peg at power-up, or was homed since.
        Raises NoSessionError; NotHomedError after a search for the rate, when only homing helps.
        """
        self._need_session("to confirm homing")
        if self._doubt:
            raise NotHomedError(self.who, self._doubt, asked="to confirm homing", hint=_HOME_HINT)
        self._not_homed, self._doubt = None, ""

    def home(self) -> None:
        """Make the arm load its home counts. Only with the stylus on its peg: anywhere else ruins
        every position. Raises NoSessionError, LinkError, or ProtocolError without confirmation.
        """
        self._need_session("to home")
        self._lose_homing("the arm was asked to home, and did not confirm it")
        with self._noticing():
            self._arm.ask(Code.HOME, partial(conf.decode, Code.HOME))
        self._not_homed, self._doubt = None, ""

    def _lose_homing(self, why: str) -> None:
        if self._not_homed is None:
            self._not_homed = why

    def _need_homing(self, asked: str) -> None:
        if self._not_homed is not None:
            hint = _HOME_HINT if self._doubt else _CONFIRM_HINT
            what = f"no positions before homing is confirmed: {self._doubt or self._not_homed}"
            what += ". An arm that was not homed gives plausible, wrong ones"
            raise NotHomedError(self.who, what, asked=asked, hint=hint)

    # Packets and positions

    def poll(self) -> Packet:
        """One packet of six counts; asked for again when damaged.

        Raises NoSessionError, LimitError within a stream, ProtocolError when every attempt came
        damaged; LinkError (SilentArmError: no answer), which loses session and homing.
        """
        self._need_session("a packet")
        return self._packet()

    def _packet(self) -> Packet:
        seen, start = b"", self._clock.now()
        for _ in range(ATTEMPTS):
            with self._noticing():
                packet, came = self._arm.ask_packet()
            if packet is not None:
                return packet
            seen = came or seen
        asked, seconds = bytes([wire.POLL]), self._clock.now() - start
        if seen:
            what = f"{ATTEMPTS} packets in a row came damaged"
            raise ProtocolError(self.who, what, asked=asked, seen=seen, hint=CABLE_HINT)
        self._lose_homing("the arm fell silent: it may have lost its power")
        self._arm.lose()
        what = "the arm has fallen silent: without power or cable, session and homing are lost"
        hint = _BACK_HINT
        raise SilentArmError(self.who, what, asked=asked, seen=b"", seconds=seconds, hint=hint)

    def read(self, n: int = 8, max_spread_mm: float = MAX_SPREAD_MM) -> Reading:
        """One position from ``n`` packets, 10 ms apart. Raises NotHomedError, ArmMovesError for a
        tip further than ``max_spread_mm`` from the median, ValueError for n below 1, else as
        ``poll``.
        """
        if n < 1:
            raise ValueError(f"a reading needs one packet at least, not {n}")
        self._need_session("a reading")
        self._need_homing("a reading")
        counts = [self.poll().counts]
        while len(counts) < n:
            self._clock.sleep(INTERVAL_S)
            counts.append(self.poll().counts)
        reading = self._reading(counts)
        if not reading.spread_mm <= max_spread_mm:
            what = f"the arm moves: {n} packets spread by {reading.spread_mm:.2f} mm, more than"
            what, hint = f"{what} {max_spread_mm:g} mm", "Hold the tip still and read again"
            raise ArmMovesError(self.who, what, asked="a reading", hint=hint)
        return reading

    @contextlib.contextmanager
    def stream(self) -> Iterator[Iterator[Sample]]:
        """Samples without end, as fast as the arm sends them: ``with arm.stream() as samples:``. A
        silent stream is started again if the arm still answers. Raises NoSessionError, LimitError
        within a stream; while it runs, as ``poll``.
        """
        self._need_session("a stream")
        self._start_stream()
        try:
            yield self._samples()
        finally:
            with self._noticing():
                self._arm.stop_stream()

    def _start_stream(self) -> None:
        start, seen = self._clock.now(), b""
        for _ in range(ATTEMPTS):
            with self._noticing():
                came = self._arm.start_stream(STREAMED)
            if came is None:
                return
            seen = came or seen
        what = f"{ATTEMPTS} requests for a stream were answered otherwise"
        kind: type[InstrumentError] = ProtocolError
        if not seen:
            self._packet()  # raises where the arm is gone
            kind, what = SilentArmError, "the arm answers polls, but no stream"
        seconds = self._clock.now() - start
        asked, hint = bytes([Code.STREAM]), f"{CABLE_HINT}; or poll"
        raise kind(self.who, what, asked=asked, seen=seen[-64:], seconds=seconds, hint=hint)

    def _samples(self) -> Iterator[Sample]:
        while True:
            if not self._arm.streaming:
                what, asked = "the stream has ended", "the next sample"
                raise NoSessionError(self.who, what, asked=asked, hint="Start another stream")
            with self._noticing():
                packets = self._arm.stream_packets()
            if not packets:  # the command may have been lost, or the arm
                with self._noticing():
                    self._arm.stop_stream()
                self._packet()
                self._start_stream()
            host_s = self._clock.now()
            for packet in packets:
                t_s = self._arm_time.seconds(packet.ticks or 0, host_s)
                yield Sample(t_s, packet.counts, packet.buttons)

    def position(self, samples: Sequence[Sample]) -> Reading:
        """The reading of samples, whatever their spread: to show while the arm moves, not to
        measure with. Raises NotHomedError, NoSessionError, and ValueError for no samples.
        """
        if not samples:
            raise ValueError("a reading needs one sample at least")
        self._need_homing("a position")
        return self._reading([sample.counts for sample in samples])

    def _reading(self, counts: Sequence[tuple[int, ...]]) -> Reading:
        """Of counts (n, 6), n at least 1. One wrong packet moves no median."""
        tips, axes = self.info.geometry().forward(np.array(counts))
        tip, axis = np.median(tips, axis=0), np.median(axes, axis=0)
        spread_mm = float(np.linalg.norm(tips - tip, axis=1).max())
        return Reading(tip, spread_mm, axis / np.linalg.norm(axis), len(counts), counts[-1])


def latency_warning(port: str, sysfs: Path = SYSFS) -> str | None:
    """Advice about a slow adapter behind a port's path, link or name; None when fine or unknown."""
    if re.fullmatch(r"COM\d+", port):
        latency_ms, name = _windows_latency_ms(port), port
        how = (
            f"in Device Manager, Ports, {port}, Port Settings, Advanced: Latency Timer {WANTED_MS}"
        )
    elif port.startswith("/"):
        name = Path(port).resolve().name
        timer = sysfs / "bus" / "usb-serial" / "devices" / name / "latency_timer"
        try:
            latency_ms = int(timer.read_text(encoding="ascii"))
        except (OSError, ValueError):  # no USB adapter, one without a timer, or no Linux
            return None
        how = f"with: echo {WANTED_MS} | sudo tee {timer.as_posix()} (until it is plugged in again)"
    else:
        return None
    if latency_ms is None or latency_ms <= WANTED_MS:
        return None
    return (
        f"the USB adapter {name} holds bytes back for {latency_ms} ms, which every poll waits for."
        f" Set it {how}, or stream instead of polling"
    )


def _windows_latency_ms(port: str) -> int | None:
    """What FTDI's driver keeps in the registry for ``port``; None for another adapter."""
    try:
        registry: Any = import_module("winreg")
    except ImportError:
        return None
    with contextlib.suppress(OSError):
        for device in _subkeys(registry, FTDI_DEVICES):
            for instance in _subkeys(registry, f"{FTDI_DEVICES}\\{device}"):
                path = f"{FTDI_DEVICES}\\{device}\\{instance}\\Device Parameters"
                with (
                    contextlib.suppress(OSError),
                    registry.OpenKey(registry.HKEY_LOCAL_MACHINE, path) as key,
                ):
                    if registry.QueryValueEx(key, "PortName")[0] == port:
                        return int(registry.QueryValueEx(key, "LatencyTimer")[0])
    return None


def _subkeys(registry: Any, path: str) -> list[str]:
    with registry.OpenKey(registry.HKEY_LOCAL_MACHINE, path) as key:
        return [registry.EnumKey(key, at) for at in range(registry.QueryInfoKey(key)[0])]
