"""What somebody wants of a run under way: pause, go on, skip or repeat the trial in flight, end. By
a file in its folder, or typed.

`teatbench control RUN WORDS` writes the file, from any other terminal, over SSH, on Windows as
elsewhere; where no operator sits at the run's own terminal, the same words may be typed there.
Looked at wherever the bench looks at its interlocks. A pause takes effect before the next trial,
for a trial that stood around is none; the others at once, and the trial in flight leaves no trace.
Each wish is answered in a line, for whoever sits at the run's terminal may not be the one who has
it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.config import ConfigError
from bench.files import write_synced
from bench.run.context import RunContext
from bench.run.states import RunState
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip

FILE, TAKEN = "wish.txt", "wish-taken.txt"
REQUEST_POLL_S = 0.1
PAUSE_POLL_S = 1.0
REAL_S = 0.02  # of real time, for a second of virtual time
PAUSE, GO_ON, SKIP, REPEAT, ABORT = "pause", "go on", "skip", "repeat", "abort"
SHORT = {"p": PAUSE, "g": GO_ON, "go": GO_ON, "go-on": GO_ON, "s": SKIP, "r": REPEAT, "a": ABORT}
HELP = "pause, go on, skip REASON, repeat REASON, abort"


def read_wish(words: str) -> tuple[str, str]:
    """The wish and its reason. Raises ValueError for words that mean none, and for a skip or repeat
    without a reason.
    """
    text = " ".join(words.split())
    if (whole := SHORT.get(text.lower(), text.lower())) in (PAUSE, GO_ON, ABORT):
        return whole, ""
    first, _, reason = text.partition(" ")
    wish = SHORT.get(first.lower(), first.lower())
    if wish not in (SKIP, REPEAT):
        raise ValueError(f"not understood: {text!r}. There are: {HELP}")
    if not reason:
        raise ValueError(f"{wish} needs a reason, for the record: {wish} the plate was touched")
    return wish, reason


def leave_wish(folder: Path, words: str) -> None:
    """Leave a wish for the run in ``folder``. Raises ConfigError for words that mean none, or where
    it can't be written.
    """
    try:
        wish, reason = read_wish(words)
        write_synced(folder / FILE, f"{wish} {reason}\n".encode())
    except ValueError as error:
        raise ConfigError.plain(str(error)) from error
    except OSError as error:
        why = f"{folder / FILE} can't be written: {error.strerror or error}"
        raise ConfigError.plain(why) from error


def was_taken(folder: Path, clock: Clock, within_s: float) -> bool:
    """Whether the run in ``folder`` took what was left for it within ``within_s``."""
    until_s = clock.now() + within_s
    while (folder / FILE).exists():
        if clock.now() >= until_s:
            return False
        clock.sleep(REQUEST_POLL_S)
    return True


class Requests:
    """Those left in ``folder``, and those that ``typed`` gives as lines (None: nothing new)."""

    def __init__(
        self, folder: Path, typed: Callable[[], str | None], tell: Callable[[str], None]
    ) -> None:
        self._path, self._taken = folder / FILE, folder / TAKEN
        self._typed = typed
        self._tell = tell
        self.paused = False

    def forget(self) -> None:
        """What was left for a bench that died before it took it isn't this one's."""
        if words := self._left():
            told = "Nobody took this in the last session, and it counts no more"
            self._tell(f"{told}: {words.strip()}")

    def look(self) -> None:
        """Amid a trial; raises OperatorSkip, OperatorRepeat, OperatorAbort, or sets ``paused``."""
        self._look(amid=True)

    def look_between(self) -> None:
        """While no trial is in flight: there is none to skip or to repeat. Raises OperatorAbort."""
        self._look(amid=False)

    def pause_if_asked(self, ctx: RunContext) -> None:
        """Between two trials, until nobody wants a pause; the bath is watched meanwhile. Raises
        OperatorAbort, and what an interlock raises.
        """
        self.look_between()
        if not self.paused:
            return
        with ctx.states.during(RunState.PAUSED):
            how = f"teatbench control {ctx.store.folder} go on (or type: go on)"
            ctx.events.warn(f"Paused, as asked. To go on: {how}")
            while self.paused:
                ctx.events.state("paused, as asked")
                if isinstance(ctx.clock, VirtualClock):
                    # whoever pauses lives in real time: the bath need not race through days
                    RealClock().sleep(REAL_S)
                ctx.wait(PAUSE_POLL_S)

    def _look(self, *, amid: bool) -> None:
        for words in (self._left(), self._typed()):
            if words and words.strip():
                self._take(words, amid=amid)

    def _take(self, words: str, *, amid: bool) -> None:
        try:
            wish, reason = read_wish(words)
        except ValueError as error:
            self._tell(str(error))
            return
        if wish == ABORT:
            raise OperatorAbort("somebody told the run to end")
        if wish in (PAUSE, GO_ON):
            if wish == PAUSE and not self.paused:
                self._tell("The run pauses before its next trial.")
            self.paused = wish == PAUSE
        elif amid:
            self._tell(f"As told: {wish} {reason}")
            raise OperatorSkip(reason) if wish == SKIP else OperatorRepeat(reason)
        else:
            self._tell(f"No trial is in flight just now, so nothing is done about: {wish} {reason}")

    def _left(self) -> str | None:
        """Taken away first, then read: a wish that is left meanwhile is the next look's."""
        try:
            self._path.replace(self._taken)
            words = self._taken.read_text(encoding="utf-8", errors="replace")
            self._taken.unlink()
        # there is none, or it is just being written, on a system that locks files: the next look
        # finds it
        except OSError:
            return None
        return words
