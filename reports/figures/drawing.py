"""What every plot needs: checks of arrays, matplotlib to SVG, and a choice of what to draw of many
points.

The SVG has the same bytes for the same input. Styles become attributes and classes, so that a style
sheet can recolour them (dark, print) under a strict content security policy; ids without a
reference go, the others get the figure's name as prefix.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache, wraps
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, ParamSpec

import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from numpy.typing import ArrayLike, NDArray

from reports.sanitize import sanitized
from reports.trust import checked_slug

Floats = NDArray[np.float64]


def finite(function: str, argument: str, values: ArrayLike) -> Floats:
    """`values` as float64. Raises ValueError that counts the values that are not finite."""
    array = np.asarray(values, dtype=np.float64)
    bad = int(array.size - np.isfinite(array).sum())
    if bad:
        raise ValueError(
            f"{function}: {argument} holds {bad} of {array.size} values that are not finite; leave"
            " out what was not measured"
        )
    return array


def together(function: str, **named: ArrayLike) -> list[Floats]:
    """The named arrays, flat. Raises ValueError where one is not finite."""
    return [finite(function, key, values).ravel() for key, values in named.items()]


# One colour a role. The hex value is the light scheme's and stands in the file; the style sheet
# overrides it by class.
COLOURS = {
    "ink": "#1b2733",
    "muted": "#5a6875",
    "grid": "#d8dee5",
    "ours": "#1d5fa6",
    "theirs": "#8a5a00",
    "limit": "#b3261e",
    "accept": "#7a4b9e",
    "good": "#1b7a3d",
    "band": "#cfe6d6",
    "span": "#dfe9f5",
    "paper": "#fdfdfe",
}
HALF_INCHES, WIDE_INCHES = 4.7, 9.4
THIRD_INCHES = 3.6  # three beside each other, whose text is then no smaller than that of halves
NO_PAIR = "no teat end was paired with a truth"
Marker = Literal["o", "s", "^", "D", "v", "P", "X"]
# each detector has a colour and a mark by its place, as over the frames (reports.frames.places_of)
_DETECTOR_ROLES = ("ours", "theirs", "accept", "ink")
_DETECTOR_MARKS: tuple[Marker, ...] = ("X", "s", "^", "D")
LegendForm = Literal["-", "--", "patch"] | Marker
LegendEntry = tuple[str, str, LegendForm]  # text, role, form
_ROLES = {colour: role for role, colour in COLOURS.items()}
_INK, _MUTED = COLOURS["ink"], COLOURS["muted"]
_STYLE = str(Path(__file__).with_name("plots.mplstyle"))
_COLOURED = {
    **dict.fromkeys(
        ("text.color", *(f"{of}tick.labelcolor" for of in "xy"), "axes.labelcolor"), _INK
    ),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), _MUTED),
    "grid.color": COLOURS["grid"],
}
_TAG = re.compile(r"<(/?)([A-Za-z]+)([^<>]*?)(/?)>")
_ATTRIBUTE = re.compile(r'([\w:-]+)="([^"]*)"')
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}(?:e-?\d+)?")
_PAD, _GAP = 0.4, 4.0  # about axes, in font sizes; to what stands above or below them, points
_FEWEST_ALIKE = 4  # marks, for which it is worth while to say once what they share
_MARK = r'<use class="{0}" href="{1}" (?:x="[^"]*" y="[^"]*"){2}/>'
_MARKS = re.compile(
    _MARK.format('([^"]*)', '([^"]*)', '((?: [a-z-]+="[^"]*")*)')
    + "(?:"
    + _MARK.format(r"\1", r"\2", r"\3")
    + f"){{{_FEWEST_ALIKE - 1},}}"
)
_LINK = r'<a href="[^"]*" tabindex="-1"><title>[^<]*</title><g clip-path="{0}">{1}</g></a>'
_LINKS = re.compile(
    _LINK.format('([^"]*)', _MARK.format('([^"]*)', '([^"]*)', '((?: [a-z-]+="[^"]*")*)'))
    + "(?:" + _LINK.format(r"\1", _MARK.format(r"\2", r"\3", r"\4")) + f"){{{_FEWEST_ALIKE - 1},}}"
)  # fmt: skip


# Yields a figure's name (a slug, unique in the page), its size in inches, and why there is nothing
# to draw, or ""; gets the figure, and draws on it. Where there is nothing, it isn't asked to.
Plot = Generator[tuple[str, tuple[float, float], str], Figure, None]
P = ParamSpec("P")
SvgFunction = Callable[..., str]
Later = Callable[[SvgFunction, Sequence[Any], Mapping[str, Any]], str]
_later: ContextVar[Later | None] = ContextVar("_later", default=None)


def plotted(plot: Callable[P, Plot]) -> Callable[P, str]:
    """The SVG of what ``plot`` draws, or one of that size that says that nothing was measured."""

    @wraps(plot)
    def svg(*args: P.args, **kwargs: P.kwargs) -> str:
        later: Later | None = _later.get()
        return later(svg, args, kwargs) if later else draw(plot(*args, **kwargs))

    return svg


@contextmanager
def drawn_later(later: Later | None) -> Iterator[None]:
    """Meanwhile ``later`` gets each figure's function and arguments, and gives what stands for its
    SVG; None: each is drawn at once.
    """
    before = _later.set(later)
    try:
        yield
    finally:
        _later.reset(before)


class _Canvas(FigureCanvasSVG):
    """All figures measure their text with one renderer, which keeps what it has measured."""

    @staticmethod
    @cache
    def get_renderer() -> RendererSVG:
        return RendererSVG(0, 0, io.StringIO())  # type: ignore[no-untyped-call]


def draw(plot: Plot) -> str:
    """A user's matplotlibrc changes nothing, and is as before afterwards."""
    name, inches, nothing = next(plot)
    checked_slug(name, "figure name")
    with warnings.catch_warnings(), style.context(["default", _STYLE, _COLOURED]):
        # matplotlib's font only measures the text here; the page's font draws it, and may well have
        # the letter.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure = Figure(figsize=inches, dpi=FigureCanvasSVG.fixed_dpi)
        _Canvas(figure)
        if nothing:
            look: dict[str, Any] = {"ha": "center", "va": "center", "color": COLOURS["muted"]}
            figure.text(0.5, 0.55, "not measured", fontsize=12, **look)
            figure.text(0.5, 0.42, nothing, **look)
        else:
            with suppress(StopIteration):
                plot.send(figure)
        _lay_out(figure)
        written = io.StringIO()
        figure.savefig(
            written,
            format="svg",
            transparent=True,
            metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
        )
    svg = written.getvalue()
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<(style|metadata)\b.*?</\1>", "", body, flags=re.DOTALL)
    wanted = set(re.findall(r'(?:url\(|xlink:href=")#([^")]+)', body))
    known = dict.fromkeys(found for found in re.findall(r'\bid="([^"]*)"', body) if found in wanted)
    # short: every point of a cloud names one
    defined = {known_id: f"{name}-{number}" for number, known_id in enumerate(known, 1)}
    body = _TAG.sub(lambda tag: _rewritten(tag, name, defined), body)
    return _MARKS.sub(_grouped, _LINKS.sub(_links, re.sub(r">\s+<", "><", body.strip())))


