"""How a queue of scripts stands: one file beside its runs, which names them in their order, and
the status of each run. Nothing else is kept of a queue.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.files import write_synced
from bench.record.state import State, holder_in, still_runs, this_process
from bench.results.status import RunStatus, read_status
from instruments.clock import wall_time
from textfiles.text import plural

VERSION = 1
NAME = "queue-{}"  # its files, beside the runs
ENDED, DIED = "all scripts were run", "the bench died"


@dataclass(frozen=True, slots=True)
class QueueEntry:
    """One script, with its run and that one's status once it has begun."""

    script: str
    run: str = ""
    status: RunStatus | None = None

    @property
    def text(self) -> str:
        """``running: trial 3 of 18``; ``not begun``."""
        return self.status.headline if self.status else "not begun"


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """A queue on ``rig``. ``ended``: why no script follows any more; "" while it goes on."""

    name: str
    rig: str
    started: str
    scripts: tuple[QueueEntry, ...]
    ended: str

    @property
    def under_way(self) -> bool:
        return not self.ended

    @property
    def begun(self) -> int:
        return sum(bool(one.run) for one in self.scripts)

    @property
    def headline(self) -> str:
        """``script 2 of 3: plane-map``; ``ended early, 2 of 3 scripts: tripped by interlock …``."""
        of = plural(len(self.scripts), "script")
        if self.under_way:
            at = max(self.begun, 1)
            now, then = self.scripts[at - 1], self.scripts[at:]
            place = f"script {at} of {len(self.scripts)}"
            if then and now.status and not now.status.under_way:
                return f"{place} has ended, next: {then[0].script}"
            return f"{place}: {now.script}"
        states = [one.status.state for one in self.scripts if one.status]
        done = states.count(State.FINISHED)
        if self.ended == ENDED:
            return f"ended: {done} of {of} finished"
        return f"ended early, {done} of {of} finished: {self.ended}"

    def as_dict(self) -> dict[str, Any]:
        """As JSON, with its version."""
        shown = [
            {"script": one.script, "run": one.run, "text": one.text}
            | {"status": one.status.as_dict() if one.status else None}
            for one in self.scripts
        ]
        keys = ("name", "rig", "started", "headline", "under_way", "ended")
        said = {key: getattr(self, key) for key in keys}
        return {"schema_version": VERSION, **said, "scripts": shown}


@dataclass(slots=True)
class QueueNote:
    """The file of a queue that goes on; a run alone has none. It stops no run: it is no record."""

    path: Path | None
    text: dict[str, Any]

    @classmethod
    def begin(cls, out: Path, rig: str, scripts: Sequence[str]) -> QueueNote:
        now = wall_time()
        stamp = now.strftime("%Y%m%d-%H%M%S")
        alike = len([*out.glob(f"{NAME.format(stamp)}*.json")])  # begun in this second
        name = NAME.format(f"{stamp}-{alike + 1}" if alike else stamp)
        path = out / f"{name}.json" if len(scripts) > 1 else None
        text: dict[str, Any] = {"version": VERSION, "rig": rig, "scripts": [*scripts], "runs": []}
        text |= {"started": now.isoformat(timespec="seconds"), "ended": ""}
        note = cls(path, text | this_process())
        note._write()
        return note

    def runs(self, folder: Path) -> None:
        """The next script has its run in ``folder``."""
        self.text["runs"].append(folder.name)
        self._write()

    def ends(self, why: str) -> None:
        """The first reason holds."""
        self.text["ended"] = self.text["ended"] or why
        self._write()

    def _write(self) -> None:
        if self.path:
            text = json.dumps(self.text, ensure_ascii=False).encode()
            try:
                write_synced(self.path, text)
            except OSError:  # on a full disk in its place, which takes no room
                with suppress(OSError), self.path.open("r+b") as there:
                    there.write(text.ljust(self.path.stat().st_size))


def read_queue(path: Path) -> QueueStatus:
    """Of the file ``path``. Raises ConfigError."""
    found = holder_in(path)
    try:
        runs = [*found["runs"], *[""] * (len(found["scripts"]) - len(found["runs"]))]
        rows = zip(found["scripts"], runs, strict=True)
        scripts = tuple(QueueEntry(one, run, _status(path.parent, run)) for one, run in rows)
        ended = found["ended"]
        if not ended and not still_runs(found):
            ended = DIED
        return QueueStatus(path.stem, found["rig"], found["started"], scripts, ended)
    except (LookupError, TypeError, ValueError) as error:
        raise ConfigError.plain(f"{path} is no queue of runs: {error!r}") from error


def _status(out: Path, run: str) -> RunStatus | None:
    with suppress(ConfigError, OSError):
        return read_status(out / run) if run else None
    return None


def queues(out: Path, most: int = 3) -> Iterator[QueueStatus]:
    """The last ones in the folder of runs ``out``, newest first."""
    for path in sorted(out.glob(NAME.format("*") + ".json"), reverse=True)[:most]:
        with suppress(ConfigError, OSError):
            yield read_queue(path)
