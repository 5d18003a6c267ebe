"""Rich's console as the bench uses it: what others wrote moves no cursor, changes no colour and is no markup."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from reports.sanitize import sanitized, unfiltered


class Terminal(Console):
    """The program's standard output. Only control segments, which rich makes itself, are written as they are."""

    def __init__(self) -> None:
        super().__init__(file=unfiltered(sys.stdout), markup=False, emoji=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """As rich does, with each text sanitized before lines are measured and cut."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(sanitized(segment.text), segment.style)
