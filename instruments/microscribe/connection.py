"""An arm on its link: sign-on, loss and return of the link, homing, and the adapter's latency
timer.

An arm that was not homed gives plausible, wrong positions, so any doubt needs the operator's word.
A broken link is closed at once, which frees its port's name, and opened again before the next
sign-on.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from instruments.clock import Clock
from instruments.errors import LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe.configuration import DeviceInfo
from instruments.microscribe.errors import (
    AnotherArmError,
    NoSessionError,
    NotHomedError,
    SilentArmError,
    StreamingError,
    UnusableArmError,
)
from instruments.microscribe.protocol import ArmTime, Packet
from instruments.microscribe.session import ATTEMPTS, SIGN_ON_S, Session

_CONFIRM_HINT = (
    "Confirm it if the stylus sat on its peg when the arm was last switched on; "
    "else put the stylus on its peg, switch the arm off and on, sign on, and confirm"
)
_HOME_HINT = (
    "Put the stylus on its peg and home the arm ('teatbench arm home'), or switch it off and on"
    " there and sign on again"
)
_AT_FIRST = "it has not been confirmed since sign-on"


class Homing:
    """What is known of one arm's homing, and why it isn't confirmed."""

    def __init__(self, who: str) -> None:
        self._who = who
        self.confirmed = False
        self._why = _AT_FIRST
        self._doubt = ""

    def signed_on(self, doubt: str = "") -> None:
        """A new session. After a ``doubt``, only homing, or power cycle and sign-on, helps."""
        self.confirmed = False
        self._doubt = doubt

    def lost(self, why: str) -> None:
        """The homing is unknown for this reason until it is confirmed again."""
        if self.confirmed:
            self._why = why
        self.confirmed = False

    def confirm(self) -> None:
        """The operator confirms homing. Raises NotHomedError where only homing helps."""
        if self._doubt:
            raise NotHomedError(self._who, self._doubt, asked="to confirm homing", hint=_HOME_HINT)
        self.homed()

    def homed(self) -> None:
        """The arm has just loaded its home counts with its stylus on the peg."""
        self.confirmed, self._why, self._doubt = True, _AT_FIRST, ""

    def require(self, asked: str) -> None:
        """Raise NotHomedError unless homing is confirmed."""
        if not self.confirmed:
            why = self._doubt or self._why
            what = (
                f"no positions before homing is confirmed: {why}. An arm that was not homed gives"
                " plausible, wrong ones"
            )
            raise NotHomedError(
                self._who, what, asked=asked, hint=_HOME_HINT if self._doubt else _CONFIRM_HINT
            )


_RETRY_S = 0.25
_RETRY_SIGN_ON_S = 1.0  # a port that is back is noticed, and its arm signed on, well within 2 s
_RATES = (115200, 38400, 57600, 19200, 9600, 28800, 14400)  # the likely ones first

_BACK_HINT = (
    "Check power and cable, and sign on again; if it lost its power, switch it on with its stylus"
    " on its peg"
)
_DOUBT = (
    "the arm was in a session at another baud rate, and what was sent at the wrong one may have"
    " re-homed it"
)


class ArmConnection:
    """One arm on one link. ``rates``: what sign-on tries, the first one for longest."""

    def __init__(
        self, link: Link, clock: Clock, rates: Sequence[int] | None, answer_s: float
    ) -> None:
        self.who = link.who
        self.link = link
        if rates is None:  # a socket's far end keeps its own rate
            others = () if link.url.startswith("socket://") else _RATES
            rates = (link.baud, *(rate for rate in others if rate != link.baud))
        self.rates = tuple(rates)
        self.session = Session(link, clock, answer_s)
        self.homing = Homing(link.who)
        self.arm_time = ArmTime()
        self.info: DeviceInfo | None = None
        self._clock = clock
        self._broken = False

    def sign_on(self) -> DeviceInfo:
        """See ``MicroScribe.sign_on``."""
        return self._sign_on(self.rates, SIGN_ON_S)

    def recover(self, timeout_s: float) -> DeviceInfo:
        """See ``MicroScribe.recover``."""
        before, deadline = self.info, self._clock.now() + timeout_s
        try:
            now = self._sign_on_again(deadline)
            if before and before.identity.serial_number != now.identity.serial_number:
                self.end()
                what = (
                    f"arm {before.identity.serial_number} was lost, and arm"
                    f" {now.identity.serial_number} answers"
                )
                raise AnotherArmError(
                    self.who, what, hint="Plug the first arm in again, or sign on to the new one"
                )
        except BaseException:
            self.info = before  # still the arm that is waited for
            raise
        return now

    def end(self) -> None:
        """End the session. Raises LinkError when the link is broken: ended too, then."""
        self.homing.lost("the session was ended")
        with self.noticing():
            self.session.end()

    def packet(self, command: int) -> Packet:
        """One packet, asked for again when damaged; see ``MicroScribe.poll``."""
        seen, start = b"", self._clock.now()
        for _ in range(ATTEMPTS):
            with self.noticing():
                packet, came = self.session.ask_packet(command)
            if packet is not None:
                return packet
            seen = came or seen
        asked, seconds = bytes([command]), self._clock.now() - start
        if seen:
            what = f"{ATTEMPTS} packets in a row came damaged"
            raise ProtocolError(
                self.who, what, asked=asked, seen=seen, hint="Check cable, plugs and baud rate"
            )
        self._lose("the arm fell silent: it may have lost its power")
        what = (
            "the arm has fallen silent: it lost its power or its cable, and with it its session and"
            " its homing"
        )
        raise SilentArmError(
            self.who, what, asked=asked, seen=b"", seconds=seconds, hint=_BACK_HINT
        )

    @contextlib.contextmanager
    def noticing(self) -> Iterator[None]:
        """A link that breaks in here costs the session and the homing."""
        try:
            yield
        except SilentArmError:
            raise  # the link is whole
        except LinkError:
            self._broken = True
            self._lose("the link broke, and nobody can tell whether the arm kept its power")
            self.link.close()
            raise

    def need_session(self, asked: str) -> None:
        """Raise NoSessionError without a session, StreamingError within a stream."""
        if not self.session.live:
            raise NoSessionError(
                self.who, "there is no session with the arm", asked=asked, hint="Sign on first"
            )
        if self.session.streaming:
            raise StreamingError(
                self.who, "a stream runs", asked=asked, hint="End the stream first"
            )

    def rate_warning(self) -> str | None:
        """A sentence where the arm was found at another rate than the first."""
        if self.link.baud == self.rates[0]:
            return None
        return f"the arm answers at {self.link.baud} baud, not at {self.rates[0]}"

    def _sign_on_again(self, deadline: float) -> DeviceInfo:
        """Try until the deadline; what is refused for good is raised at once."""
        while True:
            try:
                return self._sign_on(
                    (self.link.baud,),
                    min(_RETRY_SIGN_ON_S, max(_RETRY_S, deadline - self._clock.now())),
                )
            except UnusableArmError:
                raise
            except (LinkError, ProtocolError):
                if self._clock.now() + _RETRY_S >= deadline:
                    raise
            self._clock.sleep(_RETRY_S)

    def _sign_on(self, rates: Sequence[int], patience_s: float) -> DeviceInfo:
        self.homing.lost("the session was opened anew")
        self.info = None
        self.arm_time = ArmTime()
        if self._broken:
            self.link.reopen()
            self._broken = False
        with self.noticing():
            self.info, baud = self.session.open(rates, patience_s=patience_s)
        self.homing.signed_on(_DOUBT if baud != rates[0] else "")
        return self.info

    def _lose(self, why: str) -> None:
        self.homing.lost(why)
        self.session.lose()


SYSFS = Path("/sys")
WANTED_MS = 1


def latency_warning(port: str, sysfs: Path = SYSFS) -> str | None:
    """Advice about a slow adapter behind a port's path or link; None when fine or unknown."""
    if "://" in port or not port.startswith("/"):
        return None
    name = Path(port).resolve().name
    timer = sysfs / "bus" / "usb-serial" / "devices" / name / "latency_timer"
    try:
        latency_ms = int(timer.read_text(encoding="ascii"))
    # no USB adapter, one without a timer, or no Linux: nothing is known, so nothing to say
    except (OSError, ValueError):
        return None
    if latency_ms <= WANTED_MS:
        return None
    return (
        f"the USB adapter {name} holds bytes back for {latency_ms} ms, which every poll waits for."
        f" Set it with: echo {WANTED_MS} | sudo tee {timer.as_posix()} (until it is plugged in"
        " again), or stream instead of polling"
    )
