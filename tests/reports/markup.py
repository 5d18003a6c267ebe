"""Reads a page back with the standard library's parser: what the structure tests ask about."""

from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "img", "input", "br", "hr", "link"}


@dataclass(slots=True)
class Element:
    """One element: its tag, its attributes, and all text inside it."""

    tag: str
    attributes: dict[str, str]
    text: str = ""


@dataclass(slots=True)
class Document:
    """Every element in order, and the tags that were closed in the wrong place."""

    elements: list[Element] = field(default_factory=list)
    misplaced: list[str] = field(default_factory=list)

    def all(self, *tags: str) -> list[Element]:
        return [element for element in self.elements if element.tag in tags]

    def by_id(self, name: str) -> Element:
        return next(element for element in self.elements if element.attributes.get("id") == name)

    def values(self, attribute: str) -> list[str]:
        return [
            element.attributes[attribute]
            for element in self.elements
            if attribute in element.attributes
        ]


def read(html: str) -> Document:
    """The document of a page's text."""
    reader = _Reader()
    reader.feed(html)
    reader.close()
    reader.document.misplaced += [f"{element.tag} never closed" for element in reader.open]
    return reader.document


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.document = Document()
        self.open: list[Element] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, {key: value or "" for key, value in attrs})
        self.document.elements.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.document.elements.append(Element(tag, {key: value or "" for key, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open[-1].tag != tag:
            self.document.misplaced.append(
                f"</{tag}> inside {[element.tag for element in self.open[-3:]]}"
            )
            return
        self.open.pop()

    def handle_data(self, data: str) -> None:
        for element in self.open:
            element.text += data
