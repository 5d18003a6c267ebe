"""From a `Page` to HTML files that open from disk with no network: the same bytes for the same
page.

Jinja2 escapes every text but our own style sheet and script, checked drawings, and numbers. A
content security policy allows only that style sheet and script, by hash, and images. Few trials are
in the page; many get a file each.
"""

import base64
import hashlib
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from reports.frames import (
    Circle,
    Ellipse,
    ImageView,
    Label,
    Polyline,
    Rect,
    Shape,
    answer_colour,
    answer_mark,
    layers,
    places_of,
)
from reports.glossary import GlossaryLinks, Term, style_rules
from reports.page import WORDS, Cell, Column, Drawn, Figure, Page, Part, Section, Table, TrialPart
from reports.sanitize import page_text, sanitized
from reports.trust import PageError, address
from textfiles.whole import new_folders, replace_all, replace_whole

IN_PAGE = 40  # trials, each counted once a detector: more get a file each
TRIALS = "trials"  # their folder
MOST_BYTES = 1_000_000  # of a page: where it is larger its folded chapters get a file each
GLOSSARY = "glossary.html"
WHOLE = "whole.html"  # all of them in one, for paper
_TEMPLATES = Path(__file__).parent / "templates"

# size of an image, and the part of it that is shown: all that a view's style rule needs
View = tuple[int, int, int, int, int, int]


@dataclass(frozen=True, slots=True)
class Place:
    """Where a file stands, and the trials in it."""

    trials: tuple[TrialPart, ...]
    base: str = ""  # from this file to the report's folder
    file: str = "index.html"
    apart: Mapping[str, str] = field(default_factory=dict)  # files of chapters, by the ids in them

    def picture(self, src: str) -> str:
        """What an image's `src` says."""
        return self.base + address(src, "image")


class TrialRenderer:
    """Draws of a trial what its own file shows of that trial alone."""

    def __init__(self, detectors: Sequence[str], glossary: Sequence[Term]) -> None:
        explain = GlossaryLinks(glossary, f"../{GLOSSARY}", detectors)
        context = _context(Place((), base="../"), places_of(detectors), explain, _outward)
        self._views: dict[View, str] = {}
        context["view_name"] = lambda image: self._views[_view(image)]
        self._parts: Any = environment().get_template("parts.html.j2").make_module(context)

    def __call__(self, trial: TrialPart) -> Drawn:
        self._views, rules = _views(trial.images)
        shown = layers(trial.images)
        switches = self._parts.layer_switches(shown) if shown else ""
        files = dict.fromkeys(path for image in trial.images for path in image.files)
        opening, body = self._parts.trial_opening(trial, 1), self._parts.trial_body(trial)
        return Drawn(str(switches), str(opening), str(body), rules, tuple(files))


def _outward(href: str) -> str:
    """Raises PageError for a link into the page, of which the trial's file knows nothing."""
    if href.startswith("#"):
        raise PageError(f"a trial links to {href!r}; its own file leads to files alone")
    return address(href, "link")