def _lay_out(figure: Figure) -> None:
    """Place the axes below the legend and above the figure's texts: their surroundings are measured
    once, as "constrained" does it twice, and `savefig` would draw the figure for it once more.
    """
    if not figure.axes:
        return
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.get_label_text():  # else its place is looked for among the ticks
                axis.set_label_coords(0.5, 0.5)
    low, high = (
        max((one.get_window_extent().height + _GAP for one in of), default=0.0) / figure.bbox.height
        for of in (figure.texts, figure.legends)
    )
    equal = [axes for axes in figure.axes if axes.get_aspect() != "auto"]
    for axes in equal:
        axes.set_aspect("auto")  # of equal scales it leaves room that is taken afterwards
    figure.tight_layout(pad=_PAD)
    for axes in equal:
        axes.set_aspect("equal")
    room = figure.subplotpars
    figure.subplots_adjust(bottom=room.bottom + low, top=room.top - high)
    figure.set_layout_engine(None)  # one that stays, "none" too, has it drawn twice


def legend(figure: Figure, entries: Sequence[LegendEntry]) -> None:
    """Above the plot: for each (text, role, form) a line ("-", "--"), a marker or a "patch"."""

    def handle(text: str, role: str, form: LegendForm) -> Artist:
        if form == "patch":
            return Patch(facecolor=COLOURS[role], label=text)
        if form == "-" or form == "--":
            return Line2D([], [], color=COLOURS[role], linestyle=form, label=text)
        return Line2D([], [], **_mark(role, 4.5, form), label=text)

    handles = [handle(*entry) for entry in entries]
    # a wide figure begins at its left where the screen is narrow
    side = "left" if figure.get_figwidth() > HALF_INCHES else "center"
    where: dict[str, Any] = {"loc": f"outside upper {side}", "frameon": False, "handlelength": 1.8}
    for columns in range(len(entries), 0, -1):
        made = figure.legend(handles=handles, ncols=columns, **where)
        if columns == 1 or made.get_window_extent().width <= figure.bbox.width:
            return
        made.remove()


