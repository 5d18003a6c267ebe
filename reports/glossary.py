"""Terms that a page explains: in a list of their own, and wherever they stand, on hovering and by
keyboard, without a script.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from reports.sanitize import page_text, sanitized
from textfiles.text import capital


@dataclass(frozen=True, slots=True)
class Term:
    """A technical term, what it means, and how else it is spelt in texts."""

    name: str
    meaning: str
    also: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """Its anchor in the list."""
        return f"term-{re.sub(r'[^a-z0-9]+', '-', self.name.lower()).strip('-')}"


class GlossaryLinks:
    """Texts with links to the terms in the file `base`; one of `names` is no term."""

    def __init__(self, terms: Sequence[Term], base: str = "", names: Sequence[str] = ()) -> None:
        self._base = base
        self._ids: dict[str, str] = {}
        for term in terms:
            for word in (term.name, *term.also):
                # as in the middle of a sentence and, of a word, at its beginning
                begun = capital(word) if len(word) > 3 else word
                self._ids |= {spelt: term.id for spelt in (word, begun) if spelt not in names}
        words = sorted(self._ids, key=len, reverse=True)
        text = "|".join(map(re.escape, words))
        self._pattern = re.compile(rf"(?<![\w|-])(?:{text})(?![\w|-])") if words else None
        self._known: dict[str, Markup] = {}

    def __call__(self, text: str) -> Markup:
        """`text`, escaped, with each term's first occurrence as a link."""
        if text in self._known:
            return self._known[text]
        parts, done, at, given = [], set(), 0, text
        text = page_text(text)
        for found in self._pattern.finditer(text) if self._pattern else ():
            name = self._ids[found[0]]
            if name in done:
                continue
            done.add(name)
            link = f'<a class="term {name}" href="{escape(self._base)}#{name}">'
            parts += [escape(text[at : found.start()]), Markup(link), escape(found[0])]  # noqa: S704 ours
            parts.append(Markup("</a>"))
            at = found.end()
        self._known[given] = Markup("").join([*parts, escape(text[at:])])
        return self._known[given]


def style_rules(terms: Sequence[Term]) -> str:
    """What the terms' links show: each text once in a file, however often it is shown."""
    escapes = str.maketrans({"\\": r"\5c ", '"': r"\22 ", "<": r"\3c "})
    tips = ((term.id, sanitized(term.meaning).translate(escapes)) for term in terms)
    return "".join(f'.{name}::after{{--tip:"{text}"}}\n' for name, text in tips)
