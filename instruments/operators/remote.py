"""The emulated operator of another process ('teatbench emulate').

A line of JSON asks, ``{"do": "touch", "with": {"teat": 2, "of": 4}}``; a line answers: ``{"done":
null}``, ``{"enough": "..."}`` or ``{"refused": "..."}``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from pydantic import TypeAdapter, validate_call
from pydantic_core import to_json

from instruments.clock import Clock
from instruments.errors import DeviceError, LinkError
from instruments.link import Link
from instruments.listener import Connection
from instruments.operators.operator import Arrangement, BoardAsked, Operator, OperatorEnough, Placed

LOOK_S = 0.2  # between two looks at the interlocks while the answer is waited for
PATIENCE_S = 120.0
DONE = (
    "confirm_homing",
    "touch_check_point",
    "set_up",
    "touch",
    "hold_board",
    "touch_board",
    "release",
)


class OperatorPort:
    """A `Device` behind which ``operator`` does what a `RemoteOperator` asks for."""

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._begun: dict[Connection, bytes] = {}

    def connect(self, connection: Connection) -> None:
        self._begun[connection] = b""

    def receive(self, connection: Connection, data: bytes) -> None:
        *lines, self._begun[connection] = (self._begun[connection] + data).split(b"\n")
        for line in lines:
            connection.send(to_json(self._answer(line)) + b"\n")

    def disconnect(self, connection: Connection) -> None:
        self._begun.pop(connection, None)

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            asked = json.loads(line)
            if asked["do"] not in DONE:
                return {"refused": f"not one of {', '.join(DONE)}: {asked['do']!r}"}
            return {"done": validate_call(getattr(self._operator, asked["do"]))(**asked["with"])}
        except OperatorEnough as enough:
            return {"enough": str(enough)}
        except (ValueError, TypeError, LookupError, ArithmeticError) as error:
            return {"refused": f"{type(error).__name__}: {error}"}


class RemoteOperator:
    """An `Operator` over a link. Raises LinkError without an answer, DeviceError for a refusal."""

    def __init__(self, url: str, clock: Clock) -> None:
        self.identity = {"operator": "emulated"}
        self._link = Link(url, clock, who="operator")
        self._check: Callable[[], None] = lambda: None

    def check_interrupts(self, check: Callable[[], None]) -> None:
        self._check = check

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        """It needs no encouragement."""

    def confirm_homing(self, instruction: str) -> None:
        self._ask("confirm_homing", instruction=instruction)

    def touch_check_point(self, touch: int, of: int) -> None:
        self._ask("touch_check_point", touch=touch, of=of)

    def set_up(self, arrangement: Arrangement) -> Placed:
        return TypeAdapter(Placed).validate_python(self._ask("set_up", arrangement=arrangement))

    def touch(
        self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = ""
    ) -> None:
        self._ask("touch", teat=teat, of=of, number=number, numbers=numbers, again=again)

    def hold_board(self, asked: BoardAsked) -> None:
        self._ask("hold_board", asked=asked)

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:
        self._ask("touch_board", corner=corner, instruction=instruction, again=again)

    def release(self) -> None:
        self._ask("release")

    def finish(self) -> None:
        """It has said nothing that could be left over."""

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _ask(self, do: str, **given: Any) -> Any:
        clock = self._link.clock
        began_s, line = clock.now(), b""
        self._check()
        self._link.write(to_json({"do": do, "with": given}) + b"\n")
        while not line.endswith(b"\n"):
            line += self._link.read_until(b"\n", LOOK_S)
            self._check()
            if (waited_s := clock.now() - began_s) > PATIENCE_S:
                hint = "Does 'teatbench emulate' still run?"
                raise LinkError(self._link.who, "no answer", asked=do, seconds=waited_s, hint=hint)
        answer = json.loads(line)
        if "enough" in answer:
            raise OperatorEnough(answer["enough"])
        if "done" not in answer:
            raise DeviceError(self._link.who, str(answer.get("refused", answer)), asked=do)
        return answer["done"]
