"""``python -m bench.report.beside``: a process that draws figures beside the one that writes a
report. It is asked a function of `reports.figures` and its arguments, and answers the SVG.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from bench.workers import WorkerProcess, opened
from reports.figures.drawing import SvgFunction, drawn_elsewhere

AT_ONCE = 3  # chapters: a figure here, one in the process, and numbers
LIMIT_S = 30.0  # for a figure, which takes a tenth of a second


class FigureProcess(WorkerProcess):
    """The process, until its `end`. What it doesn't draw is drawn here, with the same bytes."""

    def __init__(self) -> None:
        self._answers = queue.SimpleQueue[str | None]()
        self._free = threading.Lock()
        super().__init__(__name__, self._answers.put)

    def wait(self) -> None:
        """Until it has loaded what it needs, and sleeps until it is asked again."""
        from reports.figures.course import latency_strip

        self.draw(latency_strip, ([1.0], [2.0]), {})

    def draw(self, figure: SvgFunction, args: Sequence[Any], more: Mapping[str, Any]) -> str:
        """The SVG; "" for what it can't draw, while it draws another, and once it is gone."""
        if not self._free.acquire(blocking=False):
            return ""
        drawn: str | None = None
        try:
            self.ask((figure, args, more))
            drawn = self._answers.get(timeout=LIMIT_S)
        except Exception:  # silent for too long, or asked what no pickle holds
            self.kill("can't draw")
        finally:
            if drawn is not None:
                self._free.release()
        return drawn or ""


def each_made(
    chapters: Iterable[Iterable[Any]], process: FigureProcess | None
) -> list[tuple[Any, ...]]:
    """What each chapter holds; with a process some are made beside each other, and of their figures
    some are drawn there.
    """
    if process is None:
        return [*map(tuple, chapters)]
    with drawn_elsewhere(process.draw), ThreadPoolExecutor(AT_ONCE) as threads:
        return [*threads.map(tuple, chapters)]


def main() -> None:
    """Draw until the input ends; an error is raised where the figure is drawn again."""
    asked, answer = opened()
    while (request := asked()) is not None:
        figure, args, more = request
        try:
            answer(figure(*args, **more))
        except Exception:
            answer("")


if __name__ == "__main__":
    main()