class Renderer:
    """Writes the files of one page."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._ids = {trial.id for trial in page.trials}
        self._places = places_of(page.detectors)
        self._drawn = TrialRenderer(page.detectors, page.glossary)
        style = assets("style.css", "frames.css", "print.css") + style_rules(page.glossary)
        for who in self._places.values():
            style += (
                f".who-{who}{{color:{answer_colour(who)}}}\n"
                f"body:has(#who-{who}:not(:checked)) .pane .who-{who}{{display:none}}\n"
            )
        # what files have in common is hashed once
        self._style, self._begun = style, hashlib.sha256(style.encode())
        self._explained: dict[str, GlossaryLinks] = {}
        self._script = assets("frames.js", "script.js")
        self._environment = environment()

    def page(self, place: Place) -> str:
        """The page's own file. Raises PageError where a trial is neither in it nor listed."""
        if not place.apart:
            _refuse_unlisted(self._page, place)
        return self._fill(place)

    def chapter(self, place: Place, section: Section | None) -> str:
        """The file of a folded chapter, where each has one; of the glossary for None."""
        named = section.title if section else "Glossary"
        return self._fill(place, only=section or "glossary", named=named)

    def trials(self, apart: Mapping[str, str]) -> Iterator[tuple[str, str]]:
        """The files of the trials, in the page's order: names in the folder `trials`, and texts."""
        place = Place((), base="../", file=TRIALS, apart=apart)
        # what all of them have in common is filled in once
        around: Any = self._environment.get_template("trial.html.j2").make_module(
            self._values(place)
        )
        trials = self._page.trials
        for trial, *near in zip(trials, (None, *trials), (*trials[1:], None), strict=False):
            drawn = trial.drawn or self._drawn(trial)
            body = drawn.body
            if "glossary" not in apart:
                body = body.replace(f'href="../{GLOSSARY}#', 'href="../index.html#')
            texts = map(Markup, (drawn.switches, drawn.opening, body))  # our own
            text = around.file(trial, *near, *texts, *self._styled(drawn.rules))
            yield f"{trial.id}.html", str(text)

    def _fill(self, place: Place, **values: Any) -> str:
        looks = () if values.get("only") else self._page.looks()
        more = {"only": None, "named": "", **values}
        shown = [image for one in (*looks, *place.trials) for image in one.images]
        views, rules = _views(shown)
        more |= dict(zip(("style", "policy"), self._styled(rules), strict=True))
        more["view_name"] = lambda image: views[_view(image)]
        template = self._environment.get_template("page.html.j2")
        return template.render(self._values(place), **more)

    def _styled(self, rules: str) -> tuple[Markup, str]:
        """The style sheet with a file's own ``rules``, and the policy that lets it and the script
        in.
        """
        of_style = self._begun.copy()
        of_style.update(rules.encode())
        by_style, by_script = _source(of_style.digest()), policy_hash(self._script)
        return Markup(self._style + rules), (  # noqa: S704 our own file and numbers
            "default-src 'none'; img-src 'self' data: file:; "
            f"style-src '{by_style}'; script-src '{by_script}'; "
            "base-uri 'none'; form-action 'none'"
        )

    def _values(self, place: Place) -> dict[str, Any]:
        """What the templates of a file at ``place`` fill in."""
        here, named = {trial.id for trial in place.trials}, set[str]()

        def is_away(name: str) -> bool:
            return name in self._ids and name not in here and name not in place.apart

        def row_id(row: Sequence[str | Cell]) -> str:
            """Of several rows of a trial the first has its id: an id stands for one thing."""
            name = _trial_of(row)
            if not is_away(name) or name in named:
                return ""
            named.add(name)
            return name

        def to(href: str) -> str:
            file = place.apart.get(href[1:], place.file) if href.startswith("#") else place.file
            if file != place.file:
                return f"{place.base}{file}{href}"
            if href.startswith("#") and is_away(href[1:]):
                return f"{place.base}{TRIALS}/{href[1:]}.html"
            return address(href, "link")

        file = place.apart.get("glossary", "index.html")
        glossary = "" if file == place.file else place.base + file
        if glossary not in self._explained:
            links = GlossaryLinks(self._page.glossary, glossary, self._page.detectors)
            self._explained[glossary] = links
        return {
            **_context(place, self._places, self._explained[glossary], to),
            "page": self._page,
            "layers": layers([image for trial in place.trials for image in trial.images]),
            "row_id": row_id,
            "lone": _lone,
            "drawing": lambda figure: _drawing(figure, to if place.apart else None),
            "index": f"{place.base}index.html",
            "listed": place.base + place.apart.get(self._page.trials_in, "index.html"),
            "link": to,
            "script": Markup(self._script),  # noqa: S704 our own file
        }


def _context(
    place: Place, places: Mapping[str, int], explain: GlossaryLinks, link: Callable[[str], str]
) -> dict[str, Any]:
    """What the templates need of any page."""
    return {
        "place": place,
        "places": places,
        "alone": next(iter(places.values())) if len(places) == 1 else 0,
        # in Python, not in the template: the shapes of 1 000 trials are most of a report's text
        "shapes": lambda layer, *view: Markup(  # noqa: S704 escaped
            "".join(_shape(one, *view) for one in layer.shapes)
        ),
        "cell": lambda value: _cell(value, link),
        "cells": lambda row, columns: _cells(row, columns, link),
        "look": _look,
        "answer_mark": lambda who: Markup(_shape(answer_mark(who, 10, 10, 5))),  # noqa: S704 numbers
        "explain": explain,
    }


