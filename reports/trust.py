"""What may enter a page as an id, an address or ready-made SVG, by allow-lists; other text is
escaped. An address is a fragment or a relative path, never a scheme.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from html.parser import HTMLParser
from typing import NoReturn
from urllib.parse import quote

_SLUG = re.compile(r"[a-z][a-z0-9-]{0,79}")
_UNSAFE_IN_PATH = re.compile(r"[\x00-\x1f\x7f-\x9f:\\]")
_VIEW_BOX = re.compile(r"\S+ \S+ (\d+(?:\.\d+)?) \d\S*")
_LOCAL_REFERENCE = re.compile(r"#[A-Za-z0-9._-]+")
_SVG_ELEMENT = re.compile("svg|g|defs|path|use|text|tspan|rect|circle|line|clippath|a|title")
_SVG_ATTRIBUTE = re.compile(
    "class|clip-path|clip-rule|c[xy]|d|d[xy]|fill(-opacity|-rule)?|font-(size|style|weight)|height"
    "|href|id|opacity|r|r[xy]|tabindex|text-anchor|transform|version|viewbox|width|x|y|[xy][12]"
    "|stroke(-dasharray|-dashoffset|-linecap|-linejoin|-miterlimit|-opacity|-width)?"
    "|xml:space|xmlns"
)


class PageError(ValueError):
    """A page can't be written as described: which part, the value, and what is allowed."""


@dataclass(frozen=True, slots=True)
class SvgFacts:
    """A drawing's ids, the fragments that it links to, and its width (0: not stated)."""

    ids: tuple[str, ...]
    links: tuple[str, ...]
    width: float = 0.0


def checked_slug(value: str, what: str) -> str:
    """`value` where it can be an id: a-z, 0-9, hyphens, a letter first. Raises PageError."""
    if not _SLUG.fullmatch(value):
        raise PageError(
            f"{what}: {value!r} can't be an id; use lower case letters, digits and hyphens, a"
            " letter first, at most 80"
        )
    return value


def address(value: str, what: str) -> str:
    """The URL of `#id` or a relative path, which may lead out of the folder. Raises PageError."""
    if value.startswith("#"):
        return "#" + checked_slug(value[1:], what)
    if not value or value.startswith("/") or _UNSAFE_IN_PATH.search(value):
        raise PageError(
            f"{what}: {value!r} is no address in this page; use '#id' or a relative path with"
            " forward slashes and no ':'"
        )
    return quote(value, safe="/-._~()", errors="replace")


def one_of(value: str, allowed: Iterable[str], what: str) -> None:
    """Raises PageError where `value` is none of `allowed`."""
    if value not in (words := tuple(allowed)):
        raise PageError(f"{what}: {value!r} is none of {', '.join(map(repr, words))}")


def svg_facts(svg: str, what: str) -> SvgFacts:
    """The ids and links of one `<svg>`. Raises PageError for anything that a plot never has."""
    if not svg.startswith("<svg"):
        raise PageError(
            f"{what}: the drawing must start with '<svg', not {svg[:30]!r}; take it from"
            " reports.figures"
        )
    reader = _SvgReader(what)
    reader.feed(svg)
    reader.close()
    if reader.open_elements:
        raise PageError(f"{what}: the drawing ends before </{reader.open_elements[-1]}>")
    return SvgFacts(tuple(reader.ids), tuple(reader.links), reader.width)


class _SvgReader(HTMLParser):
    """Walks one drawing with the rules of HTML and refuses what is not on the lists."""

    def __init__(self, what: str) -> None:
        super().__init__(convert_charrefs=True)
        self.what = what
        self.ids: list[str] = []
        self.links: list[str] = []
        self.open_elements: list[str] = []
        self.width = 0.0
        self.finished = False

    def _refuse(self, what: str) -> NoReturn:
        raise PageError(
            f"{self.what}: the drawing may not hold {what}; take it from reports.figures"
        )

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        self.open_elements.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        placed = (tag == "svg") == (not self.open_elements) and not self.finished
        if not placed or not _SVG_ELEMENT.fullmatch(tag):
            self._refuse(f"<{tag}> here")
        for name, given in attrs:
            value = given or ""
            refers = name == "href" or "url(" in value
            target = value.removeprefix("url(").removesuffix(")")
            local = not refers or _LOCAL_REFERENCE.fullmatch(target)
            if not local or not _SVG_ATTRIBUTE.fullmatch(name):
                self._refuse(f"{name}={value[:60]!r} in <{tag}>")
            if name == "id":
                self.ids.append(value)
            if name == "viewbox" and (size := _VIEW_BOX.fullmatch(value)):
                self.width = float(size[1])
            if name == "href" and tag == "a":
                self.links.append(value)

    def handle_endtag(self, tag: str) -> None:
        if not self.open_elements or self.open_elements.pop() != tag:
            raise PageError(f"{self.what}: the drawing closes </{tag}> where it isn't open")
        self.finished = not self.open_elements

    def handle_data(self, data: str) -> None:
        inside = self.open_elements[-1] if self.open_elements else ""
        if data.strip() and inside not in {"text", "tspan", "title"}:
            raise PageError(
                f"{self.what}: the drawing holds the text {data.strip()[:40]!r} outside a text"
                " element"
            )

    def handle_comment(self, data: str) -> None:
        self._refuse(f"the comment or declaration {data[:40]!r}")

    handle_decl = handle_pi = unknown_decl = handle_comment  # type: ignore[assignment]
