"""What a person does where something could not be made safe: a line an instrument, heat first."""

from __future__ import annotations

from collections.abc import Mapping

from textfiles.text import time_text

# what a person does at what heats, moves or turns and can't be made safe from here
BY_HAND = {
    "bath": "SWITCH OFF THE BATH AT ITS MAINS",
    "stage": "CUT THE POWER OF THE STAGE",
    "pump": "SWITCH OFF THE PUMP AT ITS MAINS",
    "robot": "PRESS THE ROBOT'S EMERGENCY STOP",
}


def silent(brief: str, age_s: float | None) -> str:
    """``no answer for 12 s``, where no answer is all that is wrong and its age is known."""
    return brief if brief != "no answer" or age_s is None else f"{brief} for {time_text(age_s)}"


def not_safe_text(unsafe: Mapping[str, str]) -> str:
    """What ``make_safe`` gave back, for a person: a line an instrument."""
    return "\n".join((f"NOT SAFE: {', '.join(unsafe)}.", *unsafe.values()))