def _views(images: Sequence[ImageView]) -> tuple[dict[View, str], str]:
    """The names of their views, and the style rules of these."""
    views = {view: f"v{at}" for at, view in enumerate(dict.fromkeys(map(_view, images)))}
    return views, "".join(_view_rule(name, view) for view, name in views.items())


def _trial_of(row: Sequence[str | Cell]) -> str:
    """The id of the trial that a row of a list links to."""
    first = row[0] if row else ""
    return first.href[1:] if isinstance(first, Cell) else ""


def render(page: Page) -> str:
    """The HTML text of the page's own file."""
    return Renderer(page).page(_own(page))


def write_report(
    page: Page,
    folder: Path,
    more: Sequence[tuple[str, bytes]] = (),
    finished: Callable[[Page], Page] = lambda page: page,
) -> Path:
    """Write `folder/index.html`, with `more` files' names and contents, whole or not at all; many
    trials get files of their own before. The page may wait for figures until then: it is asked for
    with all of them, ``finished``. Raises PageError for images that are not there, OSError.
    """
    with new_folders(folder):
        html, index = _written(page, folder, finished), folder / "index.html"
        others = ((folder / name, data) for name, data in more)
        replace_all([*others, (index, html.encode())], synced=True)
    return index


def _written(page: Page, folder: Path, finished: Callable[[Page], Page]) -> str:
    """All files of the page but its first, whose text is given back."""
    refuse_missing(page.files(), folder)
    place = _own(page)
    _refuse_unlisted(page, place)
    folded = [section.id for section in page.sections if section.folded]
    for name in (*(f"{one}.html" for one in folded), GLOSSARY, WHOLE):
        (folder / name).unlink(missing_ok=True)  # of a longer report that stood here
    apart = {}
    if len(place.trials) < len(page.trials):
        apart = _apart(page) if folded else {}  # a page of so many trials is hardly ever small
        _write_trials(page, folder / TRIALS, apart)
    page = finished(page)
    renderer = Renderer(page)
    whole = renderer.page(place)
    if not folded or len(whole.encode()) <= MOST_BYTES:
        if apart:
            _write_trials(page, folder / TRIALS, {})
        return whole
    apart = apart or _apart(page)
    write_whole(folder / WHOLE, whole)
    for section in page.sections:
        if section.folded:
            trials = place.trials if section.id == page.trials_in else ()
            there = replace(place, file=apart[section.id], apart=apart, trials=trials)
            write_whole(folder / there.file, renderer.chapter(there, section))
    if page.glossary:
        there = replace(place, file=GLOSSARY, apart=apart, trials=())
        write_whole(folder / GLOSSARY, renderer.chapter(there, None))
    return renderer.page(replace(place, apart=apart, trials=()))


def _write_trials(page: Page, folder: Path, apart: Mapping[str, str]) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in Renderer(page).trials(apart):
        replace_whole(folder / name, text.encode())


def _refuse_unlisted(page: Page, place: Place) -> None:
    """Raises PageError where a trial is neither at ``place`` nor listed."""
    tables = (table for table in page.parts_of(Table) if table.searchable)
    rows = (row for table in tables for row in table.rows)
    listed = {trial.id for trial in place.trials} | {_trial_of(row) for row in rows}
    if lost := [trial.id for trial in page.trials if trial.id not in listed]:
        raise PageError(
            f"page {page.title!r}: no searchable table begins a row with a link to {lost[:5]}; list"
            " every trial"
        )


def _apart(page: Page) -> dict[str, str]:
    """Each folded chapter's file, by its id and those of the sections in it."""
    files = {section.id: f"{section.id}.html" for section in page.sections if section.folded}
    for section in page.sections:
        if section.folded:
            inner = (part for part in section.parts if isinstance(part, Section))
            files |= {part.id: files[section.id] for part in inner}
    if page.trials_in in files and len(_own(page).trials) == len(page.trials):
        files |= {trial.id: files[page.trials_in] for trial in page.trials}
    return files | {"glossary": GLOSSARY}


