"""Measured sensitivity as files: a figure a quantity, the numbers as CSV, a table in Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from bench.campaign.limits import DISPARITY_PX
from bench.campaign.quantities import Quantity
from bench.campaign.sensitivity import Measured
from bench.config import ConfigError, writing
from bench.report.wording import NOT_MEASURED
from bench.scoring.errors import Floats, summarise_radial
from reports.figures.drawing import COLOURS
from reports.figures.sensitivity import MOST_CURVES, Bound, Curve, sensitivity
from reports.sanitize import csv_text

COLUMNS = (
    *("quantity", "value", "detector", "visible", "found", "false", "no_answer", "median_mm"),
    *("p95_mm", "max_mm", "limit_median_mm", "limit_p95_mm", "disparity_mm", "limit_share"),
)
POINTS, PAGE = "points.csv", "measured.md"
LINES = f"""In the figures:

- full, discs: median 3-D error of the ends found; dashed, triangles: 95th percentile; below: the
  share found
- red: the best possible median from both pictures (Cramér and Rao): an edge of contrast C, blur
  σ_b and noise σ_n holds C² / (2 √π σ_b σ_n²) of information a pixel of length; for the
  calibration: error-free pixels with the calibration that detectors were given
- green: disparity to {DISPARITY_PX:g} px, 0.67 · Z² / (f B) · {DISPARITY_PX:g} px; Z² / (f B) is 9
  mm a pixel on the thesis's geometry
- red, below: what heat allows, a matched filter at one false alarm a frame (Neyman and Pearson)"""
Results = Mapping[str, Sequence[Measured]]
Row = Mapping[str, str]


def check_curves(names: Sequence[str]) -> None:
    """Raises ConfigError where a figure can't show so many detectors."""
    if len(names) > MOST_CURVES:
        raise ConfigError.plain(
            f"a figure shows {MOST_CURVES} detectors at most, {len(names)} are asked for:"
            f" {', '.join(names)}"
        )


def no_answers(frame_sets: int) -> str:
    """What stands behind a count of ends; empty where every frame set had an answer."""
    return f" (without an answer on {frame_sets})" if frame_sets else ""


def write_figure(folder: Path, quantity: Quantity, points: Sequence[Measured]) -> Path:
    """The quantity's SVG, to stand alone. Raises ConfigError where it can't be written."""
    start, rest = figure_of(quantity, points).split(">", 1)
    # a page brings its own paper and letters, a file must
    paper = f'<rect width="100%" height="100%" fill="{COLOURS["paper"]}"/>'
    text = f'{start} font-family="system-ui, sans-serif">{paper}{rest}\n'
    return _written(folder / f"{quantity.name}.svg", text)


def write_numbers(
    folder: Path, quantities: Sequence[Quantity], results: Results, made_with: str
) -> None:
    """All numbers as CSV and Markdown; ``made_with`` is a sentence. Raises ConfigError."""
    rows = [
        dict(zip(COLUMNS, row, strict=True))
        for quantity in quantities
        for row in _rows(quantity, results[quantity.name])
    ]
    _written(folder / POINTS, csv_text([COLUMNS, *(list(row.values()) for row in rows)]))
    _written(folder / PAGE, numbers_page(quantities, rows, made_with))


def numbers_page(quantities: Sequence[Quantity], rows: Sequence[Row], made_with: str) -> str:
    """The page of ``rows``, as they stand in the CSV file."""
    tables = [
        _table(quantity, [row for row in rows if row["quantity"] == quantity.name])
        for quantity in quantities
    ]
    return "\n\n".join(["# Sensitivity as measured", made_with, LINES, *tables]) + "\n"


def figure_of(quantity: Quantity, points: Sequence[Measured]) -> str:
    """The SVG text: errors and shares of every detector over the quantity, beside the limit."""
    bounds = [(point.value, point.limit) for point in points if point.limit]
    rows = [(value, limit.median_mm, limit.disparity_mm) for value, limit in bounds]
    shares = [(value, limit.share) for value, limit in bounds if limit.share is not None]
    x, median_mm, disparity_mm = _columns(rows, 3)
    bound = Bound(x, median_mm, disparity_mm, DISPARITY_PX, *_columns(shares, 2))
    return sensitivity(
        [_curve(name, points) for name in (points[0].tallies if points else ())],
        bound,
        quantity.label,
        logarithmic=quantity.logarithmic,
        name=f"sensitivity-{quantity.name}",
    )


def _curve(name: str, points: Sequence[Measured]) -> Curve:
    tallies = [(point, point.tallies[name].distances_mm) for point in points]
    found = [
        (point.value, summary.median_mm, summary.p95_mm)
        for point, summary in ((point, summarise_radial(mm)) for point, mm in tallies)
        if summary.median_mm is not None and summary.p95_mm is not None
    ]
    shares = [(point.value, len(mm) / point.visible) for point, mm in tallies if point.visible]
    return Curve(name, *_columns(found, 3), *_columns(shares, 2))


def _columns(rows: Sequence[tuple[float, ...]], count: int) -> Floats:
    return np.array(rows, dtype=np.float64).reshape(-1, count).T


def _rows(quantity: Quantity, points: Sequence[Measured]) -> Iterator[tuple[str, ...]]:
    for point in points:
        limit = point.limit
        allowed: tuple[float | None, ...] = (None,) * 4
        if limit:
            allowed = (limit.median_mm, limit.p95_mm, limit.disparity_mm, limit.share)
        for name, tally in point.tallies.items():
            errors = summarise_radial(tally.distances_mm)
            counts = (point.visible, len(tally.distances_mm), tally.false, tally.failures)
            numbers = (errors.median_mm, errors.p95_mm, errors.max_mm, *allowed)
            texts = ("" if number is None else f"{number:.4f}" for number in numbers)
            yield quantity.name, f"{point.value:g}", name, *map(str, counts), *texts


def _table(quantity: Quantity, rows: Sequence[Row]) -> str:
    """One quantity in Markdown: a row a value, three columns a detector."""
    names = dict.fromkeys(row["detector"] for row in rows)
    heads = [f"{name}: {what}" for name in names for what in ("found", "false", "median, p95 (mm)")]
    heads = [quantity.label, *heads, "limit: median, p95 (mm)"]
    heads += ["limit: found"] if quantity.thermal else []
    lines = [heads]
    for value in dict.fromkeys(row["value"] for row in rows):
        of_value = [row for row in rows if row["value"] == value]
        line = [value]
        for row in of_value:
            found = f"{row['found']} of {row['visible']}{no_answers(int(row['no_answer']))}"
            line += [found, row["false"], _pair(row, "median_mm", "p95_mm", 2)]
        line.append(_pair(of_value[0], "limit_median_mm", "limit_p95_mm", 3))
        if quantity.thermal:
            share = of_value[0]["limit_share"]
            line.append(f"{100 * float(share):.0f} %" if share else NOT_MEASURED)
        lines.append(line)
    head, *texts = (f"| {' | '.join(line)} |" for line in lines)
    rule, figure = "|" + "---|" * len(heads), f"![{quantity.label}]({quantity.name}.svg)"
    start = f"## {quantity.name}\n\n{quantity.about}\n\n{figure}\n"
    return "\n".join([start, head, rule, *texts])


def _pair(row: Row, first: str, second: str, digits: int) -> str:
    if not row[first]:
        return NOT_MEASURED
    return f"{float(row[first]):.{digits}f}, {float(row[second]):.{digits}f}"


def _written(path: Path, text: str) -> Path:
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")
    return path
