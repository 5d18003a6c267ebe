"""The guardian's part for a stage: opens its port, has it stop, and reads back that it stands."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

from instruments.bath.sequence import cause_of
from instruments.clock import RealClock, stopwatch_s
from instruments.errors import LinkError

if TYPE_CHECKING:
    from instruments.drivers.protocols import Stage as AnyStage

STAGE_S = 60.0  # between the first try and the last: then its move has ended by itself
PAUSE_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--stage-url", default="")
    add("--stage-baud", type=int, default=115200)
    add("--stage-dialect", default="grbl")
    add("--stage-axes", default="XY")
    add("--stage-motors", default="", help="of a Zaber: device, axis and microsteps; next")


class StageStop:
    """Stops the stage that ``given`` names, on a thread beside the bath. All that it needs is
    loaded when this is made.
    """

    def __init__(self, given: argparse.Namespace, clock: RealClock) -> None:
        from instruments.link import Link
        from instruments.stage.driver import Stage
        from instruments.stage.zaber import Motor

        motors = []
        for words in filter(None, given.stage_motors.split(";")):
            device, axis, microsteps = words.split()
            motors.append(Motor(int(device), int(axis), float(microsteps)))

        opened: Callable[[], AnyStage] | None = None
        if given.stage_url.startswith("plugin:"):
            from instruments.drivers.entry_points import load, plugin_url
            from instruments.drivers.stage import PluggedStage

            plug = plugin_url(given.stage_url)
            assert plug  # noqa: S101 - it begins so
            plugged = load("stage", plug)
            opened = partial(PluggedStage, plugged, clock, given.stage_axes)

        def stop() -> None:
            if opened:
                with closing(opened()) as stage:
                    stage.safe()
                return
            with closing(Link(given.stage_url, clock, who="stage", baud=given.stage_baud)) as link:
                axes, dialect = given.stage_axes, given.stage_dialect
                Stage(link, clock, axes, dialect=dialect, motors=motors).safe()

        self._stop = stop
        self._clock = clock
        self._found: dict[str, Any] = {}
        self._thread: threading.Thread | None = None

    def begin(self, end_bench: Callable[[], None] | None = None) -> None:
        """``end_bench`` ends a bench that hangs and holds the port."""
        self._thread = threading.Thread(target=self._try, args=(end_bench,), daemon=True)
        self._thread.start()

    def result(self) -> dict[str, Any] | None:
        """What became of it, after STAGE_S at most; None where it was not begun."""
        if self._thread is None:
            return None
        self._thread.join()
        return self._found

    def _try(self, end_bench: Callable[[], None] | None) -> None:
        start_s, tries = stopwatch_s(), 0
        while True:
            tries += 1
            try:
                self._stop()
            except Exception as error:  # whatever it is, the next try may succeed
                self._found = {"stands": False, "tries": tries, "error": cause_of(error)}
                if end_bench and isinstance(error, LinkError):
                    end_bench()
                    end_bench = None
                if stopwatch_s() - start_s > STAGE_S:
                    return
                self._clock.sleep(min(PAUSE_S, 0.1 * tries))
                continue
            took_s = round(stopwatch_s() - start_s, 3)
            self._found = {"stands": True, "tries": tries, "seconds": took_s}
            return
