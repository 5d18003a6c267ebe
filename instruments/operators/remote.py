"""The emulated operator of another process ('teatbench emulate'), asked in lines of JSON:
``{"do": "touch", "with": {"teat": 2, "of": 4}}``. A line answers: ``{"done": {"visible": []}}``,
``{"enough": "..."}``, ``{"skipped": "..."}``, ``{"aborted": "..."}`` or ``{"refused": "..."}``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from pydantic import TypeAdapter
from pydantic_core import from_json, to_json

from instruments.clock import Clock
from instruments.errors import DeviceError, LinkError, ProtocolError
from instruments.link import MOST_BYTES, SEEN_BYTES, Link
from instruments.listener import Connection
from instruments.operators import operator as op

LOOK_S = 0.2  # between two looks at the interlocks while the answer is waited for
TIMEOUT_S = 60.0
LONGEST_SAID = 1000  # characters of a refusal that are shown
ASKED: dict[str, type[op.Request]] = {
    "confirm_homing": op.Homing,
    "touch_check_point": op.CheckPoint,
    "set_up": op.Arrangement,
    "touch": op.Touch,
    "hold_board": op.BoardPose,
    "touch_board": op.BoardTouch,
    "release": op.Release,
}
STOPS = {"enough": op.OperatorEnough, "skipped": op.OperatorSkip, "aborted": op.OperatorAbort}
NAMES = {request: name for name, request in ASKED.items()}


class OperatorPort:
    """A `Device` behind which ``operator`` does what a `RemoteOperator` asks for."""

    def __init__(self, operator: op.Operator) -> None:
        self._operator = operator
        self._begun: dict[Connection, bytes] = {}

    def connect(self, connection: Connection) -> None:
        self._begun[connection] = b""

    def receive(self, connection: Connection, data: bytes) -> None:
        *lines, begun = (self._begun[connection] + data).split(b"\n")
        self._begun[connection] = begun[-MOST_BYTES:]
        for line in lines:
            connection.send(to_json(self._answer(line)) + b"\n")

    def disconnect(self, connection: Connection) -> None:
        self._begun.pop(connection, None)

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            asked = json.loads(line)
            if asked["do"] not in ASKED:
                return {"refused": f"not one of {', '.join(ASKED)}: {asked['do']!r}"}
            request = TypeAdapter(ASKED[asked["do"]]).validate_python(asked["with"])
            return {"done": self._operator.ask(request)}
        except op.OperatorEnough as enough:
            return {"enough": str(enough)}
        except op.OperatorSkip as skip:
            return {"skipped": skip.reason}
        except op.OperatorAbort as abort:
            return {"aborted": str(abort)}
        except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError) as error:
            return {"refused": f"{type(error).__name__}: {error}"}


class RemoteOperator:
    """An `Operator` over a link. Raises LinkError without an answer, DeviceError for a refusal,
    ProtocolError for another program's words.
    """

    def __init__(self, url: str, clock: Clock) -> None:
        self.identity = {"operator": "emulated"}
        self._link = Link(url, clock, who="operator")
        self._owed, self._line = 0, b""  # answers to come, and what there is of the next one

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def ask(self, request: op.Request, check: Callable[[], None] = op.no_check) -> op.Answer:
        do = NAMES.get(type(request))
        if do is None:
            return op.DONE  # nothing is to be done
        clock = self._link.clock
        began_s = clock.now()
        wait = self._link.reception(began_s + TIMEOUT_S)
        check()
        self._link.write(to_json({"do": do, "with": request}) + b"\n")
        self._owed += 1
        while True:
            self._line += (more := self._link.read_until(b"\n", LOOK_S))
            wait.took(more)
            if self._line.endswith(b"\n"):
                line, self._line, self._owed = self._line, b"", self._owed - 1
                if not self._owed:  # else it answers what was asked before ``check`` raised
                    check()
                    return read_line(line, do, self._link.who)
            check()
            if (waited_s := clock.now() - began_s) > TIMEOUT_S:
                hint = "Does 'teatbench emulate' still run?"
                raise LinkError(self._link.who, "no answer", asked=do, seconds=waited_s, hint=hint)


def read_line(line: bytes, do: str, who: str) -> op.Answer:
    """The answer in a line to ``do``. Raises OperatorEnough, OperatorSkip, OperatorAbort,
    DeviceError, ProtocolError.
    """
    try:
        answer = from_json(line)
        if isinstance(answer, dict) and "done" in answer:
            return TypeAdapter(op.Answer).validate_python(answer["done"])
    except ValueError:  # no JSON, or not one of the answers
        answer = None
    if not isinstance(answer, dict):
        what, hint = "this is no operator of 'teatbench emulate'", "Is the address right?"
        raise ProtocolError(who, what, asked=do, seen=line[:SEEN_BYTES], hint=hint)
    for key, stop in STOPS.items():
        if key in answer:
            raise stop(str(answer[key])[:LONGEST_SAID])
    raise DeviceError(who, str(answer.get("refused", answer))[:LONGEST_SAID], asked=do)
