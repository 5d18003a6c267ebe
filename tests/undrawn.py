"""What takes most of a short run, and most tests look at none of: figures, and the bench's own
check of its cameras.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any
from unittest.mock import patch

NO_FIGURE = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"/>'


@contextmanager
def undrawn() -> Iterator[None]:
    """Each SVG is `NO_FIGURE`: figures are made, but neither laid out nor rendered."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    render = Figure.savefig

    def savefig(figure: Figure, file: Any, **how: Any) -> None:
        if how["format"] == "svg":
            file.write(NO_FIGURE)
        else:
            render(figure, file, **how)

    with (
        _here(),
        patch.object(Figure, "savefig", savefig),
        patch.object(ConstrainedLayoutEngine, "execute", lambda *_: None),
    ):
        yield


@contextmanager
def without_figures() -> Iterator[None]:
    """No figure is made at all."""
    with _here(), patch("reports.figures.drawing.draw", lambda _: NO_FIGURE):
        yield


def _here() -> AbstractContextManager[object]:
    """No other process draws figures."""
    return patch("bench.report.growing.processors", lambda: 1)


@contextmanager
def bare() -> Iterator[None]:
    """As `without_figures`, and the cameras of a run are not checked with its known ends."""
    with without_figures(), patch("bench.run.trial.where_seen", lambda *_: {}):
        yield