def write_whole(target: Path, html: str) -> Path:
    """Writes `html` to `target`, whole or not at all."""
    replace_whole(target, html.encode(), synced=True)
    return target


def refuse_missing(files: Iterable[str], folder: Path) -> None:
    """Raises PageError that lists the image files which are not in `folder`."""
    missing = [path for path in dict.fromkeys(files) if not (folder / path).is_file()]
    if missing:
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        raise PageError(
            f"report in {folder}: {len(missing)} images are not there: {', '.join(missing[:5])}"
            f"{more}; write the images before the page"
        )


def _own(page: Page) -> Place:
    return Place(page.trials if in_page(len(page.trials), len(page.detectors)) else ())


def in_page(trials: int, detectors: int) -> bool:
    """Whether so many trials are in the page itself."""
    return trials <= IN_PAGE // max(1, detectors)


def _lone(parts: Sequence[Part]) -> set[int]:
    """Places in `parts` of half-page figures without a neighbour in their row; they get the row."""
    found: set[int] = set()
    left: int | None = None  # a figure in the left half, whose right half is free
    for at, part in enumerate(parts):
        half = isinstance(part, Figure) and not part.wide
        if half and left is None:
            left = at
            continue
        if left is not None and not half:
            found.add(left)
        left = None
    return found if left is None else {*found, left}


