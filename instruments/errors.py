"""The tree of instrument errors: who, what was asked, what came (hex), how long, what to try. The
class says whose fault it is: raise the most exact one, catch the one you can act on.
"""

from __future__ import annotations


def hex_bytes(data: bytes) -> str:
    """The bytes as a person reads them on a line analyser: ``83 00 6C``; ``nothing`` for none."""
    return data.hex(" ").upper() if data else "nothing"


class InstrumentError(Exception):
    """Any fault of an instrument; raise a subclass. ``who``: instrument and link; ``what``: the
    sentence; ``asked``, ``seen``: bytes are shown as hex; ``hint``: what to try.
    """

    def __init__(
        self,
        who: str,
        what: str,
        *,
        asked: str | bytes | None = None,
        seen: str | bytes | None = None,
        seconds: float | None = None,
        hint: str | None = None,
    ) -> None:
        self.who = who
        self.what = what
        self.asked = asked
        self.seen = seen
        self.seconds = seconds
        self.hint = hint
        facts = []
        if self.asked is not None:
            facts.append(f"asked {_shown(self.asked)}")
        if self.seen is not None:
            facts.append(f"got {_shown(self.seen)}")
        if self.seconds is not None:
            facts.append(f"after {self.seconds:.3g} s")
        text = f"{self.who}: {self.what}"
        if facts:
            text += f" ({', '.join(facts)})"
        super().__init__(text + (f". {self.hint}" if self.hint else ""))


def _shown(fact: str | bytes) -> str:
    return hex_bytes(fact) if isinstance(fact, bytes) else fact


class LinkError(InstrumentError):
    """No answer came, or the link broke. Not for an answer that makes no sense."""


class ProtocolError(InstrumentError):
    """Something answered, but not what the protocol allows: damage, or another kind of device."""


class DeviceError(InstrumentError):
    """The device understood and said no, or reports a fault of its own (alarm, error code)."""


class DriverError(DeviceError):
    """A driver raised an exception of its own, which doesn't say what its device did."""


class LimitError(InstrumentError):
    """Refused before anything was sent: outside a limit, not homed, not allowed in this state."""


class TouchAgainError(LimitError):
    """A touch that can't be used, such as of an arm that moved: the person touches once more."""
