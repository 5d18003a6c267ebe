"""The emulated device's address space: which row answers at which address, in how many registers,
and what is refused. Values come from and go to `Values`; rules of families: `register_semantics`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from instruments.bath import protocol
from instruments.bath.profile import Wiring
from instruments.bath.protocol import Read, Refused, Write
from instruments.bath.registers import Order, Row, Table

if TYPE_CHECKING:
    from instruments.bath.register_semantics import Manners

IEEE_AREA = 0x8000  # Eurotherm: a pair of registers at 0x8000 + 2 n for each quantity n
PADDING = 0x8000  # behind a word that takes only the first register of its pair
ALIKE: Mapping[Table, Table] = {"input": "holding", "discrete": "coil"}


class Values:
    """The device's memory. Numbers are as they go over the wire: in the unit that it speaks."""

    def __init__(self, profile: Wiring) -> None:
        self.wiring = profile
        self.memory: dict[str, float] = {}

    @property
    def decimals(self) -> int:
        """Digits behind the decimal point that a 16-bit number leaves out."""
        return 0

    @property
    def order(self) -> Order:
        """In which order the bytes of two registers go just now."""
        return self.wiring.order

    def number(self, row: Row) -> float:
        """The row's value."""
        return self.memory.get(row.name, 0.0)

    def words(self, row: Row) -> tuple[int, ...]:
        """The registers, or the bit, that hold the row's value."""
        return row.encode(self.number(row), self.order)

    def refuses(self, row: Row, value: float) -> bool:
        """Whether the row does not take ``value``."""
        return row.refusal(value) is not None

    def take(self, row: Row, value: float) -> None:
        """Act on a value written."""
        self.memory[row.name] = value


@dataclass(frozen=True, slots=True)
class Cell:
    """A row at an address. ``padded``: a word and a filler; ``whole``: a float as 16 bits."""

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

    def encode(self, values: Values) -> tuple[int, ...]:
        """The registers that hold its value."""
        if self.form == "whole":
            number = values.number(self.row) * 10.0**values.decimals
            return (round(number) & 0xFFFF if math.isfinite(number) else PADDING,)
        words = values.words(self.row)
        return (words[0], PADDING) if self.form == "padded" else words

    def decode(self, words: tuple[int, ...], values: Values) -> float:
        """The number in ``words``."""
        if self.form == "whole":
            return (words[0] - 0x10000 if words[0] & 0x8000 else words[0]) / 10.0**values.decimals
        return self.row.decode(words[: self.row.words], values.order)


class Cells:
    """The address space of a device of ``profile``'s family."""

    def __init__(self, profile: Wiring, manners: Manners, values: Values) -> None:
        self.gaps_refused = False
        self._manners = manners
        self._values = values
        self._at: dict[tuple[Table, int], Cell] = {}
        rows = [_opened(row, manners) for row in profile.rows]
        mirrored = [_mirrored(row) for row in rows] if manners.areas else []
        for cell in [Cell(row, row.address) for row in rows] + mirrored:
            if cell is not None:
                table = self._alike(cell.row.table)
                for address in range(cell.address, cell.end):
                    self._at.setdefault((table, address), cell)

    def read(self, request: Read) -> list[int]:
        """The bits or registers asked for. Raises Refused."""
        table = self._alike(self._manners.functions[request.function])
        end = request.address + request.count
        self._check_pairs(request.address, request.count, request.function)
        ends = {(table, request.address), (table, end - 1)}
        if end > 0x10000 or (self._manners.gaps != "undefined" and not ends <= set(self._at)):
            raise Refused(protocol.ILLEGAL_ADDRESS)
        return [self._word(table, address) for address in range(request.address, end)]

    def write(self, request: Write) -> None:
        """All of the request or nothing, and whole rows only. Raises Refused."""
        wanted = []
        for cell, words in self._targets(request):
            value = cell.decode(words, self._values)
            if not math.isfinite(value) or self._values.refuses(cell.row, value):
                raise Refused(protocol.ILLEGAL_VALUE)
            wanted.append((cell.row, value))
        for row, value in wanted:
            self._values.take(row, value)

    def _targets(self, request: Write) -> Iterator[tuple[Cell, tuple[int, ...]]]:
        table = self._alike(self._manners.functions[request.function])
        address, end = request.address, request.address + len(request.values)
        self._check_pairs(address, len(request.values), request.function)
        lone = request.function == protocol.WRITE_MANY and len(request.values) == 1
        if self._manners.gaps == "undefined" and lone and (table, address) not in self._at:
            return  # Eurotherm confirms a block of one register that is not configured
        while address < end:
            cell = self._at.get((table, address))
            if (
                cell is None
                or "w" not in cell.row.access
                or cell.address != address
                or cell.end > end
                or (cell.count > 1 and request.function == protocol.WRITE_ONE)
            ):
                raise Refused(protocol.ILLEGAL_ADDRESS)
            yield cell, request.values[address - request.address :][: cell.count]
            address = cell.end

    def _word(self, table: Table, address: int) -> int:
        cell = self._at.get((table, address))
        if cell is not None:
            return cell.encode(self._values)[address - cell.address]
        if self._manners.gaps == "undefined":
            return (address * 40503 & 0xFFFF) if table == "holding" else address & 1
        if self.gaps_refused or self._manners.gaps == "refused":
            raise Refused(protocol.ILLEGAL_ADDRESS)
        return 0

    def _check_pairs(self, address: int, count: int, function: int) -> None:
        """The IEEE area takes whole pairs only, from an even address, and never with function 6."""
        if not self._manners.areas or address < IEEE_AREA or function in protocol.BITS:
            return
        if address % 2 or count % 2 or function == protocol.WRITE_ONE:
            raise Refused(protocol.ILLEGAL_ADDRESS)

    def _alike(self, table: Table) -> Table:
        return ALIKE.get(table, table) if self._manners.alike else table


def _mirrored(row: Row) -> Cell | None:
    """The same quantity in the other area of a Eurotherm."""
    if row.type == "bit":
        return None
    if row.address >= IEEE_AREA and row.address % 2 == 0:
        form: Literal["plain", "whole"] = "whole" if row.words == 2 else "plain"
        return Cell(row, (row.address - IEEE_AREA) // 2, form)
    if row.address < IEEE_AREA // 2 and row.words == 1:
        return Cell(row, IEEE_AREA + 2 * row.address, "padded")
    return None


def _opened(row: Row, manners: Manners) -> Row:
    """The row as the controller has it: a profile lets the bench write less than that."""
    takes = row.table == "holding" if manners.writable is None else row.name in manners.writable
    return row.model_copy(update={"access": "rw"}) if takes and row.access == "r" else row
