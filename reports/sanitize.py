"""The one filter for text that others wrote, wherever it leaves: terminal, HTML, SVG, XML, CSV.

Control characters (escape sequences, bidirectional overrides) become U+FFFD; the record keeps what
was written.
"""

from __future__ import annotations

import csv
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TextIO, cast

REPLACED = "\N{REPLACEMENT CHARACTER}"
# Controls but tab and line end (C0, DEL, C1), Unicode's Bidi_Control and line separators, invisible
# operators and tags, surrogates, and what is no character (Unicode 15, section 23; XML 1.0, 2.2).
_UNSAFE = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    r"\ud800-\udfff\ufdd0-\ufdef\ufffe\uffff\U000e0000-\U000e007f]|\r(?!\n)"
)
_DEGREES = re.compile(r"(?<=\d )degC\b")
# what a spreadsheet takes for the beginning of one (OWASP, CSV Injection)
_FORMULA = tuple("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")
# the program's own, to write over a line and to rub out a letter: as a whole write, never within
# one
_OWN = ("\r", "\b \b")


def sanitized(text: str) -> str:
    """``text`` as it may be shown anywhere; lines and tabs stay."""
    return _UNSAFE.sub(REPLACED, text)


def page_text(text: str) -> str:
    """``text``, sanitized; values in °C, where messages have degC, which any terminal can show."""
    return _DEGREES.sub("°C", sanitized(text))


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV; text that a spreadsheet would take for a formula gets an apostrophe."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return value
    text = sanitized(value)
    return f"'{text}" if text.lstrip(" ").startswith(_FORMULA) and not _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class SanitizedStream:
    """``stream`` with all text sanitized; write control sequences to ``stream`` itself. Where its
    reader has gone (`| head`) that is a BrokenPipeError, or with ``goes_on`` no error; an OSError
    of a file on a full disk names ``stream``.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream, self.goes_on = stream, False

    def write(self, text: str) -> int:
        """Write ``text`` without what it may not hold."""
        with self._watched():
            self.stream.write(text if text in _OWN else sanitized(text))
        return len(text)

    def flush(self) -> None:
        """As of the stream."""
        with self._watched():
            self.stream.flush()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            self.lose_reader()
        except OSError as error:
            name = str(getattr(self.stream, "name", "output")).strip("<>")
            error.filename = error.filename or name
            raise

    def lose_reader(self) -> None:
        """Amid a BrokenPipeError: what is still written goes nowhere, or the error is raised."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())
        if not self.goes_on:
            raise BrokenPipeError

    def close(self) -> None:
        """As `flush`: what a program goes on to say needs its streams to the end."""
        self.flush()

    def writelines(self, lines: Iterable[str]) -> None:
        """As `write`, each."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


def sanitizing(stream: TextIO) -> TextIO:
    """``stream`` as a SanitizedStream. A program without a console has None for it."""
    return (
        stream
        if stream is None or isinstance(stream, SanitizedStream)
        else cast(TextIO, SanitizedStream(stream))
    )


def keep_writing(stdout: bool) -> None:
    """Who reads stderr, and with ``stdout`` that too, may go without an error."""
    for stream, goes_on in ((sys.stdout, stdout), (sys.stderr, True)):
        if isinstance(stream, SanitizedStream):
            stream.goes_on = goes_on


def unfiltered(stream: TextIO) -> TextIO:
    """What is below a SanitizedStream."""
    return stream.stream if isinstance(stream, SanitizedStream) else stream
