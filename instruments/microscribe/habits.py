"""What is not known of a real arm, and how an emulated one does it: each U of ../shared/instruments/microscribe.md is a choice.

Here too is the rule by which a stream by differences sends. It may not know time, nor the wire.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.kinematics import COUNT_MODULUS


@dataclass(frozen=True, slots=True)
class Habits:
    """``echoes_again``: an IMMC behind the echoed one is echoed too. ``release_triggers``: so does a pedal that comes up, in
    a stream by differences. ``deltas_from``: what an encoder's difference is measured from there.
    """

    echoes_again: bool = True
    release_triggers: bool = True
    deltas_from: Literal["last packet", "last look"] = "last packet"


@dataclass(frozen=True, slots=True)
class Look:
    """What the arm sees of itself at one moment."""

    buttons: int
    counts: Sequence[int]


class Trigger:
    """Says at each look whether a stream by differences sends. A delta of 0 leaves its encoder out, a mask bit of 0 its pedal.

    Nothing is plugged into the emulated arm's analog channels, so that they never differ.
    """

    def __init__(self, request: StreamRequest, habits: Habits, first: Look) -> None:
        self._mask = request.button_mask
        self._deltas = request.encoder_deltas
        self._habits = habits
        self._before = first.buttons
        self._from = first.counts

    def fires(self, now: Look) -> bool:
        """Whether a pedal changed since the last look, or an encoder by its delta."""
        changed = (now.buttons ^ self._before) & self._mask
        if not self._habits.release_triggers:
            changed &= now.buttons
        moved = any(delta and _apart(a, b) >= delta for delta, a, b in zip(self._deltas, now.counts, self._from, strict=False))
        fires = bool(changed) or moved
        self._before = now.buttons
        if fires or self._habits.deltas_from == "last look":
            self._from = now.counts
        return fires


def _apart(a: int, b: int) -> int:
    """Counts from one to the other, the shorter way round."""
    forward = (a - b) % COUNT_MODULUS
    return min(forward, COUNT_MODULUS - forward)
