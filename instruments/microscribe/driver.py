"""The host's end of a MicroScribe arm: who it is, packets, and readings that can be trusted.

The protocol has no checksum and no error codes, so what keeps a position honest is here: damaged packets are asked
for again, several packets make a reading, a silent arm has lost its session and with it its homing, and no
position leaves before the operator has confirmed homing (../shared/instruments/microscribe.md). It may not know
what the other end is, nor any frame of reference but the arm's own.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from instruments.clock import Clock
from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import Identity, Maxima, Parameters, angle_rad
from instruments.microscribe.kinematics import ArmGeometry
from instruments.microscribe.protocol import Packet
from instruments.microscribe.session import Session, Unit

ATTEMPTS = 3
# Eight packets of a still arm spread by some 0.35 mm at most: rounding (0.31 mm a packet) and a hand's tremor.
MAX_SPREAD_MM = 1.0
INTERVAL_S = 0.01

_HOMING_HINT = "Put the stylus on its peg, switch the arm off and on, sign on, and confirm that it was homed"


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One position in the arm's frame.

    ``tip_mm`` (3,) is the mean tip, ``spread_mm`` the largest distance of one packet's tip from it, ``axis`` (3,) the
    unit mean direction from the tip up the stylus, ``n`` the packets, ``counts`` the last packet's.
    """

    tip_mm: npt.NDArray[np.float64]
    spread_mm: float
    axis: npt.NDArray[np.float64]
    n: int
    counts: tuple[int, ...]


class MicroScribe:
    """One arm on one link, which it owns. It has no motor: only a hand moves it."""

    moves: ClassVar[bool] = False

    def __init__(self, link: Link, clock: Clock) -> None:
        self.who = link.who
        self._link = link
        self._clock = clock
        self._session = Session(link, clock)
        self._unit: Unit | None = None
        self._geometry: ArmGeometry | None = None
        self._homed = False

    @property
    def identity(self) -> Identity:
        """The seven names, as read at sign-on. Raises LimitError before it."""
        return self._known().identity

    @property
    def maxima(self) -> Maxima:
        """Full scales, as read at sign-on. Raises LimitError before it."""
        return self._known().maxima

    @property
    def parameters(self) -> Parameters:
        """Denavit-Hartenberg parameters, as read at sign-on. Raises LimitError before it."""
        return self._known().parameters

    @property
    def beta_rad(self) -> float:
        """The extended parameter, 0 where the arm has none. Raises LimitError before sign-on."""
        return angle_rad(self._known().beta)

    @property
    def geometry(self) -> ArmGeometry:
        """The arm's shape, from maxima and parameters. Raises LimitError before sign-on."""
        if self._geometry is None:
            unit = self._known()
            self._geometry = ArmGeometry.from_block(unit.parameters, self.beta_rad, unit.maxima.turns)
        return self._geometry

    @property
    def homed(self) -> bool:
        """Whether homing has been confirmed in this session."""
        return self._homed and self._session.live

    @property
    def damaged(self) -> int:
        """Packets that came damaged since the driver was made."""
        return self._session.damaged

    def sign_on(self) -> Identity:
        """Find the arm, open a session, and read who it is; homing has to be confirmed afterwards.

        Raises LinkError when nothing answers, ProtocolError when what answers is no arm that we understand.
        """
        self._homed = False
        self._unit = self._geometry = None
        self._unit = self._session.open()
        return self._unit.identity

    def confirm_homed(self) -> None:
        """The operator says: the stylus sat on its peg when the arm was switched on, or was homed since.

        Raises LimitError without a session.
        """
        self._need_session("to confirm homing")
        self._homed = True

    def home(self) -> None:
        """Make the arm load its home counts. Only with the stylus on its peg: anywhere else ruins every position.

        Raises LimitError without a session, LinkError or ProtocolError when the arm doesn't confirm.
        """
        self._need_session("to home")
        self._homed = False
        self._session.ask_home()
        self._homed = True

    def poll(self) -> Packet:
        """One packet of six counts, asked for again when damaged.

        Raises LimitError without a session; ProtocolError when every attempt came damaged; LinkError when the link
        breaks or the arm stays silent: the session is lost then, and with it the homing.
        """
        self._need_session("a packet")
        seen, start = b"", self._clock.now()
        for _ in range(ATTEMPTS):
            packet, came = self._ask()
            if packet is not None:
                return packet
            seen = came or seen
        asked = bytes([wire.POLL])
        if seen:
            what = f"{ATTEMPTS} packets in a row came damaged"
            raise ProtocolError(self.who, what, asked=asked, seen=seen, hint="Check cable, plugs and baud rate")
        self._lose_session()
        what = "the arm has fallen silent: it lost its power or its cable, and with it its session and its homing"
        raise LinkError(self.who, what, asked=asked, seen=b"", seconds=self._clock.now() - start, hint=_HOMING_HINT)

    def read(self, n: int = 8, max_spread_mm: float = MAX_SPREAD_MM, *, interval_s: float = INTERVAL_S) -> Reading:
        """One position from ``n`` packets, ``interval_s`` apart.

        Raises LimitError before homing is confirmed, and while the arm moves: a tip further than ``max_spread_mm``
        from the mean. Raises as ``poll`` does, and ValueError for n below 1.
        """
        if n < 1:
            raise ValueError(f"a reading needs one packet at least, not {n}")
        self._need_homing()
        counts = [self.poll().counts]
        for _ in range(n - 1):
            self._clock.sleep(interval_s)
            counts.append(self.poll().counts)
        tips, axes = self.geometry.forward(np.array(counts))
        tip, axis = tips.mean(axis=0), axes.mean(axis=0)
        spread_mm = float(np.linalg.norm(tips - tip, axis=1).max())
        if not spread_mm <= max_spread_mm:
            what = f"the arm moves: {n} packets spread by {spread_mm:.2f} mm, more than {max_spread_mm:g} mm"
            raise LimitError(self.who, what, asked="a reading", hint="Hold the tip still in its place and read again")
        return Reading(tip, spread_mm, axis / np.linalg.norm(axis), n, counts[-1])

    def safe(self) -> None:
        """End the session. The arm has no motion to stop. Nothing to do, and no error, without a session.

        Raises LinkError when the link is broken; the session counts as ended then too.
        """
        self._homed = False
        self._session.end()

    def close(self) -> None:
        """End the session and close the link; once more is no error."""
        try:
            with contextlib.suppress(LinkError):  # a broken link has no session to end
                self.safe()
        finally:
            self._link.close()

    def _ask(self) -> tuple[Packet | None, bytes]:
        try:
            return self._session.ask_packet()
        except LinkError:
            self._lose_session()
            raise

    def _lose_session(self) -> None:
        self._homed = False
        self._session.lose()

    def _known(self) -> Unit:
        if self._unit is None:
            raise LimitError(self.who, "who the arm is has not been read yet", hint="Sign on first")
        return self._unit

    def _need_session(self, asked: str) -> None:
        if not self._session.live:
            raise LimitError(self.who, "there is no session with the arm", asked=asked, hint="Sign on first")

    def _need_homing(self) -> None:
        self._need_session("a reading")
        if not self._homed:
            what = "no positions before homing is confirmed: an arm that was not homed gives plausible, wrong ones"
            raise LimitError(self.who, what, asked="a reading", hint=_HOMING_HINT)
