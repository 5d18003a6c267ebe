"""A tap that notes what it is told."""

from __future__ import annotations


class Heard:
    """``told``: each event with its fact, in order."""

    def __init__(self) -> None:
        self.told: list[tuple[str, bytes | str]] = []

    def opened(self, url: str) -> None:
        self.told.append(("opened", url))

    def sent(self, data: bytes) -> None:
        self.told.append(("sent", data))

    def received(self, data: bytes) -> None:
        self.told.append(("received", data))

    def closed(self, why: str = "") -> None:
        self.told.append(("closed", why))
