"""Words in a message about what a person wrote."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """``; did you mean "x"?`` when one of ``known`` is near, else the empty string."""
    there = list(known)
    begun = [one for one in there if one.startswith(word)] if word else []
    near = difflib.get_close_matches(word, there, n=1, cutoff=0.6) or begun
    return f'; did you mean "{near[0]}"?' if near else ""


def short(text: str) -> str:
    """``text`` as far as it has room in a message."""
    return text if len(text) <= 60 else text[:57] + "..."
