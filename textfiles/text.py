"""Bytes to text as editors, spreadsheets and PowerShell save it: UTF-8 or UTF-16, with or without a
byte-order mark, lines ended by LF, CRLF or CR; and words in a message about what was written.
"""

from __future__ import annotations

import codecs
import difflib
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

MOST_BYTES = 32 * 1024 * 1024  # no file that a person writes is as long
MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),  # before UTF-16's, with which it begins
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (codecs.BOM_UTF8, "utf-8-sig"),
)
UNMARKED = {(0, 1): "utf-16-be", (1, 0): "utf-16-le"}  # zero bytes of a text's first two


class TextError(ValueError):
    """Bytes that are no text, or text that can't be read; the message is a sentence's end."""


def decoded(data: bytes, *, growing: bool = False) -> str:
    """The text with LF; of a ``growing`` file without a character cut off. Raises TextError."""
    if len(data) > MOST_BYTES:
        raise TextError(f"has {len(data)} bytes, more than the {MOST_BYTES} that are read")
    encoding = next((name for mark, name in MARKS if data.startswith(mark)), None)
    encoding = encoding or UNMARKED.get(tuple(map(bool, data[:2])), "utf-8")  # type: ignore[arg-type]
    try:
        text = data.decode(encoding, errors="replace" if growing else "strict")
    except UnicodeDecodeError as error:
        seen = f"byte {error.start} is {error.object[error.start]:#04x}"
        raise TextError(f"is not {error.encoding.upper()} text: {seen}. Save it as UTF-8") from None
    if "\0" in text:
        raise TextError("holds zero bytes, so it is no text. Save it as UTF-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def text_of(path: Path) -> str:
    """The text of a file. Raises TextError, OSError."""
    with path.open("rb") as file:
        return decoded(file.read(MOST_BYTES + 1))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``; did you mean "x"?`` when one of ``known`` is near, else the empty string."""
    there = list(known)
    begun = [one for one in there if one.startswith(word)] if word else []
    near = near_words(word, there) or begun
    return f'; did you mean "{near[0]}"?' if near else ""


def near_words(word: str, known: Iterable[str]) -> list[str]:
    """Those of ``known`` that ``word`` may be a slip of, the nearest first: one that begins with
    another letter, and doesn't hold the word, has to have more in common.
    """
    there = list(known)
    near, nearer = (
        difflib.get_close_matches(word, there, n=max(len(there), 1), cutoff=share)
        for share in (0.6, 0.75)
    )
    return [one for one in near if one in nearer or one[:1] == word[:1] or word in one]


def plural(n: int, thing: str, verb: str = "") -> str:
    """``1 pose``, ``59 poses``, ``2 tries``; with a verb ``1 pose was``, ``59 poses were``."""
    if n != 1:
        thing = f"{thing[:-1]}ie" if thing.endswith("ry") else thing
        thing += "es" if thing.endswith("ch") else "s"
        verb = {"has": "have", "is": "are", "was": "were"}.get(verb, verb)
    return f"{n} {thing} {verb}".rstrip()


def range_text(first: object, last: object, form: str = "") -> str:
    """``2 to 5``; ``5`` where both are it."""
    return " to ".join(dict.fromkeys((format(first, form), format(last, form))))


def words_of(error: object) -> str:
    """What it says of itself; nothing where that fails, as of an error of another's code."""
    try:
        return str(error)
    except Exception:
        return ""


def shown(value: object) -> str:
    """As Python writes it; its kind where that fails, as of a value of another's code."""
    try:
        return repr(value)
    except Exception:
        return f"<{type(value).__name__}>"


def named(error: object) -> str:
    """Its kind and words."""
    return f"{type(error).__name__}: {words_of(error)}".removesuffix(": ")


def full_stop(text: str) -> str:
    """``text`` as a sentence's end."""
    return text if text.endswith((".", "?", "!")) else f"{text}."


def capital(text: str) -> str:
    """``text`` with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """``text`` with a capital letter at its beginning and a full stop."""
    return capital(full_stop(text))


def in_command(path: object) -> str:
    """As one word of a command: in quotes where it needs them, at POSIX shells and Windows's."""
    text = str(path)
    if re.fullmatch(r"[\w@%+=:,./~-]+" if os.name != "nt" else r"[\w@%+=:,./~\\-]+", text):
        return text
    return shlex.quote(text) if set(text) & set('"$`\\!') and os.name != "nt" else f'"{text}"'


def one_command(words: Iterable[str]) -> str:
    """``words`` as a line that a shell of this system takes apart again."""
    if sys.platform == "win32":
        from subprocess import list2cmdline

        return list2cmdline(words)
    return shlex.join(words)


def short(text: str, most: int = 60) -> str:
    """``text`` for a message: cut to ``most`` characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def time_text(seconds: float) -> str:
    """``40 s``, ``12 min``, ``64.5 h``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


LEAST_COLUMNS = 20  # a pseudo-terminal without a size has 0


def wrapped(text: str, out: TextIO) -> str:
    """``text`` broken between words where the terminal ``out`` ends; as it is for any other."""
    columns = 0
    with suppress(OSError, ValueError, AttributeError):
        columns = os.get_terminal_size(out.fileno()).columns
    if columns < LEAST_COLUMNS:
        return text
    wrap = textwrap.TextWrapper(columns - 1, break_on_hyphens=False, break_long_words=False)
    lines = []
    for line in text.split("\n"):
        end = " " * (len(line) - len(line.rstrip()))
        lines.append(("\n".join(wrap.wrap(line)) + end) if len(line) >= columns else line)
    return "\n".join(lines)
