"""A page of ours as a reader sees its sentences: without the marks of terms, links and lines."""

from __future__ import annotations

import html
import re
from pathlib import Path


def plain_text(page: Path | str) -> str:
    """Of a file, or of HTML: tags dropped, entities resolved, white space as one blank."""
    text = page.read_text(encoding="utf-8") if isinstance(page, Path) else page
    body = re.sub(r"<(script|style)\b.*?</\1>", " ", text, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", "", body)).split())
