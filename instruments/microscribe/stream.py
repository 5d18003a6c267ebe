"""What is made of packets: positions, samples, and pedal events without bounce."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from instruments.microscribe.kinematics import ArmGeometry

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
    """A change counts once every packet for 20 ms has shown it. A pedal that is down in
    the first packet is no event.
    """

    def __init__(self) -> None:
        self._settled: int | None = None
        self._since: dict[Pedal, float] = {}

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
        if t_s - since < DEBOUNCE_S - 1e-9:
            return None
        del self._since[pedal]
        self._settled = (self._settled or 0) ^ pedal.value
        return PedalEvent(pedal, bool(buttons & pedal.value), since)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One position in the arm's frame. ``tip_mm`` (3,) is the median tip, ``spread_mm`` the largest
    distance of a packet's tip from it, ``axis`` (3,) the unit median direction from the tip up the
    stylus, ``n`` the packets, ``counts`` the last packet's.
    """

    tip_mm: npt.NDArray[np.float64]
    spread_mm: float
    axis: npt.NDArray[np.float64]
    n: int
    counts: tuple[int, ...]


def reading_of(geometry: ArmGeometry, counts: Sequence[tuple[int, ...]]) -> Reading:
    """The reading of counts (n, 6), n at least 1. One wrong packet moves no median."""
    tips, axes = geometry.forward(np.array(counts))
    tip, axis = np.median(tips, axis=0), np.median(axes, axis=0)
    spread_mm = float(np.linalg.norm(tips - tip, axis=1).max())
    return Reading(tip, spread_mm, axis / np.linalg.norm(axis), len(counts), counts[-1])


@dataclass(frozen=True, slots=True)
class Sample:
    """One packet: raw ``counts`` and ``buttons``. ``t_s`` is by the arm's clock from the session's
    first stamp; by the host's clock without a stamp.
    """

    t_s: float
    counts: tuple[int, ...]
    buttons: int
