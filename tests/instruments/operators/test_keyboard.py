"""Lines without waiting for them: from pipes, files and terminals here, and key by key as a Windows
console gives them.
"""

from __future__ import annotations

import io
import os
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.operators.console import Descriptor, Keys, Reader, keyboard_of

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="pipes and terminals of a POSIX system")


@POSIX
def test_a_pipe_gives_whole_lines_then_its_end_and_nothing_is_waited_for() -> None:
    reads, writes = os.pipe()
    with os.fdopen(reads, encoding="utf-8") as stream:
        keyboard = Descriptor(stream)
        assert keyboard.line() is None
        os.write(writes, "schö".encode()[:-1])
        assert keyboard.line() is None
        os.write(writes, "schö".encode()[-1:] + b"n\nnext\n")
        assert [keyboard.line(), keyboard.line(), keyboard.line()] == ["schön\n", "next\n", None]
        os.write(writes, b"one\nlast")
        os.close(writes)
        assert [keyboard.line() for _ in range(4)] == ["one\n", "last", "", ""]


@POSIX
def test_a_terminal_gives_whole_lines_and_its_end() -> None:
    import pty

    near, far = pty.openpty()
    with (
        os.fdopen(far, "r+b", buffering=0) as device,
        io.TextIOWrapper(device, encoding="utf-8") as stream,
    ):
        keyboard = keyboard_of(stream, print)
        os.write(near, b"\nabort\npart")
        assert [keyboard.line(), keyboard.line(), keyboard.line()] == ["\n", "abort\n", None]
        os.write(near, b"ial\n")
        assert keyboard.line() == "partial\n"
        os.close(near)
        assert keyboard.line() == ""


def test_a_stream_without_a_keyboard_is_read() -> None:
    keyboard = keyboard_of(io.StringIO("one\n"), print)
    assert isinstance(keyboard, Reader)
    assert [keyboard.line(), keyboard.line()] == ["one\n", ""]


class WindowsConsole:
    """What kbhit, getwch and putwch are there: keys pressed, and what the screen shows."""

    def __init__(self) -> None:
        self.pressed: list[str] = []
        self.screen = ""

    def keys(self) -> Keys:
        return Keys(lambda: bool(self.pressed), lambda: self.pressed.pop(0), self.show)

    def show(self, text: str) -> None:
        self.screen += text


def test_keys_of_a_windows_console() -> None:
    console = WindowsConsole()
    keys = console.keys()
    console.pressed += "s hose"
    assert keys.line() is None
    console.pressed += "\rab\b\x00;c\xe0H\r"
    assert [keys.line(), keys.line()] == ["s hose\n", "ac\n"]
    assert console.screen == "s hose\nab\b \bc\n"
    console.pressed.append("\x03")
    with pytest.raises(KeyboardInterrupt):
        keys.line()
    console.pressed.append("\x1a")
    assert keys.line() == ""


@given(typed=st.text(alphabet="ab1 \b\r", max_size=40))
def test_whatever_is_typed_lines_are_what_a_typewriter_with_backspace_gives(typed: str) -> None:
    expected, present = [], ""
    for char in typed:
        if char == "\r":
            expected.append(present + "\n")
            present = ""
        else:
            present = present[:-1] if char == "\b" else present + char
    console = WindowsConsole()
    keys = console.keys()
    console.pressed += typed
    assert list(iter(keys.line, None)) == expected
