"""``python -m bench.report.beside``: a process that draws figures beside the one that writes a
report. It is asked a function of `reports.figures` and its arguments, and answers the SVG.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from bench.workers import WorkerProcess, opened
from reports.figures.drawing import SvgFunction, drawn_later
from reports.page import Figure, Fold, Page, Section

STANDS_FOR = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"><title>{}</title></svg>'
Figured = tuple[SvgFunction, Sequence[Any], Mapping[str, Any]]
LIMIT_S = 30.0  # for a figure, which takes a tenth of a second


class FigureProcess(WorkerProcess):
    """The process, until its `end`. What it doesn't draw is drawn here, with the same bytes."""

    def __init__(self) -> None:
        self._answers = queue.SimpleQueue[str | None]()
        self._gone = False
        super().__init__(__name__, self._answers.put)

    def wait(self) -> None:
        """Until it has loaded what it needs, and sleeps until it is asked again."""
        from reports.figures.course import latency_strip

        self.draw(latency_strip, ([1.0], [2.0]), {})

    def draw(self, figure: SvgFunction, args: Sequence[Any], more: Mapping[str, Any]) -> str:
        """The SVG; "" for what it can't draw, and once it is gone."""
        if self._gone:
            return ""
        drawn: str | None = None
        try:
            self.ask((figure, args, more))
            drawn = self._answers.get(timeout=LIMIT_S)
        except Exception:  # silent for too long, or asked what no pickle holds
            self.kill("can't draw")
        finally:
            self._gone = drawn is None
        return drawn or ""


@contextmanager
def drawn_beside(process: FigureProcess | None) -> Iterator[Callable[[Page], Page]]:
    """While the block runs, figures are drawn in ``process``, and parts have what stands for them.
    The function gives the page with all figures: those that are left are drawn here too, each by
    whichever is free. Without a process each is drawn at once.
    """
    if process is None:
        yield lambda page: page
        return
    asked, drawn = queue.SimpleQueue[tuple[str, Figured] | None](), dict[str, str]()
    figures: dict[str, Figured] = {}

    def later(*figure: Any) -> str:
        stands_for = STANDS_FOR.format(len(figures))
        figures[stands_for] = figure
        asked.put((stands_for, figure))
        return stands_for

    def draw(by: Callable[..., str]) -> None:
        while one := asked.get():
            drawn[one[0]] = by(*one[1])

    def finished(page: Page) -> Page:
        for _ in range(2):
            asked.put(None)
        with drawn_later(None):
            draw(_here)
            there.result()
            for stands_for, figure in figures.items():
                drawn[stands_for] = drawn[stands_for] or _here(*figure)
        return replace(page, sections=tuple(_filled(one, drawn) for one in page.sections))

    with ThreadPoolExecutor(1) as thread, drawn_later(later):
        there = thread.submit(draw, process.draw)
        try:
            yield finished
        finally:
            asked.put(None)


def _here(figure: SvgFunction, args: Sequence[Any], more: Mapping[str, Any]) -> str:
    return figure(*args, **more)


def _filled(part: Any, drawn: Mapping[str, str]) -> Any:
    """The part with its figures, those in a fold too."""
    if isinstance(part, Figure) and part.svg in drawn:
        return replace(part, svg=drawn[part.svg])
    if isinstance(part, Fold | Section):
        return replace(part, parts=tuple(_filled(one, drawn) for one in part.parts))
    return part


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
