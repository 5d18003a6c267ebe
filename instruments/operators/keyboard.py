"""Whole lines as a person types them, without waiting for them: so that something else may end a prompt before Enter does.

It may not know what the lines mean.
"""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable
from typing import Protocol, TextIO

CTRL_C, CTRL_Z, BACKSPACE, FUNCTION_KEYS = "\x03", "\x1a", "\b", "\x00\xe0"
CHUNK = 1024


class Keyboard(Protocol):
    """Where lines come from."""

    def line(self) -> str | None:
        """A line with its end, "" once nothing more can come, None while no whole line is there."""
        ...

    def typed_ahead(self) -> list[str]:
        """Takes and gives back the lines that a person typed before he was asked; none from a pipe, which can't know."""
        ...


class Reader:
    """A stream without a keyboard behind it: reading it waits for as long as it takes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def line(self) -> str | None:
        return self._stream.readline()

    def typed_ahead(self) -> list[str]:
        return []


class Descriptor:
    """A terminal or pipe of a POSIX system. What a terminal gives is whole lines: the system lets a person edit the present one."""

    def __init__(self, stream: TextIO) -> None:
        self._number = stream.fileno()
        self._terminal = stream.isatty()
        self._encoding = stream.encoding or "utf-8"
        self._bytes = b""
        self._ended = False

    def line(self) -> str | None:
        while b"\n" not in self._bytes and not self._ended:
            if not select.select([self._number], [], [], 0.0)[0]:
                return None
            try:
                got = os.read(self._number, CHUNK)
            except OSError:  # EIO: the terminal has gone
                got = b""
            self._bytes += got
            self._ended = not got
        line, end, self._bytes = self._bytes.partition(b"\n")
        return (line + end).decode(self._encoding, errors="replace")

    def typed_ahead(self) -> list[str]:
        lines: list[str] = []
        while self._terminal and not self._ended and (line := self.line()):
            lines.append(line)
        return lines


class Keys:
    """A Windows console, key by key: there is no other way to look at its input without waiting for Enter.

    ``pressed`` says whether a key waits, ``key`` takes it, ``echo`` shows it (kbhit and getwch of msvcrt).
    """

    def __init__(self, pressed: Callable[[], bool], key: Callable[[], str], echo: Callable[[str], object]) -> None:
        self._pressed = pressed
        self._key = key
        self._echo = echo
        self._typed = ""

    def line(self) -> str | None:
        while self._pressed():
            char = self._key()
            if char in "\r\n":
                line, self._typed = self._typed + "\n", ""
                self._echo("\n")
                return line
            if char == CTRL_C:
                raise KeyboardInterrupt
            if char == CTRL_Z and not self._typed:
                return ""
            self._edit(char)
        return None

    def typed_ahead(self) -> list[str]:
        lines: list[str] = []
        while line := self.line():
            lines.append(line)
        self._typed = ""
        return lines

    def _edit(self, char: str) -> None:
        if char in FUNCTION_KEYS:
            self._key()  # which one, as a second character
        elif char == BACKSPACE and self._typed:
            self._typed = self._typed[:-1]
            self._echo("\b \b")
        elif char.isprintable():
            self._typed += char
            self._echo(char)


def keyboard_of(stream: TextIO, echo: Callable[[str], object]) -> Keyboard:
    """The keyboard behind ``stream``; ``echo`` shows what is typed where the system doesn't."""
    try:
        stream.fileno()
    except (io.UnsupportedOperation, AttributeError):  # AttributeError: a program without a console has None for its streams
        return Reader(stream)
    if sys.platform == "win32":
        import msvcrt

        return Keys(msvcrt.kbhit, msvcrt.getwch, echo) if stream.isatty() else Reader(stream)
    return Descriptor(stream)
