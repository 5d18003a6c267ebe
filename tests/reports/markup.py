"""Reads a page back with the standard library's parser: what the structure tests ask about."""

from dataclasses import dataclass
from html.parser import HTMLParser

VOID = {"meta", "img", "input", "br", "hr", "link"}


@dataclass(slots=True)
class Element:
    """One element: its tag, its attributes, and all text inside it."""

    tag: str
    attributes: dict[str, str]
    text: str = ""


class Document(HTMLParser):
    """Every element in order, and the tags that were closed in the wrong place."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[Element] = []
        self.misplaced: list[str] = []
        self._open: list[Element] = []
        self.feed(html)
        self.close()
        self.misplaced += [f"{element.tag} never closed" for element in self._open]

    def all(self, *tags: str) -> list[Element]:
        return [element for element in self.elements if element.tag in tags]

    def by_id(self, name: str) -> Element:
        return next(element for element in self.elements if element.attributes.get("id") == name)

    def values(self, attribute: str) -> list[str]:
        every = (element.attributes for element in self.elements)
        return [attributes[attribute] for attributes in every if attribute in attributes]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self._open.append(self.elements[-1])

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(Element(tag, {key: value or "" for key, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if self._open and self._open[-1].tag == tag:
            self._open.pop()
        else:
            inside = [element.tag for element in self._open[-3:]]
            self.misplaced.append(f"</{tag}> inside {inside}")

    def handle_data(self, data: str) -> None:
        for element in self._open:
            element.text += data


read = Document
