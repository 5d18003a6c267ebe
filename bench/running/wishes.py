"""What somebody wants of a run under way: pause, go on, skip or repeat the trial in flight, end. By a file in its folder, or typed.

`teatbench tell RUN WORDS` writes the file, from any other terminal, over SSH, on Windows as elsewhere; where no operator sits at the
run's own terminal, the same words may be typed there. Looked at wherever the bench looks at its interlocks. A pause takes effect before
the next trial, for a trial that stood around is none; the others at once, and the trial in flight leaves no trace.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.config import ConfigError
from bench.store import write_synced
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip

FILE = "wish.txt"
PAUSE, GO_ON, SKIP, REPEAT, ABORT = "pause", "go on", "skip", "repeat", "abort"
SHORT = {"p": PAUSE, "g": GO_ON, "go": GO_ON, "go-on": GO_ON, "s": SKIP, "r": REPEAT, "a": ABORT}
HELP = "pause, go on, skip REASON, repeat REASON, abort"


def read_wish(words: str) -> tuple[str, str]:
    """The wish and its reason. Raises ValueError for words that mean none, and for a skip or repeat without a reason."""
    text = " ".join(words.split())
    for wish in (PAUSE, GO_ON, ABORT):
        if text.lower() in (wish, *(short for short, meant in SHORT.items() if meant == wish)):
            return wish, ""
    first, _, reason = text.partition(" ")
    wish = SHORT.get(first.lower(), first.lower())
    if wish not in (SKIP, REPEAT):
        raise ValueError(f"not understood: {text!r}. There are: {HELP}")
    if not reason:
        raise ValueError(f"{wish} needs a reason, for the record: {wish} the plate was touched")
    return wish, reason


def leave_wish(folder: Path, words: str) -> None:
    """Leave a wish for the run in ``folder``. Raises ConfigError for words that mean none, or where it can't be written."""
    try:
        wish, reason = read_wish(words)
        write_synced(folder / FILE, f"{wish} {reason}\n".encode())
    except ValueError as error:
        raise ConfigError.plain(str(error)) from error
    except OSError as error:
        raise ConfigError.plain(f"{folder / FILE} can't be written: {error.strerror or error}") from error


class Wishes:
    """Those left in ``folder``, and those that ``typed`` gives as lines (None: nothing new)."""

    def __init__(self, folder: Path, typed: Callable[[], str | None], tell: Callable[[str], None]) -> None:
        self._path = folder / FILE
        self._typed = typed
        self._tell = tell
        self.paused = False

    def look(self) -> None:
        """Raises OperatorSkip, OperatorRepeat and OperatorAbort; a pause is noted in ``paused``."""
        for words in (self._left(), self._typed()):
            if words and words.strip():
                self._take(words)

    def _take(self, words: str) -> None:
        try:
            wish, reason = read_wish(words)
        except ValueError as error:
            self._tell(str(error))
            return
        if wish == SKIP:
            raise OperatorSkip(reason)
        if wish == REPEAT:
            raise OperatorRepeat(reason)
        if wish == ABORT:
            raise OperatorAbort("somebody told the run to end")
        self.paused = wish == PAUSE

    def _left(self) -> str | None:
        if not self._path.exists():
            return None
        try:
            words = self._path.read_text(encoding="utf-8", errors="replace")
            self._path.unlink()
        except OSError:  # it is just being written, on a system that locks files: the next look finds it
            return None
        return words