@cache
def environment() -> Environment:
    """Jinja2 as all pages use it, made once: every text is escaped and sanitized."""
    made = Environment(
        loader=FileSystemLoader(_TEMPLATES, encoding="utf-8"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda x: page_text(x) if isinstance(x, str) and not isinstance(x, Markup) else x,
        auto_reload=False,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.globals.update(WORDS)
    made.filters.update(number=_number, slug=lambda word: word.replace(" ", "-"))
    # a file's own words
    made.filters["verbatim"] = lambda text: Markup(escape(sanitized(text)))  # noqa: S704 escaped
    return made


@lru_cache(maxsize=8)  # files of trials have the script in common
def policy_hash(text: str) -> str:
    """How a content security policy names a style sheet or script."""
    return _source(hashlib.sha256(text.encode()).digest())


def _source(sha256: bytes) -> str:
    return f"sha256-{base64.b64encode(sha256).decode('ascii')}"


def assets(*names: str) -> str:
    """The texts of these files, one after the other."""
    texts = [(_TEMPLATES / name).read_text(encoding="utf-8") for name in names]
    unfit = [name for name, text in zip(names, texts, strict=True) if "</" in text]
    if unfit:
        raise PageError(f"reports/templates/{unfit[0]} holds '</', which would end its own element")
    return "".join(texts)


def _drawing(figure: Figure, link: Callable[[str], str] | None) -> Markup:
    """Its links lead through `link`; without one to the page's own rows."""
    svg = figure.svg
    if link is not None:
        hrefs = {one: link(one) or one for one in figure.facts.links}
        svg = re.sub(r'<a href="([^"]*)"', lambda a: f'<a href="{escape(hrefs[a[1]])}"', svg)
    return Markup(svg)  # noqa: S704 page.Figure has checked every element and attribute


@lru_cache(maxsize=1 << 12)
def _escaped(text: str) -> str:
    """Others' text, as plain as HTML takes it."""
    return str(escape(page_text(text)))


def _cell(value: str | Cell, link: Callable[[str], str]) -> Markup:
    """What stands in a cell; its link leads through `link`."""
    if isinstance(value, str):
        return Markup(_escaped(value))  # noqa: S704 escaped
    text, href = _escaped(value.text), link(value.href) if value.href else ""
    if href:
        mono = ' class="mono"' if value.mono else ""
        return Markup(f'<a href="{_escaped(href)}"{mono}>{text}</a>')  # noqa: S704 escaped
    return Markup(f"<code>{text}</code>" if value.mono else text)  # noqa: S704 escaped


def _look(align: str, value: str | Cell) -> str:
    """The classes of what shows a value."""
    tone = "plain" if isinstance(value, str) else value.tone
    return align if tone == "plain" else f"{align} tone-{tone}".strip()


def _cells(
    row: Sequence[str | Cell], columns: Sequence[Column], link: Callable[[str], str]
) -> Markup:
    """A table's row, in Python as shapes are; a first cell that isn't empty is its head."""
    drawn = []
    for number, (value, column) in enumerate(zip(row, columns, strict=True)):
        text, look = _cell(value, link), _look(column.align.replace("left", ""), value)
        tag, scope = ("th", ' scope="row"') if number == 0 and text.strip() else ("td", "")
        if look:
            scope += f' class="{look}"'
        if not isinstance(value, str) and value.sort is not None:
            scope += f' data-sort="{value.sort}"'
        drawn.append(f"<{tag}{scope}>{text}</{tag}>")
    return Markup("".join(drawn))  # noqa: S704 each is escaped


def _shape(it: Shape, right_px: float = math.inf, letter_px: float = 0.0) -> str:
    """In a view that ends at `right_px`, with letters of this size."""
    n = _number
    if isinstance(it, Label):
        x_px, anchor = it.x_px + it.gap_px, "start"
        if x_px + 0.7 * letter_px * len(it.text) > right_px:
            x_px, anchor = it.x_px - it.gap_px, "end"
        at = f'x="{n(x_px)}" y="{n(it.y_px)}" text-anchor="{anchor}"'
        return f"<text {at}>{_escaped(it.text)}</text>"
    if isinstance(it, Circle):
        drawn = f'<circle cx="{n(it.x_px)}" cy="{n(it.y_px)}" r="{n(it.radius_px)}"'
    elif isinstance(it, Ellipse):
        x, y = n(it.x_px), n(it.y_px)
        drawn = f'<ellipse cx="{x}" cy="{y}" rx="{n(it.major_px)}" ry="{n(it.minor_px)}"'
        drawn += f' transform="rotate({n(it.turn_deg)} {x} {y})"'
    elif isinstance(it, Rect):
        drawn = f'<rect x="{n(it.x_px)}" y="{n(it.y_px)}" width="{n(it.width_px)}"'
        drawn += f' height="{n(it.height_px)}"'
    elif isinstance(it, Polyline):
        line = "L".join(["%.2f %.2f"] * len(it.points_px)) % tuple(chain(*it.points_px))
        line = _ZEROS.sub("", line)
        drawn = f'<path d="M{line}{"z" if it.closed else ""}"'
    elif it.turned:
        a, b = n(it.arm_px * 0.7071), n(it.arm_px * 1.4142)
        drawn = f'<path d="M{n(it.x_px)} {n(it.y_px)}m-{a} -{a}l{b} {b}m-{b} 0l{b} -{b}"'
    else:
        a, b = n(it.arm_px), n(it.arm_px * 2)
        drawn = f'<path d="M{n(it.x_px)} {n(it.y_px)}m-{a} 0h{b}m-{a} -{a}v{b}"'
    if not it.title:
        return f"{drawn}/>"
    tag = drawn[1 : drawn.index(" ")]
    return f"{drawn}><title>{_escaped(it.title)}</title></{tag}>"


_ZEROS = re.compile(r"-(?=0\.00)|\.00|(?<=\.\d)0(?!\d)")  # which `_number` doesn't write


def _number(value: float) -> str:
    text = f"{float(value):.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _view(image: ImageView) -> View:
    return (image.width, image.height, *image.shown)


def _view_rule(name: str, view: View) -> str:
    """The style rule that shows one part of an image; the policy forbids `style` attributes."""
    full_width, full_height, x, y, width, height = view
    left, top, wide = -100 * x / width, -100 * y / height, 100 * full_width / width
    place = f"left:{left:.4f}%;top:{top:.4f}%;width:{wide:.4f}%"
    return (
        f".{name}{{aspect-ratio:{width}/{height}}}.{name} img{{{place}}}.whole"
        f" .{name}{{aspect-ratio:{full_width}/{full_height}}}.whole .{name}"
        " img{left:0;top:0;width:100%}\n"
    )
