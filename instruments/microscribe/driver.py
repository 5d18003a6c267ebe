"""The host's end of a MicroScribe arm: identity, packets, and positions.

The protocol has no checksum and no error codes. So damaged packets are asked for again, several
packets make a reading, and no position is given before the operator has confirmed homing; a lost
session loses the homing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

from instruments.clock import Clock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.microscribe.configuration import (
    DeviceInfo,
    Identity,
    Maxima,
    Parameters,
    angle_rad,
)
from instruments.microscribe.connection import SYSFS, ArmConnection, latency_warning
from instruments.microscribe.errors import ArmMovesError, NoSessionError
from instruments.microscribe.kinematics import ArmGeometry
from instruments.microscribe.protocol import Packet
from instruments.microscribe.session import ANSWER_S
from instruments.microscribe.stream import (
    DEBOUNCE_S,
    PedalEvent,
    Reading,
    Sample,
    Sampler,
    Streaming,
    poll_command,
    reading_of,
    stream_request,
)

__all__ = ["INTERVAL_S", "MAX_SPREAD_MM", "MicroScribe", "PedalEvent", "Reading", "Sample"]

# Eight packets of a still arm spread by some 0.35 mm at most: rounding (0.31 mm a packet) and a
# hand's tremor.
MAX_SPREAD_MM = 1.0
INTERVAL_S = 0.01
PEDAL_INTERVAL_S = 0.005
RECOVER_S = 30.0


class MicroScribe:
    """One arm on one link, which it owns. Only a hand moves it.

    ``rates``: tried by sign-on; default the link's own, then on a serial port all others.
    ``tip_longer_mm``: length of the fitted tip over the standard one. ``answer_s``: how long an
    answer is waited for, three times, before the arm counts as lost. ``sysfs``: where Linux shows
    its adapters.
    """

    moves: ClassVar[bool] = False
    safe_state: ClassVar[str] = "session ended; it has no motor"

    def __init__(
        self,
        link: Link,
        clock: Clock,
        *,
        rates: Sequence[int] | None = None,
        tip_longer_mm: float = 0.0,
        answer_s: float = ANSWER_S,
        sysfs: Path = SYSFS,
    ) -> None:
        self.who = link.who
        self._link = link
        self._clock = clock
        self._tip_longer_mm = tip_longer_mm
        self._sysfs = sysfs
        self._arm = ArmConnection(link, clock, rates, answer_s)
        self._geometry: tuple[DeviceInfo, ArmGeometry] | None = None

    # Who it is

    @property
    def identity(self) -> Identity:
        """The seven names, as read at sign-on. Raises NoSessionError before it."""
        return self._known().identity

    @property
    def maxima(self) -> Maxima:
        """Full scales, as read at sign-on. Raises NoSessionError before it."""
        return self._known().maxima

    @property
    def parameters(self) -> Parameters:
        """Denavit-Hartenberg parameters, as read at sign-on. Raises NoSessionError before it."""
        return self._known().parameters

    @property
    def beta_rad(self) -> float:
        """The extended parameter, 0 where there is none. Raises NoSessionError before sign-on."""
        return angle_rad(self._known().beta)

    @property
    def geometry(self) -> ArmGeometry:
        """The arm's shape with the fitted tip. Raises NoSessionError before sign-on."""
        info = self._known()
        if self._geometry is None or self._geometry[0] is not info:
            self._geometry = info, info.geometry(self._tip_longer_mm)
        return self._geometry[1]

    @property
    def baud(self) -> int:
        """The rate that the link is at: after sign-on, the one that worked."""
        return self._link.baud

    def record(self) -> dict[str, object]:
        """The arm's own data and how it was read. Raises NoSessionError before sign-on."""
        return {**self._known().record(), "baud": self.baud, "tip_longer_mm": self._tip_longer_mm}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about a slow adapter, another rate, and joints that lose count."""
        told = [latency_warning(self._link.url, self._sysfs)]
        if self._arm.info:
            told += [self._arm.rate_warning(), *self._arm.info.warnings()]
        return tuple(sentence for sentence in told if sentence)

    @property
    def homed(self) -> bool:
        """Whether homing has been confirmed in this session."""
        return self._arm.homing.confirmed and self.live

    @property
    def live(self) -> bool:
        """Whether a session is open, as far as is known."""
        return self._arm.session.live

    @property
    def damaged(self) -> int:
        """Packets that came damaged since the driver was made."""
        return self._arm.session.damaged

    # Sessions

    def sign_on(self) -> Identity:
        """Find the arm, open a session, and read who it is; homing has to be confirmed afterwards.

        Opens a broken link again. Raises LinkError (SilentArmError: no answer), NoMicroScribeError,
        UnusableArmError, UnstableUnitError, or ProtocolError for damaged answers.
        """
        return self._arm.sign_on().identity

    def recover(self, timeout_s: float = RECOVER_S) -> Identity:
        """After a loss: wait for port and arm, and sign on again at the rate that worked.

        Homing has to be confirmed afterwards. Raises what ``sign_on`` raised last once
        ``timeout_s`` have passed; at once what is refused for good, and AnotherArmError for another
        serial number.
        """
        return self._arm.recover(timeout_s).identity

    def set_baud(self, baud: int) -> None:
        """Change the rate and check it. Raises LimitError for an unknown rate, else as ``poll``."""
        self._arm.need_session("another rate")
        with self._arm.noticing():
            self._arm.session.ask_baud(baud)
        self.poll()

    def safe(self) -> None:
        """End the session, if any. Raises LinkError when the link is broken."""
        self._arm.end()

    def close(self) -> None:
        """End the session and close the link; once more is no error."""
        try:
            with contextlib.suppress(LinkError):  # a broken link has no session to end
                self.safe()
        finally:
            self._link.close()

    # Homing

    def confirm_homed(self) -> None:
        """The operator confirms that the stylus was on its peg at power-up, or was homed since.
        Raises NoSessionError; NotHomedError after a search for the rate, when only homing helps.
        """
        self._arm.need_session("to confirm homing")
        self._arm.homing.confirm()

    def home(self) -> None:
        """Make the arm load its home counts. Only with the stylus on its peg: anywhere else ruins
        every position. Raises NoSessionError, LinkError, or ProtocolError without confirmation.
        """
        self._arm.need_session("to home")
        self._arm.homing.lost("the arm was asked to home, and did not confirm it")
        with self._arm.noticing():
            self._arm.session.ask_home()
        self._arm.homing.homed()

    # Packets and positions

    def poll(self, *, encoders: int = 6, stamped: bool = False) -> Packet:
        """One packet of six counts, or five; asked for again when damaged.

        Raises NoSessionError, StreamingError within a stream, ProtocolError when every attempt came
        damaged; LinkError (SilentArmError: no answer), which loses session and homing.
        """
        self._arm.need_session("a packet")
        return self._arm.packet(poll_command(encoders, stamped))

    def read(
        self, n: int = 8, max_spread_mm: float = MAX_SPREAD_MM, *, interval_s: float = INTERVAL_S
    ) -> Reading:
        """One position from ``n`` packets, ``interval_s`` apart.

        Raises NotHomedError, ArmMovesError for a tip further than ``max_spread_mm`` from the
        median, ValueError for n below 1, else as ``poll``.
        """
        if n < 1:
            raise ValueError(f"a reading needs one packet at least, not {n}")
        self._arm.need_session("a reading")
        self._arm.homing.require("a reading")
        counts = [self.poll().counts]
        for _ in range(n - 1):
            self._clock.sleep(interval_s)
            counts.append(self.poll().counts)
        reading = reading_of(self.geometry, counts)
        if not reading.spread_mm <= max_spread_mm:
            what = (
                f"the arm moves: {n} packets spread by {reading.spread_mm:.2f} mm, more than"
                f" {max_spread_mm:g} mm"
            )
            raise ArmMovesError(
                self.who,
                what,
                asked="a reading",
                hint="Hold the tip still in its place and read again",
            )
        return reading

    def wait_for_pedal(
        self,
        timeout_s: float,
        *,
        debounce_s: float = DEBOUNCE_S,
        interval_s: float = PEDAL_INTERVAL_S,
    ) -> PedalEvent | None:
        """The next press, by the host's clock; None after ``timeout_s``. A pedal that is down has
        to come up first. Raises ValueError for a negative time, else as ``poll``.
        """
        sampler = Sampler(self._arm.arm_time, debounce_s)
        deadline = self._clock.now() + timeout_s
        while True:
            for event in sampler.sample(self.poll(), self._clock.now()).events:
                if event.pressed:
                    return event
            if self._clock.now() >= deadline:
                return None
            self._clock.sleep(interval_s)

    @contextlib.contextmanager
    def stream(
        self,
        rate_hz: float | None = None,
        *,
        encoders: int = 6,
        stamped: bool = True,
        debounce_s: float = DEBOUNCE_S,
    ) -> Iterator[Iterator[Sample]]:
        """Samples without end, at ``rate_hz`` at least (None: the fastest): ``with arm.stream(50)
        as samples:``.

        Ends the stream on the way out and drops what is left. A silent stream is started again if
        the arm still answers. Raises NoSessionError, StreamingError, ValueError for an impossible
        rate; while it runs, as ``poll``.
        """
        self._arm.need_session("a stream")
        request = stream_request(rate_hz, poll_command(encoders, stamped))
        streaming = Streaming(
            self._arm, self._clock, request, Sampler(self._arm.arm_time, debounce_s)
        )
        streaming.start()
        try:
            yield streaming.samples()
        finally:
            streaming.stop()

    def position(self, samples: Sequence[Sample]) -> Reading:
        """The reading of samples, whatever their spread: to show while the arm moves, not to
        measure with. Raises NotHomedError, NoSessionError, and ValueError for no samples.
        """
        if not samples:
            raise ValueError("a reading needs one sample at least")
        self._arm.homing.require("a position")
        return reading_of(self.geometry, [sample.counts for sample in samples])

    def _known(self) -> DeviceInfo:
        if self._arm.info is None:
            raise NoSessionError(
                self.who, "who the arm is has not been read yet", hint="Sign on first"
            )
        return self._arm.info
