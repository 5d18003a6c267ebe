"""What every step of a run does beside its work: signs of life for the guardian, looks at the interlocks, the record's events.

May not know what the steps are.
"""

from __future__ import annotations

from bench.devices import Devices
from bench.pulse import BRIEF_S, Pulse
from bench.showing import Progress
from bench.store import Store
from bench.watch import Watch
from instruments.clock import wall_time

LOOK_S = 1.0


class Attention:
    """Time passes through ``wait`` only, so that no wait goes by without a look at the interlocks every second."""

    def __init__(self, devices: Devices, store: Store, progress: Progress, pulse: Pulse, watch: Watch) -> None:
        self._clock = devices.clock
        self._store = store
        self._pulse = pulse
        self.progress = progress
        self.watch = watch

    def wait(self, seconds: float) -> None:
        """Let time pass. Raises InterlockTrip."""
        end_s = self._clock.now() + seconds
        self.check()
        while (left_s := end_s - self._clock.now()) > 0.0:
            self._clock.sleep(min(LOOK_S, left_s))
            self.check()

    def check(self) -> None:
        """The bench lives; raises InterlockTrip where an interlock has tripped."""
        self._pulse.sign("going on")
        self.watch.check()

    def long(self, what: str, at_most_s: float, *, silent: bool = False) -> None:
        """``what`` may take ``at_most_s`` before the guardian takes the bench for hung: with signs of life, or where it must be in silence.

        Whatever waits on a clock or a link gives those signs; what computes, or is another's code, is ``silent``.
        """
        self._pulse.sign(what, at_most_s, silence_s=None if silent else BRIEF_S)

    def note(self, text: str) -> None:
        """Tell the operator, and the record."""
        self.progress.state(text)
        self.event("state", text)

    def event(self, kind: str, text: str) -> None:
        """A line in the record, with its time."""
        self._store.event(self._clock.now(), kind, text, wall_time())
