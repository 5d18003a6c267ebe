"""Check sums of lines of ASCII, by name. Pure.

``sum``: of the characters' codes, modulo 256; ``lrc``: its two's complement (Modbus ASCII is that
over bytes); ``xor``: of the codes, as NMEA 0183 has it; ``crc16``: that of Modbus RTU, low byte
first. Each is written in hexadecimal digits behind the line, before its end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from typing import Literal

from instruments.bath.protocol import crc

Checksum = Literal["none", "sum", "xor", "lrc", "crc16"]

SUMS: Mapping[str, Callable[[bytes], str]] = {
    "sum": lambda data: f"{sum(data) & 0xFF:02X}",
    "xor": lambda data: f"{reduce(lambda one, other: one ^ other, data, 0):02X}",
    "lrc": lambda data: f"{-sum(data) & 0xFF:02X}",
    "crc16": lambda data: crc(data).to_bytes(2, "little").hex().upper(),
}


def summed(line: str, name: Checksum, skip: int = 0) -> str:
    """``line`` with its check sum behind it."""
    return line if name == "none" else line + SUMS[name](line.encode("ascii")[skip:])


def checked(line: str, name: Checksum, skip: int = 0) -> str | None:
    """``line`` without its check sum; None where that is wrong."""
    if name == "none":
        return line
    size = 4 if name == "crc16" else 2
    content, digits = line[:-size], line[-size:]
    right = len(line) > size and line.isascii()
    return content if right and summed(content, name, skip)[-size:] == digits.upper() else None
