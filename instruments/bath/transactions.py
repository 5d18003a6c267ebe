"""Questions and answers over Modbus TCP, as plain calls that block.

What pymodbus's client leaves unchecked is checked here: length, function and echo of an answer, a first connect that
fails, a link that breaks in the middle. It may not know what registers mean.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Sequence
from typing import Literal
from urllib.parse import parse_qs, urlsplit

from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU

from instruments.bath.session import Session
from instruments.clock import Clock
from instruments.errors import DeviceError, LinkError, ProtocolError

TIMEOUT_S = 1.0
RETRIES = 1
CONNECT_PAUSES_S = (0.1, 0.2, 0.4, 0.8, 1.6)  # between attempts; then we give up
ILLEGAL_ADDRESS = 2
EXCEPTIONS = {
    1: "it does not know this function",
    2: "it has no register at this address",
    3: "it does not allow this value",
    4: "it failed while doing it",
    5: "it needs longer and will do it later",
    6: "it is busy",
    7: "it can't do this",
    8: "its memory has a parity error",
    10: "the gateway has no path to it",
    11: "the gateway got no answer from it",
}


class RefusedError(DeviceError):
    """The device answered with a Modbus exception, ``code``."""

    code = 0


class BrokenError(LinkError):
    """The connection went down under a question; over a new one the same question may be asked again."""


class Transactions:
    """One connection to one unit. Calls come one at a time: the owner holds a lock."""

    def __init__(self, host: str, port: int, unit_id: int, clock: Clock, *, who: str) -> None:
        self.who = who
        self._address = host, port
        self._unit_id = unit_id
        self._clock = clock
        self._session: Session | None = None
        if not logging.getLogger("pymodbus").handlers:  # or its complaints, which our errors carry, go to stderr
            logging.getLogger("pymodbus").addHandler(logging.NullHandler())

    @property
    def connected(self) -> bool:
        """Whether the link is up, as far as anybody has noticed."""
        return self._session is not None and self._session.connected

    def connect(self) -> None:
        """Open the link, trying again with growing pauses. Raises LinkError when nobody takes it in the end."""
        start = self._clock.now()
        for pause_s in (*CONNECT_PAUSES_S, None):
            if self._connect_once():
                return
            if pause_s is not None:
                self._clock.sleep(pause_s)
        tries = len(CONNECT_PAUSES_S) + 1
        hint = "Is the controller on, on this network, and set to Modbus TCP?"
        raise LinkError(self.who, f"nothing took the connection in {tries} tries", seconds=self._clock.now() - start, hint=hint)

    def read(self, table: Literal["holding", "input"], address: int, count: int) -> list[int]:
        """``count`` registers of ``table``. Raises LinkError, ProtocolError, RefusedError."""
        client = self._open().client
        ask = client.read_holding_registers if table == "holding" else client.read_input_registers
        asked = f"{table} registers {address} to {address + count - 1}"
        answer = self._ask(ask(address, count=count, device_id=self._unit_id), 3 if table == "holding" else 4, asked)
        registers = list(answer.registers)
        if len(registers) != count:
            raise self._nonsense(f"{len(registers)} registers were answered where {count} were asked", asked)
        return registers

    def write(self, address: int, registers: Sequence[int], *, single: bool) -> None:
        """Write holding registers from ``address``; ``single`` with function 6. Raises as ``read`` does."""
        client = self._open().client
        asked = f"write {list(registers)} to holding register {address}"
        if single:
            answer = self._ask(client.write_register(address, registers[0], device_id=self._unit_id), 6, asked)
            echoed = answer.address == address and list(answer.registers) == [registers[0]]
        else:
            answer = self._ask(client.write_registers(address, list(registers), device_id=self._unit_id), 16, asked)
            echoed = answer.address == address and answer.count == len(registers)
        if not echoed:
            raise self._nonsense("the answer confirms another write", asked)

    def close(self) -> None:
        """Drop the link; once more is no error."""
        if self._session is not None:
            self._session.close()
            self._session = None

    def _connect_once(self) -> bool:
        self.close()
        try:
            host = socket.getaddrinfo(*self._address, type=socket.SOCK_STREAM)[0][4][0]
        except OSError:  # no such name yet: a controller's name may turn up after it has started
            return False
        self._session = Session(str(host), self._address[1], self._clock, timeout_s=TIMEOUT_S, retries=RETRIES)
        if not self._session.connect():
            self.close()
            return False
        return True

    def _open(self) -> Session:
        if self._session is None or not self._session.connected:
            raise BrokenError(self.who, "the link is down", hint="Check cable and power.")
        return self._session

    def _ask(self, question: Awaitable[ModbusPDU], function: int, asked: str) -> ModbusPDU:
        session, start = self._open(), self._clock.now()
        session.forget_seen()
        try:
            answer = session.run(question)
        except (ConnectionException, asyncio.CancelledError) as error:
            session.close()
            raise BrokenError(self.who, "the link broke", asked=asked, hint="Check cable and power.") from error
        except TimeoutError as error:
            raise LinkError(self.who, "the emulator hangs", asked=asked) from error
        except ModbusException as error:
            if session.seen:
                raise self._nonsense("what came is no answer to this", asked) from error
            hint = "Is the unit id right, and the controller still on?"
            raise LinkError(self.who, "no answer", asked=asked, seconds=self._clock.now() - start, hint=hint) from error
        if answer.isError():
            raise self._refused(answer.exception_code, asked)
        if answer.function_code != function:
            raise self._nonsense(f"function {answer.function_code} was answered to function {function}", asked)
        return answer

    def _refused(self, code: int, asked: str) -> RefusedError:
        meaning = EXCEPTIONS.get(code, "a code that Modbus does not know")
        error = RefusedError(self.who, f"refused: {meaning}", asked=asked, seen=f"Modbus exception {code}")
        error.code = code
        return error

    def _nonsense(self, what: str, asked: str) -> ProtocolError:
        seen = self._session.seen if self._session else b""
        return ProtocolError(self.who, what, asked=asked, seen=seen, hint="Is this a Modbus TCP device of the right family?")


def address(url: str, unit_id: int, who: str) -> tuple[str, int, int]:
    """Host, port and unit of ``tcp://host[:502][?unit=1]``; ``unit_id`` where it names none. Raises LinkError."""
    hint = "Write tcp://host:port, and ?unit=2 behind it for another unit than the profile's."
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port or 502
        query = parse_qs(parts.query, strict_parsing=bool(parts.query))
        unit = int(query.pop("unit", [str(unit_id)])[-1])
    except ValueError as error:
        raise LinkError(who, f"not a link: {error}", hint=hint) from error
    if parts.scheme != "tcp" or not host or query or not 1 <= unit <= 247:
        raise LinkError(who, "not a link to a Modbus TCP device", hint=hint)
    return host, port, unit
