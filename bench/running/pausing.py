"""A pause that somebody asked for: between two trials, until somebody says to go on. The bath is watched meanwhile, and may end it."""

from __future__ import annotations

from pathlib import Path

from bench.running.attention import Attention
from bench.running.run_state import RunState, RunStates
from bench.running.wishes import Wishes
from instruments.clock import Clock, RealClock, VirtualClock

LOOK_S = 1.0
REAL_S = 0.02  # of real time, for a second of virtual time


class Pause:
    """Pauses as ``wishes`` say; ``folder`` is the run's, as whoever asked for it has to name it to go on."""

    def __init__(self, wishes: Wishes, states: RunStates, attention: Attention, clock: Clock, folder: Path) -> None:
        self._wishes = wishes
        self._states = states
        self._attention = attention
        self._virtual = isinstance(clock, VirtualClock)
        self._real = RealClock()
        self._folder = folder

    def if_asked(self) -> None:
        """Returns once nobody wants a pause. Raises OperatorAbort, and what an interlock raises."""
        self._wishes.look_between()
        if not self._wishes.paused:
            return
        with self._states.during(RunState.PAUSED):
            self._attention.progress.warn(f"Paused, as asked. To go on: teatbench tell {self._folder} go on (or type: go on)")
            while self._wishes.paused:
                self._attention.progress.state("paused, as asked")
                if self._virtual:
                    self._real.sleep(REAL_S)  # whoever pauses lives in real time, and the bath need not race through days meanwhile
                self._attention.wait(LOOK_S)
