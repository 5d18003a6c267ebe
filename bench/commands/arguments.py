"""Words of the command line to values, for argparse's ``type``: what several families of commands take. Each says what is wrong."""

from __future__ import annotations

import argparse
from collections.abc import Callable


def number(text: str) -> float:
    """Any number, not a number and the infinite among them: who asks looks at the range."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def seconds(text: str) -> float:
    """A duration above 0, in plain digits."""
    value = float(text) if text.replace(".", "", 1).isdigit() else 0.0
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return value


def natural(text: str) -> int:
    """A whole number of 0 or more."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number of 0 or more, is {text!r}")
    return int(text)


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number from ``low`` to ``high``."""

    def take(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")
        return int(text)

    return take


def address(instrument: str) -> Callable[[str], str]:
    """Where a "bath" or a "stage" is, as in a rig file, but not an emulated one: that lives in the bench."""

    def take(text: str) -> str:
        from bench.addresses import EMULATED, bath_url, serial_url

        try:
            if text == EMULATED:
                raise ValueError(f"an emulated {instrument} lives in the bench; 'teatbench emulate' serves one at a port")
            return bath_url(text) if instrument == "bath" else serial_url(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is no {instrument}: {error}") from error

    return take
