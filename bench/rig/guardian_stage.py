"""The guardian's part for a stage: opens its port, has it stop, and reads back that it stands."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from instruments.bath.sequence import cause_of
from instruments.clock import RealClock, stopwatch_s
from instruments.errors import LinkError

PLUGIN = "plugin:"  # the URLs of drivers that are another package's
STAGE_S = 60.0  # between the first try and the last: then its move has ended by itself
PAUSE_S = 1.0  # between attempts, but for the first few


def retried(
    make_safe: Callable[[], object],
    clock: RealClock,
    for_s: float,
    note: Callable[[dict[str, Any]], object],
    end_bench: Callable[[], None] | None,
) -> bool:
    """``make_safe`` until it succeeds, for ``for_s``; ``note`` gets each try: its number, and its
    ``error`` or how many ``seconds`` all took. ``end_bench`` ends a bench that hangs and holds the
    port.
    """
    start_s, tries = stopwatch_s(), 0
    while True:
        tries += 1
        try:
            make_safe()
        except Exception as error:  # whatever it is, the next try may succeed
            note({"tries": tries, "error": cause_of(error)})
            if end_bench and isinstance(error, LinkError):
                end_bench()
                end_bench = None
            if stopwatch_s() - start_s > for_s:
                return False
            clock.sleep(min(PAUSE_S, 0.1 * tries))
            continue
        note({"tries": tries, "seconds": round(stopwatch_s() - start_s, 3)})
        return True


@dataclass(frozen=True, slots=True)
class StageTarget:
    """A stage, as its driver is made."""

    url: str
    baud: int
    dialect: str
    axes: str


class StageStop:
    """Stops the stage ``at``, on a thread beside the bath; loads all that it needs now."""

    def __init__(self, at: StageTarget, clock: RealClock) -> None:
        from instruments.link import Link
        from instruments.stage.driver import OwnStage

        plugged = None
        if at.url.startswith(PLUGIN):
            from instruments.drivers.entry_points import load, plugin_url
            from instruments.drivers.stage import PluggedStage

            if plug := plugin_url(at.url):
                plugged = load("stage", plug)

        def stop() -> None:
            if plugged:
                with closing(PluggedStage(plugged, clock, at.axes)) as stage:
                    stage.safe()
                return
            with closing(Link(at.url, clock, who="stage", baud=at.baud)) as link:
                OwnStage(link, clock, at.axes, dialect=at.dialect).safe()  # type: ignore[arg-type]

        self._stop = stop
        self._clock = clock
        self._found: dict[str, Any] = {}
        self._thread: threading.Thread | None = None

    def begin(self, end_bench: Callable[[], None] | None = None) -> None:
        """``end_bench`` as in `retried`."""

        def work() -> None:
            stands = retried(self._stop, self._clock, STAGE_S, said.update, end_bench)
            self._found = {"stands": stands, **said}

        said: dict[str, Any] = {}
        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def result(self) -> dict[str, Any] | None:
        """What became of it, after STAGE_S at most; None where it was not begun."""
        if self._thread is None:
            return None
        self._thread.join()
        return self._found
