"""A board as a PDF in its true size, with a line to check the printer by."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from bench.config import ConfigError
from bench.rig.loading import drawn
from detector.calibration.boards import Board
from instruments.world.boards import dark_parts_mm

MM_PER_INCH = 25.4
MARGIN_MM = 15.0
FOOT_MM = 12.0
RULER_MM = 100.0
PAPERS_MM: dict[str, tuple[float, float]] = {
    "A4": (297, 210),
    "A3": (420, 297),
    "A2": (594, 420),
    "A1": (841, 594),
    "A0": (1189, 841),
}


def board_pdf(board: Board, paper: str | None = None) -> bytes:
    """The board as PDF on a landscape sheet, the smallest if none is named. Raises ConfigError."""
    written = io.BytesIO()
    board_figure(board, paper).savefig(
        written, format="pdf", metadata={"CreationDate": None, "Title": "Calibration board"}
    )
    return written.getvalue()


def board_figure(board: Board, paper: str | None = None) -> Figure:
    """The same as a figure, one inch of it an inch of paper."""
    width, height = sheet_mm(board, paper)
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    from matplotlib.backends.backend_pdf import FigureCanvasPdf  # late: loads fontTools

    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(height, 0.0))
    axes.axis("off")
    pattern = drawn(board, 0.0)
    corner = (np.array([width, height - FOOT_MM]) - pattern.size_mm) / 2
    # one path for all: no seams between a marker's modules
    parts = [
        Path(np.vstack([part, part[:1]]) + corner, closed=True) for part in dark_parts_mm(pattern)
    ]
    axes.add_patch(PathPatch(Path.make_compound_path(*parts), color="black", linewidth=0))
    foot = height - FOOT_MM / 2
    axes.plot([MARGIN_MM, MARGIN_MM + RULER_MM], [foot, foot], color="black", linewidth=0.8)
    for x in (MARGIN_MM, MARGIN_MM + RULER_MM):
        axes.plot([x, x], [foot - 2, foot + 2], color="black", linewidth=0.8)
    more = f", markers {board.marker_mm} mm ({board.dictionary})" if board.marker_mm else ""
    more += f", circles {board.circle_mm} mm" if board.circle_mm else ""
    text = (
        f"This line is {RULER_MM:g} mm long. {board.kind} of {board.columns} x {board.rows} points,"
        f" pitch {board.pitch_mm:g} mm{more}. Print at 100 %, glue it flat, measure the pitch,"
        " write it into the file."
    )
    axes.text(MARGIN_MM + RULER_MM + 5, foot, text, fontsize=7, va="center")
    return figure


def sheet_mm(board: Board, paper: str | None) -> tuple[float, float]:
    """Width and height of the sheet. Raises ConfigError."""
    width, height = (size + 2 * MARGIN_MM for size in board.size_mm)
    height += FOOT_MM
    fits = [name for name, (w, h) in PAPERS_MM.items() if w >= width and h >= height]
    needs = f"the board needs {width:.0f} x {height:.0f} mm with its margin, more than"
    if not fits:
        raise ConfigError.plain(f"{needs} A0 has")
    if paper is not None and paper not in fits:
        raise ConfigError.plain(f"{needs} {paper} has; it fits {fits[0]}")
    return PAPERS_MM[paper or fits[0]]
