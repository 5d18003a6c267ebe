"""What is asked of a Modbus device, and how its answer has to begin: requests to bytes, answers to values. Pure, no I/O.

The requests are pymodbus's. What a right answer looks like is kept with the question, for RTU has no number to tell
whose an answer is: only function, length, and for writes the echo.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.bit_message import ReadCoilsRequest, ReadDiscreteInputsRequest, WriteSingleCoilRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

REQUESTS = {1: ReadCoilsRequest, 2: ReadDiscreteInputsRequest, 3: ReadHoldingRegistersRequest, 4: ReadInputRegistersRequest}
NAMES = {1: "coils", 2: "discrete inputs", 3: "holding registers", 4: "input registers"}
EXCEPTION = 0x80


@dataclass(slots=True)
class Question:
    """One question, from when it is put until its answer has come.

    An answer is the unit and the PDU: ``expects`` is how the right one begins, ``length`` its size in bytes.
    ``earlier`` are the numbers under which it was asked before, over TCP.
    """

    request: ModbusPDU
    expects: bytes
    length: int
    asked: str
    sent_s: float = 0.0
    answer: bytes | None = None
    earlier: tuple[int, ...] = ()

    @property
    def function(self) -> int:
        """The Modbus function."""
        return self.expects[1]

    @property
    def unit_id(self) -> int:
        """The unit that is asked."""
        return self.expects[0]

    def fits(self, answer: bytes) -> bool:
        """Whether ``answer`` may be its answer: the right one, or an exception."""
        if answer[1] & EXCEPTION:
            return answer[0] == self.unit_id and answer[1] & ~EXCEPTION == self.function
        return len(answer) == self.length and answer.startswith(self.expects)


def read_question(function: int, address: int, count: int, unit_id: int) -> Question:
    """``count`` bits (functions 1 and 2) or registers (3 and 4) from ``address``."""
    size = -(-count // 8) if function in (1, 2) else 2 * count
    request = REQUESTS[function](address=address, count=count, dev_id=unit_id)
    return Question(request, bytes((unit_id, function, size)), 3 + size, f"{NAMES[function]} {address} to {address + count - 1}")


def write_question(function: int, address: int, values: Sequence[int], unit_id: int) -> Question:
    """Write ``values`` from ``address``: one bit (function 5), one register (6) or some (16). The right answer is an echo."""
    request: ModbusPDU
    if function == 5:
        request = WriteSingleCoilRequest(address=address, bits=[bool(values[0])], dev_id=unit_id)
    elif function == 6:
        request = WriteSingleRegisterRequest(address=address, registers=[values[0]], dev_id=unit_id)
    else:
        request = WriteMultipleRegistersRequest(address=address, registers=list(values), dev_id=unit_id)
    echo = (bytes((unit_id, function)) + request.encode())[:6]
    return Question(request, echo, 6, f"write {list(values)} to {'coil' if function == 5 else 'holding register'} {address}")


def values_in(answer: bytes) -> list[int]:
    """The registers in the answer to a read, or its bits, eight for each byte; none where they are not whole."""
    data = answer[3:]
    if answer[1] in (1, 2):
        return [byte >> place & 1 for byte in data for place in range(8)]
    return list(struct.unpack(f">{len(data) // 2}H", data)) if len(data) % 2 == 0 else []
