"""The controller's 128 byte receive buffer and its lines of 80 characters; excess bytes are lost.
Source: the firmware's interface document.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

LINE_PLACES = 79
OVERFLOW = "\n"  # stands for a line that was too long; no line can hold it
_REALTIME = re.compile(rb"([?!~\x18\x80-\xff])")


def split(data: bytes) -> Iterator[tuple[bool, bytes]]:
    """Cut into single real-time bytes (True) and stretches of others (False), in order."""
    for at, part in enumerate(_REALTIME.split(data)):
        if part:
            yield at % 2 == 1, part


class Receiver:
    """Bytes in, lines out on demand; ``OVERFLOW`` for a line that was too long."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._waiting = bytearray()
        self.clear()

    def clear(self) -> None:
        """Forget all, as a reset does."""
        self._waiting.clear()
        self._line = ""
        self._overflowed = False
        self._comment = ""

    @property
    def room(self) -> int:
        """Bytes that can be taken before the main loop reads again."""
        return self._capacity - len(self._waiting)

    def put(self, data: bytes) -> None:
        """Take what there is room for; the rest is lost."""
        self._waiting += data[: self.room]

    def lines(self) -> Iterator[str]:
        """Complete lines on demand: capitals, without blanks and comments."""
        while self._waiting:
            sign = chr(self._waiting.pop(0))
            if sign in "\r\n":
                line = OVERFLOW if self._overflowed else self._line
                self._line, self._overflowed, self._comment = "", False, ""
                yield line
            else:
                self._add(sign)

    def _add(self, sign: str) -> None:
        if self._comment:
            if self._comment == "(" and sign == ")":
                self._comment = ""
        elif sign in "(;":
            self._comment = sign
        elif sign <= " " or sign == "/" or self._overflowed:
            return
        elif len(self._line) >= LINE_PLACES:
            self._overflowed = True
        else:
            self._line += sign.upper()
