"""Who shows what goes on. Showing may fail, as on a terminal that has gone; it has no say in what the bench does."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class Progress(Protocol):
    """A terminal, or whatever a person looks at. May be called from any thread."""

    def state(self, text: str) -> None:
        """What is being done or waited for."""
        ...

    def trial(self, done: int, total: int, name: str) -> None:
        """``done`` of ``total`` trials are finished; ``name`` is next."""
        ...

    def warn(self, text: str) -> None:
        """What a person has to see at once, and do something about."""
        ...

    def aside(self) -> AbstractContextManager[None]:
        """While this lasts nothing moves on the screen: somebody is asked something there."""
        ...


class Unfailing:
    """Shows on ``progress`` until that fails for the first time; from then on in silence."""

    def __init__(self, progress: Progress) -> None:
        self._progress: Progress | None = progress

    def state(self, text: str) -> None:
        if self._progress:
            try:
                self._progress.state(text)
            except Exception:  # whoever only watches ends no run, whatever went wrong with him
                self._progress = None

    def trial(self, done: int, total: int, name: str) -> None:
        if self._progress:
            try:
                self._progress.trial(done, total, name)
            except Exception:
                self._progress = None

    def aside(self) -> AbstractContextManager[None]:
        return self._progress.aside() if self._progress else nullcontext()

    def warn(self, text: str) -> None:
        if self._progress:
            try:
                self._progress.warn(text)
            except Exception:
                self._progress = None
