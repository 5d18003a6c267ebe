"""A person at a terminal: reads instructions, answers with Enter, a word or a pedal. With a
`Mailbox` a person at a browser may answer as well; the first answer is taken.

What a prompt's ``check`` raises, as an interlock's trip, ends the prompt at once, so lines are read
without blocking.
"""

from __future__ import annotations

import contextlib
import io
import os
import select
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TextIO

from instruments.clock import Clock
from instruments.operators import operator as op
from instruments.operators.mailbox import BENCH, TERMINAL, Mailbox
from instruments.operators.prompted import PromptedOperator
from textfiles.text import wrapped

CTRL_C, CTRL_Z, BACKSPACE, FUNCTION_KEYS = "\x03", "\x1a", "\b", "\x00\xe0"
CHUNK = 1024


class Reader:
    """A stream without a keyboard behind it, which is read with blocking."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def line(self) -> str | None:
        """A line with its end, "" once nothing more can come, None while no whole line is there."""
        return self._stream.readline()


class Descriptor:
    """A POSIX terminal or pipe. A terminal gives whole lines, editable until Enter."""

    def __init__(self, stream: TextIO) -> None:
        self._number = stream.fileno()
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


class Keys:
    """A Windows console, read key by key (msvcrt): a read of a line would block until Enter."""

    def __init__(
        self, pressed: Callable[[], bool], key: Callable[[], str], echo: Callable[[str], object]
    ) -> None:
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
            if char in FUNCTION_KEYS:
                self._key()  # which one, as a second character
            elif char == BACKSPACE and self._typed:
                self._typed = self._typed[:-1]
                self._echo("\b \b")
            elif char.isprintable():
                self._typed += char
                self._echo(char)
        return None


Keyboard = Reader | Descriptor | Keys


def keyboard_of(stream: TextIO, echo: Callable[[str], object]) -> Keyboard:
    """The keyboard behind ``stream``; ``echo`` shows what is typed where the system doesn't."""
    try:
        stream.fileno()
    # AttributeError: a program without a console has None for its streams
    except (io.UnsupportedOperation, AttributeError):
        return Reader(stream)
    if sys.platform == "win32":
        import msvcrt

        return Keys(msvcrt.kbhit, msvcrt.getwch, echo) if stream.isatty() else Reader(stream)
    return Descriptor(stream)


TURN_S = 0.05  # between two looks at keyboard and interlocks
REMIND_S = 120.0
GONE = "the terminal gives no more input"
WHY = "Why? (a few words for the record; Enter alone: don't skip): "
REQUESTS = (op.OperatorAbort, op.OperatorSkip, op.OperatorRepeat, op.OperatorEnough)

Pedal = Callable[[float], bool]


