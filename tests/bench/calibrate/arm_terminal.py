"""A command at a pseudo-terminal: read what it says, type an answer."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pyte
import pytest

from tests.bench.forked import Running, begin
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S

COLUMNS, ROWS = 200, 24


class Rendered:
    """What a terminal of ``columns`` by ``ROWS`` shows after all that was written to it."""

    def __init__(self, columns: int) -> None:
        self._screen = pyte.HistoryScreen(columns, ROWS, history=10_000)
        self._stream = pyte.ByteStream(self._screen)

    def feed(self, data: bytes) -> None:
        """The terminal gets ``data``."""
        self._stream.feed(data)

    @property
    def rows(self) -> list[str]:
        """All rows from the first, with what has scrolled away, each as wide as the terminal."""
        across = range(self._screen.columns)
        return [
            "".join(row[x].data for x in across) for row in self._screen.history.top
        ] + self._screen.display

    @property
    def text(self) -> str:
        """The rows without their ends: what wrapped at the edge stands there in one piece."""
        return "".join(self.rows)


class Terminal:
    """The person's side: ``text`` is all that it said, ``screen`` what of it is to be seen."""

    def __init__(self, child: Running, fd: int, columns: int) -> None:
        self._child = child
        self._fd = fd
        self._at = 0
        self.text = ""
        self.screen = Rendered(columns)

    def expect(self, words: str) -> str:
        """Wait until it says ``words``; gives back what came up to their end."""
        deadline = time.monotonic() + PATIENCE_S
        while words not in self.text[self._at :]:
            assert time.monotonic() < deadline, f"waited for {words!r}; it said:\n{self.text}"
            assert self._more(), f"it ended before it said {words!r}:\n{self.text}"
        start, self._at = self._at, self.text.index(words, self._at) + len(words)
        return self.text[start : self._at]

    def type(self, line: str) -> None:
        """Type ``line`` and Enter."""
        os.write(self._fd, f"{line}\n".encode())

    def press(self, key: str) -> None:
        """Press one key, and no Enter."""
        os.write(self._fd, key.encode())

    def hang_up(self) -> int:
        """Close the terminal; gives back the command's exit code."""
        os.close(self._fd)
        self._fd = -1
        return self._child.wait(timeout=PATIENCE_S)

    def close(self) -> None:
        """The terminal is no longer needed."""
        if self._fd >= 0:
            os.close(self._fd)

    def code(self) -> int:
        """Read to its end; gives back its exit code."""
        deadline = time.monotonic() + PATIENCE_S
        while self._more():
            assert time.monotonic() < deadline, f"it doesn't end; it said:\n{self.text}"
        return self._child.wait(timeout=PATIENCE_S)

    def press_enter_to_the_end(self, *, unasked: bool = False) -> int:
        """Press Enter at each prompt until it has ended; gives back the exit code."""
        while self._more():
            if unasked or "a = abort" in self.text[self._at :]:
                self._at = len(self.text)
                with suppress(OSError):  # it has ended meanwhile
                    self.type("")
        return self.code()

    def _more(self) -> bool:
        if not select.select([self._fd], [], [], 0.2)[0]:
            return self._child.poll() is None
        try:
            data = os.read(self._fd, 65536)
        except OSError:  # Linux says so when the other side has closed
            return False
        self.screen.feed(data)
        self.text += data.decode("utf-8", errors="replace").replace("\r\n", "\n")
        return bool(data)


@contextmanager
def at_terminal(
    arguments: Sequence[str], columns: int = COLUMNS, cwd: Path = ROOT
) -> Iterator[Terminal]:
    """``teatbench`` at a terminal of its own, which Ctrl-C and hanging up work on."""
    if sys.platform == "win32":
        pytest.skip("needs a pseudo-terminal, which Windows has not")
    import pty
    import termios

    near, far = pty.openpty()
    termios.tcsetwinsize(far, (ROWS, columns))
    environment = {**os.environ, "TERM": "xterm", "NO_COLOR": "1"}
    for of_another in ("COLUMNS", "LINES"):
        environment.pop(of_another, None)
    ends = {"stdin": far, "stdout": far, "stderr": far}
    child = begin(arguments, **ends, cwd=cwd, environment=environment, terminal=True)
    os.close(far)
    terminal = Terminal(child, near, columns)
    try:
        yield terminal
    finally:
        if child.poll() is None:
            child.kill()
        child.wait(timeout=PATIENCE_S)
        terminal.close()


def answer(terminal: Terminal, words: str, line: str = "") -> None:
    """Wait for a prompt that says ``words``, then type ``line``."""
    terminal.expect(words)
    terminal.expect("a = abort")
    terminal.type(line)
