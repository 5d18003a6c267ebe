"""Somebody who listens in on a link: sees every byte as it is sent or received, and changes none.

A driver that has its own transport (Modbus) tells its tap the same way as `link` does. What a tap
does with the bytes, a capture file for one, is not known here.
"""

from __future__ import annotations

from typing import Protocol


class Tap(Protocol):
    """Told of each piece of traffic once, in order, from the host's side."""

    def opened(self, url: str) -> None:
        """The link was opened, or opened again."""
        ...

    def sent(self, data: bytes) -> None:
        """The host sent these bytes."""
        ...

    def received(self, data: bytes) -> None:
        """These bytes came from the instrument."""
        ...

    def closed(self, why: str = "") -> None:
        """The host closed the link, or it broke: ``why`` says then what broke it. May be told once
        more.
        """
        ...


class NoTap:
    """Nobody listens in."""

    def opened(self, url: str) -> None: ...
    def sent(self, data: bytes) -> None: ...
    def received(self, data: bytes) -> None: ...
    def closed(self, why: str = "") -> None: ...
