"""Ids on a page out of names that anybody gave: what a detector may be called is more than what an id may be."""

from __future__ import annotations

import hashlib
import re

LONGEST = 60  # with what stands before it an id has room


def id_of(name: str) -> str:
    """A name as a part of an id: itself where it may be one, else its letters and digits, told from others by a few of its hash."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if plain == name and len(name) <= LONGEST:
        return name
    return f"{plain[: LONGEST - 7]}-{hashlib.sha256(name.encode()).hexdigest()[:6]}".lstrip("-")
