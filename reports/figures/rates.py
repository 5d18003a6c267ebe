"""Shares as plots, with the counts that they come from. A share of nothing is "not measured"."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from reports.figures.drawing import COLOURS, HALF_INCHES, draw, legend, not_measured, plain


def found_bars(
    situations: Sequence[str],
    found: Sequence[int],
    present: Sequence[int],
    thesis_found: Sequence[int | None],
    *,
    thesis_present: int = 4,
    name: str = "found-bars",
) -> str:
    """Share of the teats found in each situation, ours over the thesis's, with the counts written out. None: the thesis gives no figure."""
    if not len(situations) == len(found) == len(present) == len(thesis_found):
        lengths = f"{len(situations)} situations, {len(found)} found, {len(present)} present, {len(thesis_found)} of the thesis"
        raise ValueError(f"found_bars: {lengths}; the lengths differ")
    inches = (HALF_INCHES, 0.9 + 0.52 * max(len(situations), 3))
    if not situations:
        return not_measured(name, inches, "no situation was run")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        for row, (ours, of, theirs) in enumerate(zip(found, present, thesis_found, strict=True)):
            _share_bar(axes, row - 0.2, ours, of, "ours")
            if theirs is not None:
                _share_bar(axes, row + 0.2, theirs, thesis_present, "theirs")
        axes.set(xlim=(0, 1.28), xlabel="share of visible teats found", ylim=(len(situations) - 0.45, -0.55))
        axes.set_yticks(range(len(situations)), [plain(text) for text in situations])
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1])
        axes.xaxis.set_major_formatter(PercentFormatter(1))
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        legend(figure, [("this run", "ours", "patch"), ("thesis, section 5.2", "theirs", "patch")])

    return draw(name, inches, plot)


def _share_bar(axes: Axes, y: float, found: int, of: int, role: str) -> None:
    if of:
        axes.barh(y, found / of, height=0.36, color=COLOURS[role])
    text = f"{found} of {of}" if of else "not measured"
    axes.text((found / of if of else 0) + 0.02, y, text, va="center", color=COLOURS[role])