def limits(limit_mm: float, accept_mm: float | None = None) -> list[LegendEntry]:
    """What a legend says of the limit and, where one is drawn, of the acceptance limit."""
    entries: list[LegendEntry] = [(f"limit {limit_mm:g} mm", "limit", "-")]
    if accept_mm is not None:
        entries.append((f"accepted to {accept_mm:.3f} mm", "accept", "--"))
    return entries


def row_names(axes: Axes, names: Sequence[str], most: int = 30) -> None:
    """A row each, the first above."""
    axes.set_yticks(range(len(names)), [plain(text, most) for text in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def detector_look(who: int) -> tuple[str, Marker]:
    """Colour and mark of the detector at the place `who`, from 1; of none in particular for 0."""
    if not who:
        return "ours", "o"
    each, place = len(_DETECTOR_MARKS), who - 1
    return _DETECTOR_ROLES[place % each], _DETECTOR_MARKS[(place + place // each) % each]


def plain(text: str, most: int = 30) -> str:
    """`text` on one line that XML can hold, cut with an ellipsis at `most` letters."""
    line = " ".join(sanitized(text).split())
    return line if len(line) <= most else line[: most - 1].rstrip() + "…"


def _mark(role: str, size: float, form: Marker) -> dict[str, Any]:
    look = {"color": COLOURS[role], "linestyle": "none", "marker": form, "markersize": size}
    return look | {"markeredgewidth": 0}


def marks(
    axes: Axes,
    x: ArrayLike,
    y: ArrayLike,
    role: str = "ours",
    size: float = 4.2,
    form: Marker = "o",
    *,
    line: LegendForm | Literal["none"] = "none",
    **more: Any,
) -> Line2D:
    """Markers at (x, y), joined where `line` is given; `more` are a line's properties."""
    (made,) = axes.plot(x, y, **_mark(role, size, form) | {"linestyle": line} | more)
    return made


def linked(
    axes: Axes,
    x: Floats,
    y: Floats,
    drawn: NDArray[np.intp],
    links: Sequence[str] | None = None,
    *,
    role: str = "ours",
    size: float = 18,
    **more: Any,
) -> None:
    """A cloud of the points `drawn` of (x, y); `links` (n) are what a click on each opens."""
    colour = COLOURS[role]
    points = axes.scatter(x[drawn], y[drawn], s=size, color=colour, linewidths=0, **more)
    if links:
        points.set_urls([links[index] for index in drawn])


def cross_and_circle(axes: Axes, reach: float, limit_mm: float, width: float) -> None:
    """Square axes about 0 that reach so far, and the limit as a circle."""
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.axhline(0, color=COLOURS["muted"], linewidth=0.6)
    axes.axvline(0, color=COLOURS["muted"], linewidth=0.6)
    circle(axes, limit_mm, "limit", linewidth=width)


def circle(axes: Axes, radius_mm: float, role: str, **more: Any) -> None:
    """About 0; `more` are a patch's properties."""
    axes.add_patch(Circle((0, 0), radius_mm, fill=False, edgecolor=COLOURS[role], **more))


def _grouped(run: re.Match[str]) -> str:
    """Marks of one look: a cloud is most of a page's weight."""
    look, _, paint = run.groups()
    inner = run.group(0).replace(f'<use class="{look}"', "<use").replace(f"{paint}/>", "/>")
    return f'<g class="{look}"{paint}>{inner}</g>'


def _links(run: re.Match[str]) -> str:
    """The same of marks that each open something."""
    clip, look, _, paint = run.groups()
    inner = run.group(0).replace(f'<g clip-path="{clip}"><use class="{look}"', "<use")
    inner = inner.replace(f"{paint}/></g>", "/>")
    return f'<g class="{look}" clip-path="{clip}"{paint}>{inner}</g>'


def _rewritten(tag: re.Match[str], name: str, defined: Mapping[str, str]) -> str:
    closing, element, rest, empty = tag.groups()
    if closing:
        return tag.group(0)
    attributes: dict[str, str] = {}
    for key, value in _ATTRIBUTE.findall(rest):
        if key == "style":
            pairs = (part.split(":", 1) for part in value.split(";") if part.strip())
            known = {what.strip(): of.strip() for what, of in pairs}
            known.pop("font-family", None)  # the page's
            if "font-size" in known:
                known["font-size"] = known["font-size"].removesuffix("px")
            attributes |= known
        else:
            attributes[key.removeprefix("xlink:")] = value
    title = ""
    if element == "svg":
        kept = {key: attributes[key] for key in ("viewBox", "xmlns")}
        attributes = {"class": f"plot plot-{name}", **kept}
    if element == "a":
        attributes = {"href": attributes["href"], "tabindex": "-1"}
        title = f"<title>{attributes['href'].removeprefix('#')}</title>"
    colours = {key: _ROLES.get(attributes.get(key, "")) for key in ("fill", "stroke")}
    classes = " ".join(f"{key}-{role}" for key, role in colours.items() if role)
    if classes:
        attributes = {"class": classes, **attributes}
    text = "".join(
        f' {key}="{_value(key, value, defined)}"'
        for key, value in attributes.items()
        if not (key == "id" and value not in defined)
        and not (key == "transform" and value.startswith("rotate(-0 "))
        and key != "target"
    )
    return f"<{element}{text}{empty}>{title}"


def _value(key: str, value: str, defined: Mapping[str, str]) -> str:
    if key == "id":
        return defined[value]
    if key in {"href", "clip-path"}:
        target = value.removeprefix("url(").removesuffix(")").removeprefix("#")
        return value.replace(f"#{target}", f"#{defined[target]}") if target in defined else value
    return _LONG_NUMBER.sub(lambda number: f"{float(number.group(0)):.2f}", " ".join(value.split()))


MOST_POINTS = 200  # in one plot
MOST_STEPS = 400  # of a curve


def subsample(weight: Floats, most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Indices of at most `most` of n points: of greatest `weight` (n,), and some of the rest."""
    if weight.size <= most:
        return np.arange(weight.size)
    order = np.argsort(-weight, kind="stable")
    heavy, rest = order[: most // 2], np.sort(order[most // 2 :])
    others = rest[np.linspace(0, rest.size - 1, most - heavy.size).round().astype(np.intp)]
    return np.union1d(heavy, others)


def count_text(drawn: int, of: int) -> str:
    """What a figure says of the choice."""
    return f"{drawn} of {of} drawn, the worst among them"


def envelope(values: Floats, most: int = MOST_STEPS) -> NDArray[np.intp]:
    """Indices of the least and greatest of each stretch of a curve (n,), its ends included."""
    if values.size <= 2 * most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, most + 1).round().astype(np.intp)
    parts = [
        (start + int(values[start:end].argmin()), start + int(values[start:end].argmax()))
        for start, end in pairwise(edges)
    ]
    return np.unique([0, *(index for pair in parts for index in pair), values.size - 1])
