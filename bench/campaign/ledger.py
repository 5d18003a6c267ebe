"""What a campaign's files were when they were written: `ledger.txt` beside the plan, to which lines
are only added, in the format of ``sha256sum``.

A line is there before its file, so that a file without one was not written by the campaign, and a
flipped bit or a cut in the ledger itself shows as a file that is not as it was written.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock

from bench.config import ConfigError, read_bytes
from bench.files import write_synced
from textfiles.whole import new_folders, sync

LEDGER, LOCK = "ledger.txt", "ledger.lock"
REMOVED = "removed"  # in place of a digest: the file was merged into another, or is not needed
LOOKS, BETWEEN_S = 3, 0.2
LOOK = "look for"  # the name of a digest that no file has: of what was looked at for a claim
ROWS = "rows of"  # the name of a digest that no file has: of so many scenes' rows


@dataclass(frozen=True, slots=True)
class Damage:
    """Names of files that are not as written, that are missing, and that no line names."""

    changed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.changed or self.missing or self.unknown)

    def __str__(self) -> str:
        kinds = {
            "not as written": self.changed,
            "missing": self.missing,
            f"not in {LEDGER}": self.unknown,
        }
        return "; ".join(f"{kind}: {shortened(names)}" for kind, names in kinds.items() if names)


def shortened(names: Iterable[str], most: int = 5) -> str:
    """The first of ``names``, and how many more there are."""
    listed = list(names)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + more


class Ledger:
    """The ledger of the campaign in ``folder``. ``add`` and ``remove`` raise OSError."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, name: str, data: bytes) -> None:
        """``data`` is about to be written to ``name``, a path in the folder with slashes."""
        self._append([(hashlib.sha256(data).hexdigest(), name)])

    def write(self, name: str, data: bytes) -> None:
        """Write a file of the campaign. Raises OSError."""
        self.add(name, data)
        write_synced(self.folder / name, data)

    def remove(self, names: Iterable[str]) -> None:
        """These files are about to be removed."""
        self._append([(REMOVED, name) for name in names])

    def state(self) -> dict[str, str]:
        """The last digest of each name; names that were removed are not among them."""
        return {name: digest for name, digest in self._lines().items() if digest != REMOVED}

    def _lines(self) -> dict[str, str]:
        """The last digest of each name, or `REMOVED`."""
        try:
            text = (self.folder / LEDGER).read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return {}
        parts = (line.partition("  ") for line in text.splitlines())
        return {name: digest for digest, _, name in parts}

    def damage(self, below: str) -> Damage:
        """What is wrong with the Parquet files whose names begin with ``below``. A damaged file is
        read again before it counts: a run may be writing it. Raises ConfigError.
        """
        for _ in range(LOOKS - 1):
            if not (found := self._damage(below)):
                return found
            time.sleep(BETWEEN_S)
        return self._damage(below)

    def _damage(self, below: str) -> Damage:
        lines = self._lines()
        named = {name for name, digest in lines.items() if digest != REMOVED}
        there = {
            path.relative_to(self.folder).as_posix() for path in self.folder.glob("*/*.parquet")
        }
        ours = sorted(name for name in there | named if name.startswith(below))
        return Damage(
            changed=tuple(
                name
                for name in ours
                if name in named & there
                and hashlib.sha256(read_bytes(self.folder / name)).hexdigest() != lines[name]
            ),
            missing=tuple(name for name in ours if name not in there),
            unknown=tuple(name for name in ours if name not in lines),
        )

    def checked_bytes(self, name: str) -> bytes:
        """A file's content. Raises ConfigError where it is not as it was written."""
        path = self.folder / name
        data = read_bytes(path)
        if self.state().get(name) != hashlib.sha256(data).hexdigest():
            raise ConfigError.plain(
                f"{path} is not as the campaign wrote it ({LEDGER} beside it has another SHA-256)."
                " Put the folder back from a copy, or name another `out`."
            )
        return data

    def compare_rows(self, scenes: int, digest: str) -> str:
        """Keep the digest of all rows; a sentence where so many scenes had another one before."""
        name = f"{ROWS} {scenes} scenes"
        before = self.state().get(name)
        if before is None:
            self._append([(digest, name)])
        if before in (None, digest):
            return ""
        return (
            f"{self.folder}: the {name} had the digest {before} before. Its files are as they were"
            " written: a chunk that was done again came out differently, so a detector under test"
            " does not repeat itself, or another version of the database read them."
        )

    def looks(self, claim: str) -> list[str]:
        """The digests of what was looked at for this ``claim``, in the order of the looks."""
        name = f"{LOOK} {claim}"
        return [data for one, data in self._lines().items() if one == f"{name} {data}"]

    def add_look(self, claim: str, data: str) -> None:
        """A look at ``data``; taken again it is the same one."""
        if data not in self.looks(claim):
            self._append([(data, f"{LOOK} {claim} {data}")])

    def _append(self, lines: Iterable[tuple[str, str]]) -> None:
        text = "".join(f"{digest}  {name}\n" for digest, name in lines)
        places = self.folder / LOCK, self.folder / LEDGER
        # jobs of several machines may add at once
        with new_folders(self.folder), FileLock(places[0]), places[1].open("ab") as file:
            begins = file.tell() == 0
            # after a line that a crash cut, so that this one is whole
            file.write(text.encode() if begins or self._ends_a_line() else b"\n" + text.encode())
            file.flush()
            sync(file.fileno())

    def _ends_a_line(self) -> bool:
        with (self.folder / LEDGER).open("rb") as file:
            file.seek(-1, os.SEEK_END)
            return file.read(1) == b"\n"
