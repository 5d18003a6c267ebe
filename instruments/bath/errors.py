"""The errors of a Modbus device that does not answer, refuses, or answers nonsense. Pure."""

from __future__ import annotations

from instruments.bath.connection import Line
from instruments.bath.requests import Question
from instruments.errors import DeviceError, LinkError, ProtocolError

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
    """The link broke under a question, which may be asked again over a new one."""


def unreachable(who: str, line: Line, why: str, tries: int, took_s: float) -> LinkError:
    """The connection or the port can't be opened; ``why`` in the system's words."""
    what = f"nothing took the connection in {tries} tries: {why}"
    hint = f"Is the controller on, on this network, and set to Modbus {line.transport.upper()}?"
    if line.kind == "serial":
        what = f"the port can't be opened in {tries} tries: {why}"
        hint = (
            "Is the adapter plugged in, and is it yours to open? 'python -m"
            " serial.tools.list_ports' lists the ports."
        )
    return LinkError(who, what, seconds=took_s, hint=hint)


def silence(who: str, question: Question, took_s: float) -> LinkError:
    """Nothing came."""
    hint = "Is the unit id right, and the controller still on?"
    return LinkError(who, "no answer", asked=question.asked, seconds=took_s, hint=hint)


def cut(who: str, question: Question, seen: bytes, line: Line) -> BrokenError | ProtocolError:
    """Over TCP ``seen`` came and no whole answer: only a part of one, or no Modbus at all."""
    if seen[2:4].strip(b"\0"):  # not the protocol's number
        return nonsense(who, "what came is no answer to this", question, seen, line)
    what, hint = "only a part of the answer came", "Check network and gateway if it happens often."
    return BrokenError(who, what, asked=question.asked, seen=seen, hint=hint)


def owing(who: str, questions: int, took_s: float, left_s: float) -> LinkError:
    """No question is left whose answer can't be confused with one that is owed."""
    hint = f"Nothing is asked for {left_s:.0f} s at most: until then an answer may still come."
    return LinkError(who, f"no answer to {questions} questions", seconds=took_s, hint=hint)


def refused(who: str, code: int, question: Question) -> RefusedError:
    """The device answered with the Modbus exception ``code``."""
    what = f"refused: {EXCEPTIONS.get(code, 'a code that Modbus does not know')}"
    error = RefusedError(who, what, asked=question.asked, seen=f"Modbus exception {code}")
    error.code = code
    return error


def nonsense(who: str, what: str, question: Question, seen: bytes, line: Line) -> ProtocolError:
    """``seen`` came, and is no answer to ``question``."""
    hint = f"Is this a Modbus {line.transport.upper()} device of the right family?"
    return ProtocolError(who, what, asked=question.asked, seen=seen, hint=hint)
