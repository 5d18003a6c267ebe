"""A tap gets every byte of a link, sent or received, and changes none."""

from __future__ import annotations


class Tap:
    """Told of each piece of traffic once, in order, from the host's side; this one drops it."""

    def opened(self, url: str) -> None:
        """The link was opened, or opened again."""

    def sent(self, data: bytes) -> None:
        """The host sent these bytes."""

    def received(self, data: bytes) -> None:
        """These bytes came from the instrument."""

    def closed(self, why: str = "") -> None:
        """The host closed the link, or it broke because of ``why``. Called once a link."""
