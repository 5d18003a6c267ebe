"""Terms that a page explains: in a list of their own, and wherever they stand, on hovering and by
keyboard, without a script.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from reports.sanitize import sanitized


@dataclass(frozen=True, slots=True)
class Term:
    """A technical term, what it means, and how else it is spelt in texts."""

    name: str
    says: str
    also: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """Its anchor in the list."""
        return f"term-{re.sub(r'[^a-z0-9]+', '-', self.name.lower()).strip('-')}"


class Explained:
    """Texts with their terms as links to the list, which stands in the file `base`; a word that is
    one of `names` is no term.
    """

    def __init__(self, terms: Sequence[Term], base: str = "", names: Sequence[str] = ()) -> None:
        self._base = base
        self._ids = {word: term.id for term in terms for word in _spellings(term)}
        self._ids = {word: term for word, term in self._ids.items() if word not in names}
        words = sorted(self._ids, key=len, reverse=True)
        text = "|".join(map(re.escape, words))
        self._pattern = re.compile(rf"(?<![\w|-])(?:{text})(?![\w|-])") if words else None
        self._known: dict[str, Markup] = {}

    def __call__(self, text: str) -> Markup:
        """`text`, escaped, with each term's first occurrence as a link."""
        if text not in self._known:
            self._known[text] = self._linked(sanitized(text))
        return self._known[text]

    def _linked(self, text: str) -> Markup:
        parts, done, at = [], set(), 0
        for found in self._pattern.finditer(text) if self._pattern else ():
            name = self._ids[found[0]]
            if name in done:
                continue
            done.add(name)
            link = f'<a class="term {name}" href="{escape(self._base)}#{name}">'
            parts += [escape(text[at : found.start()]), Markup(link), escape(found[0])]  # noqa: S704 ours
            parts.append(Markup("</a>"))
            at = found.end()
        return Markup("").join([*parts, escape(text[at:])])


def _spellings(term: Term) -> tuple[str, ...]:
    """As in the middle of a sentence and, of a word, at its beginning."""
    words = (term.name, *term.also)
    return (*words, *(word[0].upper() + word[1:] for word in words if len(word) > 3))


def style_rules(terms: Sequence[Term]) -> str:
    """What the terms' links show: each text once in a file, however often it is shown."""
    rules = []
    for term in terms:
        text = (
            sanitized(term.says).replace("\\", r"\5c ").replace('"', r"\22 ").replace("<", r"\3c ")
        )
        rules.append(f'.{term.id}::after{{--tip:"{text}"}}\n')
    return "".join(rules)
