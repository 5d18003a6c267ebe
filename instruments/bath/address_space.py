"""The emulated controller's address space: which row answers at which address, in how many
registers, and what is refused.

It knows addresses and not meanings: values come from and go to whoever holds them. Rules of
families: `families`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from instruments.bath import protocol
from instruments.bath.controller_behaviour import Manners
from instruments.bath.profile import Wiring
from instruments.bath.protocol import Read, Refused, Write
from instruments.bath.registers import Order, Row, Table

IEEE_AREA = 0x8000  # Eurotherm: a pair of registers at 0x8000 + 2 n for each quantity n
PADDING = 0x8000  # behind a word that takes only the first register of its pair
ALIKE: Mapping[Table, Table] = {"input": "holding", "discrete": "coil"}


class Values(Protocol):
    """Who holds the quantities. Numbers are as they go over the wire: in the unit that the
    controller speaks.
    """

    @property
    def decimals(self) -> int: ...
    @property
    def order(self) -> Order: ...
    def words(self, row: Row) -> tuple[int, ...]: ...
    def number(self, row: Row) -> float: ...
    def refuses(self, row: Row, value: float) -> bool: ...
    def take(self, row: Row, value: float) -> None: ...


@dataclass(frozen=True, slots=True)
class Cell:
    """A row at an address. ``padded``: one word and a filler; ``whole``: a float as a 16-bit number
    without its decimal point.
    """

    row: Row
    address: int
    form: Literal["plain", "padded", "whole"] = "plain"

    @property
    def count(self) -> int:
        """How many registers it takes."""
        return {"plain": self.row.words, "padded": 2, "whole": 1}[self.form]

    @property
    def end(self) -> int:
        """The first address after it."""
        return self.address + self.count

    def said(self, values: Values) -> tuple[int, ...]:
        """The registers that hold its value."""
        if self.form == "whole":
            number = values.number(self.row)
            return (
                (
                    round(number * 10.0**values.decimals) & 0xFFFF
                    if math.isfinite(number)
                    else PADDING
                ),
            )
        words = values.words(self.row)
        return (words[0], PADDING) if self.form == "padded" else words

    def heard(self, words: tuple[int, ...], values: Values) -> float:
        """The number in ``words``."""
        if self.form == "whole":
            return (words[0] - 0x10000 if words[0] & 0x8000 else words[0]) / 10.0**values.decimals
        return self.row.decode(words[: self.row.words], values.order)


class Cells:
    """The address space of a controller of ``profile``'s family."""

    def __init__(self, profile: Wiring, manners: Manners, values: Values) -> None:
        self.gaps_refused = False
        self._manners = manners
        self._values = values
        self._at: dict[tuple[Table, int], Cell] = {}
        rows = [opened(row, manners) for row in profile.rows]
        for row in rows:
            self._place(Cell(row, row.address))
        if manners.areas:
            for row in rows:
                self._mirror(row)

    def read(self, request: Read) -> list[int]:
        """The bits or registers asked for. Raises Refused."""
        table = self._table(request.function)
        end = request.address + request.count
        if end > 0x10000:
            raise Refused(protocol.ILLEGAL_ADDRESS)
        self._check_pairs(request.address, request.count, request.function)
        if self._manners.gaps != "undefined" and not {
            (table, request.address),
            (table, end - 1),
        } <= set(self._at):
            raise Refused(protocol.ILLEGAL_ADDRESS)
        return [
            word for address in range(request.address, end) for word in self._word(table, address)
        ]

    def write(self, request: Write) -> None:
        """All of the request or nothing, and whole rows only. Raises Refused."""
        wanted = [(cell.row, self._wanted(cell, words)) for cell, words in self._targets(request)]
        for row, value in wanted:
            self._values.take(row, value)

    def _targets(self, request: Write) -> Iterator[tuple[Cell, tuple[int, ...]]]:
        table = self._table(request.function)
        self._check_pairs(request.address, len(request.values), request.function)
        if self._discards(table, request):
            return
        address, end = request.address, request.address + len(request.values)
        while address < end:
            cell = self._at.get((table, address))
            if (
                cell is None
                or "w" not in cell.row.access
                or cell.address != address
                or cell.end > end
            ):
                raise Refused(protocol.ILLEGAL_ADDRESS)
            if cell.count > 1 and request.function == protocol.WRITE_ONE:
                raise Refused(protocol.ILLEGAL_ADDRESS)
            yield cell, request.values[address - request.address :][: cell.count]
            address = cell.end

    def _discards(self, table: Table, request: Write) -> bool:
        """Eurotherm: a block of one register to an address that is not configured is confirmed, and
        nothing happens.
        """
        lone = request.function == protocol.WRITE_MANY and len(request.values) == 1
        return (
            self._manners.gaps == "undefined" and lone and (table, request.address) not in self._at
        )

    def _wanted(self, cell: Cell, words: tuple[int, ...]) -> float:
        value = cell.heard(words, self._values)
        if not math.isfinite(value) or self._values.refuses(cell.row, value):
            raise Refused(protocol.ILLEGAL_VALUE)
        return value

    def _word(self, table: Table, address: int) -> tuple[int, ...]:
        cell = self._at.get((table, address))
        if cell is not None:
            return (cell.said(self._values)[address - cell.address],)
        if self._manners.gaps == "undefined":
            return ((address * 40503 & 0xFFFF) if table == "holding" else address & 1,)
        if self.gaps_refused or self._manners.gaps == "refused":
            raise Refused(protocol.ILLEGAL_ADDRESS)
        return (0,)

    def _check_pairs(self, address: int, count: int, function: int) -> None:
        """The IEEE area takes whole pairs only, from an even address, and never with function 6."""
        if not self._manners.areas or address < IEEE_AREA or function in protocol.BITS:
            return
        if address % 2 or count % 2 or function == protocol.WRITE_ONE:
            raise Refused(protocol.ILLEGAL_ADDRESS)

    def _table(self, function: int) -> Table:
        table = self._manners.functions[function]
        return ALIKE.get(table, table) if self._manners.alike else table

    def _place(self, cell: Cell) -> None:
        table = ALIKE.get(cell.row.table, cell.row.table) if self._manners.alike else cell.row.table
        for address in range(cell.address, cell.end):
            self._at.setdefault((table, address), cell)

    def _mirror(self, row: Row) -> None:
        """The same quantity in the other area."""
        if row.type == "bit":
            return
        if row.address >= IEEE_AREA and row.address % 2 == 0:
            self._place(
                Cell(row, (row.address - IEEE_AREA) // 2, "whole" if row.words == 2 else "plain")
            )
        elif row.address < IEEE_AREA // 2 and row.words == 1:
            self._place(Cell(row, IEEE_AREA + 2 * row.address, "padded"))


def opened(row: Row, manners: Manners) -> Row:
    """The row as the controller has it: a profile lets the bench write less than the controller
    takes.
    """
    takes = row.table == "holding" if manners.writable is None else row.name in manners.writable
    return row.model_copy(update={"access": "rw"}) if takes and row.access == "r" else row
