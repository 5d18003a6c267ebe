"""What the bench does about each kind of fault of an instrument: how often it tries again, and what a person has to check.

A table and a lookup, nothing else. What isn't in it ends the run at once: limits that were refused before anything was sent, a bath
that says no, whatever is no instrument's. May not know how an instrument is brought back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from instruments.microscribe.refusals import AnotherArmError, UnusableArmError

INSTRUMENTS = ("arm", "stage", "bath", "cameras")
GONE, GARBLED, REFUSES = "gone", "garbled", "refuses"


@dataclass(frozen=True, slots=True)
class Policy:
    """``times`` it is tried again in one trial, or one step of preparing, at most; ``check`` is for the person."""

    times: int
    check: str


POLICIES: Mapping[tuple[str, str], Policy] = MappingProxyType(
    {
        ("arm", GONE): Policy(3, "Check the arm's power and its cable."),
        ("arm", GARBLED): Policy(3, "Check the arm's cable and plugs, and what disturbs it."),
        ("stage", GONE): Policy(3, "Check the stage's power and its cable; keep your hands off it, it will home."),
        ("stage", GARBLED): Policy(3, "Check the stage's cable and what disturbs it; keep your hands off it, it will home."),
        ("stage", REFUSES): Policy(1, "Look whether something is in the stage's way; keep your hands off it, it will home."),
        ("bath", GONE): Policy(3, "Check the bath's power and its cable."),
        ("bath", GARBLED): Policy(3, "Check the bath's cable, its address and what disturbs it."),
        ("cameras", GONE): Policy(3, "Check the cameras' power and cables."),
        ("cameras", GARBLED): Policy(3, "Check the cameras' cables and settings."),
        ("cameras", REFUSES): Policy(2, "Look at the cameras: lens caps, light, focus, trigger."),
    }
)


def instrument_of(fault: InstrumentError) -> str | None:
    """Whose fault it is, by who the error names; None where it is no instrument's."""
    who = fault.who.lower()
    if "camera" in who:
        return "cameras"
    first = who.replace(":", " ").split()[0] if who.split() else ""
    return {"pump": "bath"}.get(first, first if first in INSTRUMENTS else None)


def kind_of(fault: InstrumentError) -> str | None:
    """Gone, garbled or refuses; None for what no second try can cure."""
    if isinstance(fault, AnotherArmError | UnusableArmError):
        return None
    kinds = ((LinkError, GONE), (ProtocolError, GARBLED), (DeviceError, REFUSES))
    return next((kind for error, kind in kinds if isinstance(fault, error)), None)


def policy_for(fault: InstrumentError) -> Policy | None:
    """What to do about ``fault``; None to end the run."""
    instrument, kind = instrument_of(fault), kind_of(fault)
    return POLICIES.get((instrument, kind)) if instrument and kind else None


def table_text() -> str:
    """The table in Markdown."""
    means = {GONE: "doesn't answer, link broken", GARBLED: "answers nonsense", REFUSES: "says no, or gives nothing usable"}
    rows = [f"| {who} | {means[kind]} | {policy.times} | {policy.check} |" for (who, kind), policy in POLICIES.items()]
    return "\n".join(["| instrument | fault | tries in a trial | what the operator is told |", "|---|---|---|---|", *rows])
