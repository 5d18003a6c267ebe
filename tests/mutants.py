"""Files as transfer, editors and other programs damage them: bytes left out, doubled or overwritten,
numbers that no quantity has, structure without end.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterator

PIECES = (
    *(b"\xff", b"\0", b"\xed\xa0\x80", b"\\ud800", b"\xef\xbb\xbf", b"\n", b"\t", b'"', b"'", b"=", b":"),
    *(b"9" * 4301, b"0x" + b"f" * 4000, b"[" * 1500, b"{" * 1500, b"- " * 700, b"a." * 900, b"<<: *a\n"),
    *(b".nan", b"nan", b"inf", b"-.inf", b"1e999", b"-1", b"0", b"1e-320", b"true", b"null", b"~", b""),
    *(b"!!python/object:os.system ", b"!!set ", b"!!binary ", b"2026-13-45", b"1:60:60", b"&a ", b"*a "),
)  # fmt: skip
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


def mutants(data: bytes, count: int, seed: int = 0) -> Iterator[bytes]:
    """``count`` mutants of a file, each with one to four changes; the same for the same seed."""
    for number in range(count):
        yield mutant(data, random.Random(f"{seed} {number}"))


def mutant(data: bytes, rng: random.Random) -> bytes:
    """``data`` with one to four changes."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.choice((0, 1, 1, 4, 12, 60)))
        change = rng.randrange(6)
        numbers = list(NUMBER.finditer(data))
        if change == 0 and numbers:  # a number becomes another thing
            at, end = rng.choice(numbers).span()
        lines = data.split(b"\n")
        if change == 1 and len(lines) > 2:  # two lines change places
            one, other = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[one], lines[other] = lines[other], lines[one]
            data = b"\n".join(lines)
            continue
        if change == 2:  # bits
            flipped = bytearray(data)
            for _ in range(rng.randint(1, 8)):
                flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
            data = bytes(flipped)
            continue
        piece = rng.choice(PIECES) if rng.random() < 0.7 else data[at : at + 80]
        data = data[:at] + piece + data[end:] or b" "
        if change == 5 and rng.random() < 0.3:
            data = data[: rng.randrange(1, len(data) + 1)]
    return data
