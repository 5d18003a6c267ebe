"""What a run or a comparison found, as Markdown: for the page that a CI service shows of a job."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.config import ConfigError
from bench.report.comparison import printed
from bench.report.wording import limit, measured
from bench.results.comparison import Comparison
from bench.results.status import Reported
from reports.page import SIGNS
from reports.sanitize import sanitized
from textfiles.whole import refusal

MARKS = {str(word): sign for word, sign in SIGNS.items()}
SPECIAL = re.compile(r"([\\`*_\[\]<>|#])")


def append(path: Path, text: str) -> None:
    """Behind what is there already, as CI services want it; nothing for "". Raises ConfigError."""
    try:
        with path.open("ab", buffering=0) as file:
            before, rest = os.fstat(file.fileno()).st_size, f"{text}\n".encode() if text else b""
            try:
                while rest:
                    rest = rest[file.write(rest) :]
            except OSError:
                file.truncate(before)
                raise
    except OSError as error:
        why = f"--summary {path}: it can't be written: {refusal(error)}"
        raise ConfigError.plain(why) from error


def of_run(found: Reported) -> str:
    """Verdict, requirements by detector, why, and what to do next."""
    record, judgements, status = found.record, found.judgements, found.status
    lines = [f"### {MARKS.get(status.word, '')} {_plain(f'{status.title}: {status.headline}')}", ""]
    urgent = [*status.unsafe, *filter(None, [status.mark])]
    lines += [f"- **{_plain(line)}**" for line in urgent]
    lines += [""] if urgent else []
    if judgements:
        rows, of_bench = [], []
        for row in zip(*(one.decisions for one in judgements), strict=True):
            shown = (f"{MARKS[one.verdict]} {measured(one)}" for one in row)
            name, *cells = row[0].name, limit(row[0]), *shown
            if len(judgements) > 1 and name in judgements[0].of_bench:
                of_bench.append([name, *cells[:2]])  # once, not a detector each
            else:
                rows.append([name, *cells])
        lines += _table(["requirement", "limit", *(one.detector for one in judgements)], rows)
        lines += _table(["of the bench", "limit", "shown"], of_bench) if of_bench else ()
    said = [status.why, *status.then, f"Run: {record.folder.name}"]
    return "\n\n".join(["\n".join(lines), *(_plain(line) for line in said if line)]) + "\n"


def of_refused(folder: Path, why: str) -> str:
    """A run without a verdict, since its record is refused."""
    head = f"### {MARKS['no verdict']} {_plain(folder.resolve().name)}: no verdict"
    return f"{head}\n\n{_plain(why)}\n"


def of_comparisons(found: Sequence[Comparison]) -> str:
    """Each comparison with its tables and its verdict."""
    parts: list[str] = []
    for one in found:
        head, tables, said, reasons = printed(one)
        parts.append(f"### {_plain(head)}")
        for table in tables.values():
            heads = [f"{of.title}, {of.unit}" if of.unit else of.title for of in table.columns]
            cells = [[of if isinstance(of, str) else of.text for of in row] for row in table.rows]
            parts.append("\n".join(_table(heads, cells)))
        parts += [_plain(line) for line in (*said, *reasons)]
    return "\n\n".join(parts) + "\n"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    for row in (heads, ["---"] * len(heads), *rows):
        cells = (cell if cell == "---" else _plain(cell) for cell in row)
        yield f"| {' | '.join(cells)} |"
    yield ""


def _plain(text: str) -> str:
    """Nothing in it is Markdown, or ends its line."""
    return SPECIAL.sub(r"\\\1", " ".join(sanitized(text).split()))
