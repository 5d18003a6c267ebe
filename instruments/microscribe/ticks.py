"""The arm's own clock: 14-bit ticks of 1.111 ms that wrap after some 18 s, as seconds that go on.

The host's clock is the coarse hand: it only says how many wraps went by between two packets, so that a pause of minutes
loses nothing and the host's delays don't show. Pure: it may not know where packets come from.
"""

from __future__ import annotations

from instruments.microscribe.protocol import TICK_MODULUS, TICK_S


class ArmTime:
    """Seconds since the first stamp, by the arm's clock.

    Right as long as the host sees two stamps in a row with delays that differ by less than half a wrap, 9 s.
    """

    def __init__(self) -> None:
        self._ticks = 0
        self._last: tuple[int, float] | None = None

    def seconds(self, ticks: int, host_s: float) -> float:
        """When a packet was made whose stamp is ``ticks`` (0 to 16383) and that the host got at ``host_s``."""
        if self._last is not None:
            step = (ticks - self._last[0]) % TICK_MODULUS
            wraps = max(0, round(((host_s - self._last[1]) / TICK_S - step) / TICK_MODULUS))
            self._ticks += step + wraps * TICK_MODULUS
        self._last = ticks, host_s
        return self._ticks * TICK_S
