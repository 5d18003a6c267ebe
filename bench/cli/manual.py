"""`help TOPIC`: a page of docs/ in the terminal, without a network. The wheel carries the pages."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from bench.cli.arguments import print_values
from bench.config import ConfigError, did_you_mean

HERE = Path(__file__).parents[1]
COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
ROW = re.compile(r"^\| (`.+`) \| (\[.+\.md\).*) \|$", re.MULTILINE)  # index.md: commands, pages
WIDEST = 100


def folder() -> Path:
    """Where the pages are: in the installed package, else in the project."""
    inside = HERE / "docs"
    return inside if inside.is_dir() else HERE.parent / "docs"


def topics() -> dict[str, Path]:
    """Each page by its name, and each command with the page that explains it."""
    pages = {path.stem: path for path in sorted(folder().glob("*.md"))}
    rows = ROW.findall(_read(pages["index"]))
    named = {
        command: pages[re.findall(r"\(([\w-]+)\.md", links)[0]]
        for commands, links in rows
        for command in re.findall(r"`([a-z-]+)`", commands)
    }
    return named | pages


def _read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def shown(given: argparse.Namespace) -> None:
    known = topics()
    if given.topic is None:
        titles = {path.stem: _read(path).partition("\n")[0].strip("# ") for path in known.values()}
        print_values(dict(sorted(titles.items())))
        print("A command's name shows the page that explains it.")
        return
    if given.topic not in known:
        said = did_you_mean(given.topic, known) or ". 'teatbench help' lists the pages."
        raise ConfigError.plain(f'no page "{given.topic}"{said}')
    text = COMMENT.sub("", _read(known[given.topic]))
    if not sys.stdout.isatty():
        print(text)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    console.print(Markdown(text, hyperlinks=False), width=min(console.width, WIDEST))
