"""A tap gets every byte of a link, sent or received, and changes none."""

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
        """The host closed the link, or it broke because of ``why``. Called once a link."""
        ...


class NoTap:
    """No listener."""

    def opened(self, url: str) -> None: ...
    def sent(self, data: bytes) -> None: ...
    def received(self, data: bytes) -> None: ...
    def closed(self, why: str = "") -> None: ...
