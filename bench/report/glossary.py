"""The terms that reports and docs explain, of ``glossary.toml``. `python -m bench.report.glossary`
writes docs/glossary.md from them.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

from reports.glossary import Term


@cache
def terms() -> tuple[Term, ...]:
    """All terms, in the order of the file."""
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    return tuple(
        Term(name, term["meaning"], tuple(term.get("also", ())))
        for name, term in tomllib.loads(text).items()
    )


HEAD = """# Glossary

What reports and these pages mean by a word. A report shows the same text when the
pointer or the keyboard is on a term.

| Term | Meaning |
|---|---|
"""


def markdown() -> str:
    """docs/glossary.md."""
    return HEAD + "".join(f"| {term.name} | {term.meaning} |\n" for term in terms())


if __name__ == "__main__":
    page = Path(__file__).resolve().parents[2] / "docs" / "glossary.md"
    page.write_text(markdown(), encoding="utf-8", newline="\n")
