"""Lines without waiting for them: from pipes, files and terminals here, and key by key as a Windows
console gives them.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.operators.console import Descriptor, Keyboard, Keys, Reader, keyboard_of

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="pipes and terminals of a POSIX system")


@pytest.fixture
def pipe() -> Iterator[tuple[Keyboard, int]]:
    reads, writes = os.pipe()
    with os.fdopen(reads, encoding="utf-8") as stream:
        yield Descriptor(stream), writes


@POSIX
class TestPipe:
    def test_nothing_is_waited_for_and_no_part_of_a_line_is_taken_for_one(
        self, pipe: tuple[Keyboard, int]
    ) -> None:
        keyboard, writes = pipe
        assert keyboard.line() is None
        os.write(writes, "schö".encode()[:-1])
        assert keyboard.line() is None
        os.write(writes, "schö".encode()[-1:] + b"n\nnext\n")
        assert [keyboard.line(), keyboard.line(), keyboard.line()] == ["schön\n", "next\n", None]
        os.close(writes)

    def test_its_end_is_told_after_its_last_line(self, pipe: tuple[Keyboard, int]) -> None:
        keyboard, writes = pipe
        os.write(writes, b"one\nlast")
        os.close(writes)
        assert [keyboard.line() for _ in range(4)] == ["one\n", "last", "", ""]

    def test_nobody_can_tell_what_came_too_early(self, pipe: tuple[Keyboard, int]) -> None:
        keyboard, writes = pipe
        os.write(writes, b"early\n")
        os.close(writes)
        assert keyboard.typed_ahead() == []
        assert keyboard.line() == "early\n"


@POSIX
def test_a_terminal_gives_up_what_was_typed_too_early() -> None:
    import pty

    near, far = pty.openpty()
    with (
        os.fdopen(far, "r+b", buffering=0) as device,
        io.TextIOWrapper(device, encoding="utf-8") as stream,
    ):
        keyboard = keyboard_of(stream, print)
        os.write(near, b"\nabort\npart")
        assert keyboard.typed_ahead() == ["\n", "abort\n"]
        assert keyboard.line() is None
        os.write(near, b"ial\n")
        assert keyboard.line() == "partial\n"
        os.close(near)
        assert keyboard.line() == ""
        assert keyboard.typed_ahead() == []


def test_a_stream_without_a_keyboard_is_read() -> None:
    keyboard = keyboard_of(io.StringIO("one\n"), print)
    assert isinstance(keyboard, Reader)
    assert [keyboard.line(), keyboard.line(), keyboard.typed_ahead()] == ["one\n", "", []]


class WindowsConsole:
    """What kbhit, getwch and putwch are there: keys that were
    pressed, and what the screen shows.
    """

    def __init__(self) -> None:
        self.pressed: list[str] = []
        self.screen = ""

    def keys(self) -> Keys:
        return Keys(lambda: bool(self.pressed), lambda: self.pressed.pop(0), self.show)

    def show(self, text: str) -> None:
        self.screen += text


class TestWindows:
    def test_a_line_is_one_with_enter_and_is_shown_while_it_is_typed(self) -> None:
        console = WindowsConsole()
        keys = console.keys()
        console.pressed += "s hose"
        assert keys.line() is None
        assert console.screen == "s hose"
        console.pressed += "\ra"
        assert keys.line() == "s hose\n"
        assert keys.line() is None
        assert console.screen == "s hose\na"

    def test_backspace_takes_back_and_function_keys_are_two_codes_that_mean_nothing(self) -> None:
        console = WindowsConsole()
        console.pressed += "\bab\b\x00;c\xe0H\r"
        assert console.keys().line() == "ac\n"
        assert console.screen == "ab\b \bc\n"

    def test_ctrl_c_and_ctrl_z(self) -> None:
        console = WindowsConsole()
        keys = console.keys()
        console.pressed.append("\x03")
        with pytest.raises(KeyboardInterrupt):
            keys.line()
        console.pressed.append("\x1a")
        assert keys.line() == ""

    def test_what_was_typed_too_early_is_given_up(self) -> None:
        console = WindowsConsole()
        keys = console.keys()
        console.pressed += "\rabort\rhal"
        assert keys.typed_ahead() == ["\n", "abort\n"]
        console.pressed += "2\r"
        assert keys.line() == "2\n"


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
