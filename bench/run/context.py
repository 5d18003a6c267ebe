"""What every step of a run does beside its work: signs of life for the guardian, looks at the
interlocks, the record's events.

May not know what the steps are.
"""

from __future__ import annotations

from collections.abc import Callable

from bench.record.writer import Store
from bench.rig.devices import Devices
from bench.run.progress import Progress
from bench.safety.bath_monitor import BathMonitor
from bench.safety.heartbeat import BRIEF_S, Heartbeat
from instruments.clock import stopwatch_s, wall_time

LOOK_S = 1.0
STEPPED_S = 5.0  # time servers nudge a clock by less
READ_S = 1.0  # both clocks are read within microseconds


class Attention:
    """Time passes through ``wait`` only, so that no wait goes by without a look at the interlocks
    every second.
    """

    def __init__(
        self,
        devices: Devices,
        store: Store,
        progress: Progress,
        pulse: Heartbeat,
        watch: BathMonitor,
    ) -> None:
        self._clock = devices.clock
        self._store = store
        self._pulse = pulse
        self._heard: Callable[[str, str], None] | None = None
        self._wall_behind_s: float | None = None
        self.check_interrupts: Callable[[], None] = lambda: None
        self.progress = progress
        self.watch = watch

    def now_s(self) -> float:
        """The bench's time."""
        return self._clock.now()

    def subscribe(self, heard: Callable[[str, str], None]) -> None:
        """From now on ``heard`` gets each event (its kind and text) once it is in the record."""
        self._heard = heard

    def wait(self, seconds: float) -> None:
        """Let time pass. Raises InterlockTrip."""
        end_s = self._clock.now() + seconds
        self.check()
        while (left_s := end_s - self._clock.now()) > 0.0:
            self._clock.sleep(min(LOOK_S, left_s))
            self.check()

    def check(self) -> None:
        """The bench lives; raises as ``look``."""
        self._pulse.sign("going on")
        self.look()

    def look(self) -> None:
        """Raises InterlockTrip where an interlock has tripped, and what ``heed`` raises: somebody's
        wish.

        No sign of life: for whoever waits for a person, and has said so.
        """
        self.watch.check()
        self.check_interrupts()

    def long(self, what: str, at_most_s: float, *, silent: bool = False) -> None:
        """``what`` may take ``at_most_s`` before the guardian takes the bench for hung: with signs
        of life, or where it must be in silence.

        Whatever waits on a clock or a link gives those signs; what computes, or is another's code,
        is ``silent``.
        """
        self._pulse.sign(what, at_most_s, silence_s=None if silent else BRIEF_S)

    def note(self, text: str) -> None:
        """Tell the operator, and the record."""
        self.progress.state(text)
        self.event("state", text)

    def event(self, kind: str, text: str) -> None:
        """A line in the record, with its time."""
        self._see_steps_of_the_clock()
        self._write(kind, text)

    def _write(self, kind: str, text: str) -> None:
        self._store.event(self._clock.now(), kind, text, wall_time())
        if self._heard:
            self._heard(kind, text)

    def _see_steps_of_the_clock(self) -> None:
        """Somebody may set the computer's clock amid a run. The bench's own time doesn't follow it,
        the record's wall times do.
        """
        before_s = stopwatch_s()
        behind_s = wall_time().timestamp() - before_s
        if stopwatch_s() - before_s > READ_S:
            return  # a busy computer let us wait between the two: they are of no one moment
        known_s, self._wall_behind_s = self._wall_behind_s, behind_s
        if known_s is not None and abs(behind_s - known_s) > STEPPED_S:
            by_s = behind_s - known_s
            self._write(
                "clock",
                f"the computer's clock was set {by_s:+.0f} s; wall times before and after don't"
                " compare, the bench's own do",
            )
