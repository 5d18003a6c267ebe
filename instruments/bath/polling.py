"""What to ask a controller for in one poll: its polled rows in as few questions as go, the same every time. Pure.

A fixed block of a fixed length is also the cheapest guard against stale answers: at worst one is old, never another quantity.
"""

from __future__ import annotations

from dataclasses import dataclass

from instruments.bath.rows import Row, Table
from instruments.bath.wiring import ReadFunction, Wiring

MOST_WORDS = 125  # a read answers no more (Modbus application protocol 1.1b3, section 6.3)
MOST_GAP = 8  # registers that nobody wants cost less than another question, up to about here


@dataclass(frozen=True, slots=True)
class Block:
    """Rows that one question with ``function`` fetches: ``count`` registers (or bits) of ``table`` from ``address``."""

    function: ReadFunction
    table: Table
    rows: tuple[Row, ...]

    @property
    def address(self) -> int:
        """The first register."""
        return self.rows[0].address

    @property
    def end(self) -> int:
        """The register behind the last."""
        return self.rows[-1].end

    @property
    def count(self) -> int:
        """How many registers."""
        return self.end - self.address


def blocks(profile: Wiring, *, gaps: bool, inferred: bool = False) -> tuple[Block, ...]:
    """The questions of one poll.

    ``gaps`` reads over addresses that no row claims, which a controller may refuse; ``inferred`` takes in rows
    whose evidence is INFERRED.
    """
    found: list[Block] = []
    polled = (row for row in profile.rows if row.poll and (inferred or row.evidence != "INFERRED"))
    for row in sorted(polled, key=lambda row: (row.table, row.address)):
        last = found[-1] if found and found[-1].table == row.table else None
        if last and row.end - last.address <= MOST_WORDS and row.address - last.end <= (MOST_GAP if gaps else 0):
            found[-1] = Block(last.function, last.table, (*last.rows, row))
        else:
            found.append(Block(reader(profile, row.table), row.table, (row,)))
    return tuple(found)


def reader(profile: Wiring, table: Table) -> ReadFunction:
    """The function that reads ``table``. Raises ValueError where the family has none, which a checked profile never meets."""
    function = profile.read_function(table)
    if function is None:
        raise ValueError(f"{profile.family} has no function that reads table {table}")
    return function


def markers(profile: Wiring, *, inferred: bool = False) -> tuple[tuple[int, int, int], ...]:
    """Reads (function, address, count) that the device surely answers, one of each shape that an answer can have.

    Fewer than two shapes prove nothing, and then there are none.
    """
    asked = blocks(profile, gaps=False, inferred=inferred)
    reads: list[tuple[int, int, int]] = [(block.function, row.address, row.words) for block in asked for row in block.rows]
    reads += [(block.function, block.address, block.count) for block in asked]
    if profile.alike:
        reads += [(4 if function == 3 else 3, address, count) for function, address, count in reads if function in (3, 4)]
    shapes = {(function, -(-count // 8) if function in (1, 2) else count): (function, address, count) for function, address, count in reads}
    return tuple(shapes.values()) if len(shapes) > 1 else ()
