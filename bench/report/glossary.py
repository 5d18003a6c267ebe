"""The terms that reports and docs explain, of ``glossary.toml``. `python -m bench.report.glossary`
writes docs/glossary.md from them.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

from reports.glossary import Term


@cache
def terms(*, in_docs: bool = False) -> tuple[Term, ...]:
    """All that reports link, in the order of the file; ``in_docs``: by name, with those that only
    docs and `teatbench help` explain.
    """
    linked = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    more = linked.pop("in_docs")
    found = sorted({**linked, **more}.items(), key=lambda one: one[0].lower())
    rows = found if in_docs else linked.items()
    return tuple(Term(name, one["meaning"], tuple(one.get("also", ()))) for name, one in rows)


HEAD = """# Glossary

What reports, the terminal and these pages mean by a word; `teatbench help WORD` shows it. A report
shows the same text when the pointer or the keyboard is on a term.

| Term | Meaning |
|---|---|
"""


def markdown() -> str:
    """docs/glossary.md."""
    return HEAD + "".join(f"| {term.name} | {term.meaning} |\n" for term in terms(in_docs=True))


if __name__ == "__main__":
    page = Path(__file__).resolve().parents[2] / "docs" / "glossary.md"
    page.write_text(markdown(), encoding="utf-8", newline="\n")
