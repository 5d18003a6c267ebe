"""`help TOPIC`: a page of docs/ in the terminal, without a network. The wheel carries the pages."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from bench.cli.arguments import print_values
from bench.cli.commands import COMMANDS, ONCE, table
from bench.config import ConfigError, did_you_mean

HERE = Path(__file__).parents[1]
COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
ROW = re.compile(r"^\| (`.+`) \| (\[.+\.md\).*) \|$", re.MULTILINE)  # index.md: commands, pages
WIDEST, FEW = 100, 4


def folder() -> Path:
    """Where the pages are: in the installed package, else in the project."""
    inside = HERE / "docs"
    return inside if inside.is_dir() else HERE.parent / "docs"


def topics() -> dict[str, Path]:
    """Each page by its name, and each command, with its names of once, by the page about it."""
    pages = {path.stem: path for path in sorted(folder().glob("*.md"))}
    rows = ROW.findall(_read(pages["index"]))
    named = {
        command: pages[re.findall(r"\(([\w-]+)\.md", links)[0]]
        for commands, links in rows
        for command in re.findall(r"`([a-z-]+)`", commands)
    }
    firsts = {name: name.split()[0] for name in (*table("tasks")["groups"], *COMMANDS)}
    firsts |= {old: name for name, earlier in ONCE.items() for old in earlier}
    return {name: named[first] for name, first in firsts.items() if first in named} | pages


def _read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def _mentioned(words: str) -> str:
    """The pages that say ``words``, most often first; empty where none does."""
    word = re.compile(rf"\b{re.escape(words)}\b", re.IGNORECASE)
    counts = {path.stem: len(word.findall(_read(path))) for path in sorted(folder().glob("*.md"))}
    pages = sorted(filter(counts.get, counts), key=lambda page: -counts[page])[:FEW]
    return f"; these pages speak of it: {', '.join(pages)}" if pages else ""


def shown(given: argparse.Namespace) -> None:
    known = topics()
    if not given.topic:
        titles = {path.stem: _read(path).partition("\n")[0].strip("# ") for path in known.values()}
        print_values(dict(sorted(titles.items())))
        print(
            "A command's name shows the page that explains it, a term of the glossary its meaning."
        )
        return
    from bench.report.glossary import terms

    topic = " ".join(given.topic)
    found = {spelt.lower(): one for one in terms(in_docs=True) for spelt in (one.name, *one.also)}
    if topic in table("removed"):
        raise ConfigError.plain(f"'{topic}' went: {table('removed')[topic]}")
    if topic in known:
        text = COMMENT.sub("", _read(known[topic]))
    elif term := found.get(topic.lower()):
        text = f"{term.name}: {term.meaning}"
    else:
        near = did_you_mean(topic, [*known, *found]) or ". 'teatbench help' lists the pages."
        said = _mentioned(topic) or near
        raise ConfigError.plain(f'no page "{topic}"{said}')
    if not sys.stdout.isatty():
        print(text)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    console.print(Markdown(text, hyperlinks=False), width=min(console.width, WIDEST))