class Console(PromptedOperator):
    """Prompts on ``out``, answers from ``answers``, whose end is an abort, or from a browser by
    ``mailbox``. ``watch`` gives a function that waits for a pedal; ``screen`` is entered around
    each prompt.
    """

    def __init__(
        self,
        answers: TextIO,
        out: TextIO,
        clock: Clock,
        *,
        watch: Callable[[], Pedal] | None = None,
        screen: Callable[[], AbstractContextManager[None]] = nullcontext,
        remind_s: float = REMIND_S,
        mailbox: Mailbox | None = None,
    ) -> None:
        self._out = out
        self._clock = clock
        self._screen = screen
        self._remind_s = remind_s
        self._mailbox = mailbox
        self._terminal = answers is not None and answers.isatty()
        self._keyboard = keyboard_of(answers, self._write)
        self._listening = self._terminal or mailbox is None
        self.watch_pedals(watch)

    def asked_in(self, folder: Path) -> None:
        """From now on a browser is asked in the folder of another run, where one is asked."""
        if self._mailbox:
            self._mailbox = Mailbox(folder)

    def watch_pedals(self, watch: Callable[[], Pedal] | None) -> None:
        """From now on a pedal is as good as Enter where a touch is asked for."""
        self._watch = watch if self._terminal or self._mailbox else None

    def say(self, text: str) -> None:
        """Show ``text``. Raises OperatorAbort where the terminal has gone."""
        with self._screen():
            self._write(wrapped(f"{text}\n", self._out))

    def answer(self, prompt: op.Prompt, check: Callable[[], None]) -> str:
        """As the base, and what the pedals raise."""
        with self._screen():
            # Enter pressed twice must not answer the next question, but no abort is lost
            while self._terminal and (line := self._keyboard.line()):
                if line.strip().lower() in op.ABORT:
                    raise prompt.aborted
            first = "" if prompt.press else "\n"
            self._write(wrapped(f"{first}{prompt.head}{prompt.text}\n", self._out))
            if self._mailbox:
                self._mailbox.open(prompt)
            try:
                words = self._words(prompt, check)
            except (Exception, KeyboardInterrupt) as why:  # ended without an answer
                ended = str(why) or "interrupted"
                if not isinstance(why, REQUESTS):
                    with contextlib.suppress(op.OperatorAbort):
                        # all of it is said where it is handled
                        what = ended.partition(" (")[0].partition(". ")[0]
                        self._write(wrapped(f"\nNo answer is needed any more: {what}\n", self._out))
                if self._mailbox:
                    self._mailbox.close(ended, BENCH)
                raise
            # The words that hold: a browser's where those came first
            if not self._mailbox:
                return words
            given = self._mailbox.close(words.strip(), TERMINAL)
            if given.by != TERMINAL:
                self._write(f"Answered by {given.by}: {given.words or 'go'}\n")
            return given.words

    def _words(self, prompt: op.Prompt, check: Callable[[], None]) -> str:
        """Words that ``prompt`` understands."""
        keys, key = prompt.keys(pedal=self._watch is not None), ""
        while True:
            words, key = key or self._line(keys, check, pedal=prompt.pedal), ""
            if words.strip() == op.EXPLAIN:
                self._write(wrapped(f"{prompt.explained()}\n", self._out))
                continue
            try:
                op.understood(words, prompt)
            except op.NotUnderstoodError as error:
                self._write(wrapped(f"{error}\n", self._out))
            except op.OperatorSkip as skip:
                if skip.reason:
                    return words
                reason = self._line(WHY, check).strip()
                if self._mailbox and (given := self._mailbox.answer()):
                    return given.words
                key = reason  # a key does what it does at the question
                if reason and reason.lower() not in op.KEYS:
                    key = f"skip {reason}"
            except REQUESTS:
                return words
            else:
                return words

    def _line(self, question: str, check: Callable[[], None], *, pedal: bool = False) -> str:
        """A line from terminal or browser, or an empty one for a pedal; reminds at intervals."""
        asked_s, question = self._clock.now(), wrapped(question, self._out)
        self._write(question)
        pressed = self._watch() if pedal and self._watch else None
        remind_s = asked_s + self._remind_s
        while (line := self._typed()) is None:
            check()
            if pressed is None:
                self._clock.sleep(TURN_S)
            elif pressed(TURN_S):
                self._write("\n")
                return "\n"
            if self._clock.now() >= remind_s:
                remind_s += self._remind_s
                waited = f"Still waiting for you, {self._clock.now() - asked_s:.0f} s so far"
                patience = wrapped(f"{waited}; nothing is lost by taking longer.", self._out)
                self._write(f"\n{patience}\n{question}")
        if not self._terminal:  # no Enter has ended the question's row
            self._write("\n")
        check()  # an answer that came too late is none
        if not line:
            raise op.OperatorAbort(GONE)
        return line

    def _typed(self) -> str | None:
        """A line of the terminal or the words of a browser; None while there is neither."""
        if self._mailbox and (given := self._mailbox.answer()):
            return given.words + "\n"
        line = self._keyboard.line() if self._listening else None
        if line == "" and self._mailbox:  # the browser's answers are enough
            self._listening = False
            return None
        return line

    def _write(self, text: str) -> None:
        try:
            self._out.write(text)
            self._out.flush()
        except (OSError, ValueError) as error:  # ValueError: the stream has been closed
            if self._mailbox:
                return
            raise op.OperatorAbort(f"{GONE} ({error})") from error
