"""A command at a pseudo-terminal, driven as a person drives it: read what it says, type an answer."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

from tests.conftest import ROOT

PATIENCE_S = 60.0
ENTER = "Enter"
OWN_TERMINAL = "import fcntl, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); from bench.cli import main; sys.exit(main())"


class Terminal:
    """The person's side of a running command. ``text`` is all that it has said."""

    def __init__(self, child: subprocess.Popen[bytes], fd: int) -> None:
        self._child = child
        self._fd = fd
        self._at = 0
        self.text = ""

    def expect(self, words: str) -> str:
        """Wait until it says ``words``, after what was expected before; gives back what came up to their end."""
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

    def _more(self) -> bool:
        if not select.select([self._fd], [], [], 0.2)[0]:
            return self._child.poll() is None
        try:
            data = os.read(self._fd, 65536)
        except OSError:  # Linux says so when the other side has closed
            return False
        self.text += data.decode("utf-8", errors="replace").replace("\r\n", "\n")
        return bool(data)


@contextmanager
def at_terminal(arguments: Sequence[str]) -> Iterator[Terminal]:
    """``teatbench`` with ``arguments`` at a terminal of its own, which Ctrl-C and hanging up work on; skipped where there are none."""
    if sys.platform == "win32":
        pytest.skip("needs a pseudo-terminal, which Windows has not")
    import pty

    near, far = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"}
    command = [sys.executable, "-c", OWN_TERMINAL, *arguments]
    child = subprocess.Popen(command, stdin=far, stdout=far, stderr=far, env=environment, cwd=ROOT, start_new_session=True)
    os.close(far)
    terminal = Terminal(child, near)
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
    terminal.expect("(a = abort")
    terminal.type(line)
