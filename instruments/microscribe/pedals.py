"""Foot pedals: presses and releases out of the buttons of packets, with the bounce of their contacts taken off.

The protocol has no debounce (../shared/instruments/microscribe.md, Pedals). Pure: it may not know the wire, and time is told
to it with each packet.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

DEBOUNCE_S = 0.02


class Pedal(Enum):
    """A pedal, by its bit; a single one is the right one."""

    RIGHT = 0x01
    LEFT = 0x02


@dataclass(frozen=True, slots=True)
class PedalEvent:
    """A pedal was pressed, or released, at ``t_s``: when its contact changed for good, on the clock that was told."""

    pedal: Pedal
    pressed: bool
    t_s: float


class Debouncer:
    """A change counts once every packet for ``debounce_s`` has shown it.

    How the pedals stand in the first packet is no event: a foot that was there before presses nothing.
    """

    def __init__(self, debounce_s: float = DEBOUNCE_S) -> None:
        """Raises ValueError for a negative time."""
        if not debounce_s >= 0:
            raise ValueError(f"a debounce time is seconds, not less than 0; got {debounce_s}")
        self._debounce_s = debounce_s
        self._settled: int | None = None
        self._since: dict[Pedal, float] = {}

    @property
    def down(self) -> frozenset[Pedal]:
        """The pedals that are down, bounce taken off."""
        return frozenset(pedal for pedal in Pedal if (self._settled or 0) & pedal.value)

    def feed(self, t_s: float, buttons: int) -> tuple[PedalEvent, ...]:
        """The events that this packet settles; ``t_s`` is when it was made."""
        if self._settled is None:
            self._settled = buttons
        return tuple(event for pedal in Pedal if (event := self._event(pedal, t_s, buttons)))

    def _event(self, pedal: Pedal, t_s: float, buttons: int) -> PedalEvent | None:
        if not (buttons ^ (self._settled or 0)) & pedal.value:
            self._since.pop(pedal, None)
            return None
        since = self._since.setdefault(pedal, t_s)
        if t_s - since < self._debounce_s - 1e-9:
            return None
        del self._since[pedal]
        self._settled = (self._settled or 0) ^ pedal.value
        return PedalEvent(pedal, bool(buttons & pedal.value), since)
