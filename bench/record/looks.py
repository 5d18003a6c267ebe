"""The ledger of looks: which runs were judged or compared together, kept in the record of each.

A look is a fact of its own in every run that it was taken at, under a link of that run's chain:
none is written over, and one that is changed or removed is noticed as any other change of a record.
So a look at A and B is found where A is judged with C later, wherever the folders lie by then. A
look taken again at the same data is the same entry.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.record.chain import LOOK
from bench.record.reader import RunRecord
from bench.record.writer import Store

TOGETHER, GATE = "together", "gate"


@dataclass(frozen=True, slots=True)
class InterimLook:
    """One look at ``data`` of ``runs`` (their ids -> folders' names), for one ``claim``, with the
    ``poses`` that each requirement counted and the ``verdicts`` that came out; ``after`` are the
    keys of those before it. `claim_of` gives claim and data.
    """

    kind: str
    claim: str
    data: str
    runs: Mapping[str, str]
    poses: Mapping[str, int]
    verdicts: Mapping[str, str]
    after: Sequence[str] = ()

    @property
    def key(self) -> str:
        """What it is called in the record: by what was looked at, not by what was seen."""
        return LOOK + claim_of(self.kind, self.claim, self.data)[:16]


def claim_of(*parts: Any) -> str:
    """The SHA-256 of what a claim is made of."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def id_of(run: RunRecord) -> str:
    """What a run is known by, wherever its folder lies: its chain's first link, else its facts."""
    own = {key: value for key, value in run.facts.items() if not key.startswith(LOOK)}
    return (run.first_link or claim_of(own))[:16]


def looks_before(
    runs: Iterable[RunRecord], kind: str, claim: str, data: str
) -> tuple[InterimLook, ...]:
    """The looks of this kind, for this claim, at any of the runs, that came before one at ``data``:
    all but that one, or those that did when it was taken.
    """
    found = {
        key: InterimLook(**value)
        for run in runs
        for key, value in run.facts.items()
        if key.startswith(LOOK) and (value["kind"], value["claim"]) == (kind, claim)
    }
    this = next((look for look in found.values() if look.data == data), None)
    return tuple(
        look
        for key, look in found.items()
        if look.data != data and (this is None or key in this.after)
    )


def write_looks(runs: Sequence[RunRecord], looks: Sequence[InterimLook]) -> None:
    """Writes what isn't there yet into every run. Raises ConfigError where one can't be written to,
    before any is.
    """
    new = [(run, [look for look in looks if look.key not in run.facts]) for run in runs]
    stores: list[tuple[Store, list[InterimLook]]] = []
    try:
        for run, missing in new:
            if missing:
                with _written(run.folder):
                    stores.append((Store(run.folder, session=1), missing))
        for store, missing in stores:
            with _written(store.folder):
                for look in missing:
                    store.fact(look.key, asdict(look))
    finally:
        for store, _ in stores:
            with _written(store.folder):
                store.close()


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    try:
        yield
    except (sqlite3.Error, OSError, ConfigError) as error:
        raise ConfigError.plain(
            f"the look can't be written into {folder}: {error}. A look that isn't in the record"
            " would be free, so there is no verdict without it. Copy the run to where it can be"
            " written."
        ) from error
