"""Who shows what goes on. Showing may fail, as on a terminal that has gone; it has no say in what the bench does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

FAILURES = (Exception, SystemExit)  # rich ends the program where the reader of its output has gone (`| head`)


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
    """Shows on ``progress``; from its first failure on only what a person has to see at once is still tried there.

    ``told`` hears of that failure, once.
    """

    def __init__(self, progress: Progress, told: Callable[[str], None] = lambda _: None) -> None:
        self._progress = progress
        self._told = told
        self._failed = False

    def state(self, text: str) -> None:
        if not self._failed:
            self._tried(lambda: self._progress.state(text))

    def trial(self, done: int, total: int, name: str) -> None:
        if not self._failed:
            self._tried(lambda: self._progress.trial(done, total, name))

    def warn(self, text: str) -> None:
        self._tried(lambda: self._progress.warn(text))

    @contextmanager
    def aside(self) -> Iterator[None]:
        around = self._progress.aside()
        entered = self._tried(around.__enter__)
        try:
            yield
        finally:
            if entered:
                self._tried(lambda: around.__exit__(None, None, None))

    def _tried(self, show: Callable[[], object]) -> bool:
        """Whoever only watches ends no run, whatever went wrong with him."""
        try:
            show()
        except FAILURES as error:
            first, self._failed = not self._failed, True
            if first:
                self._told(f"the screen shows nothing any more: {type(error).__name__}: {error}")
            return False
        return True
