"""An arm's pedals: events without contact bounce."""

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
    """A press or release at ``t_s``, when its contact changed for good."""

    pedal: Pedal
    pressed: bool
    t_s: float


class Debouncer:
    """A change counts after 20 ms of packets that show it; pedals down at first are no event."""

    def __init__(self) -> None:
        self._settled: int | None = None
        self._since: dict[Pedal, float] = {}

    def feed(self, t_s: float, buttons: int) -> tuple[PedalEvent, ...]:
        """The events that this packet settles; ``t_s`` is when it was made."""
        if self._settled is None:
            self._settled = buttons
        events = []
        for pedal in Pedal:
            if not (buttons ^ self._settled) & pedal.value:
                self._since.pop(pedal, None)
            elif t_s - (since := self._since.setdefault(pedal, t_s)) >= DEBOUNCE_S - 1e-9:
                del self._since[pedal]
                self._settled ^= pedal.value
                events.append(PedalEvent(pedal, bool(buttons & pedal.value), since))
        return tuple(events)
