"""What a stopped run left, and how it goes on: at the first trial without a result, in the same
folder, as its next session.

Under virtual time the simulated world died with the bench. It is brought back by going through the
finished trials once more, without detection and without writing to the record: then it stands where
it stood, to the last bit, and what follows equals the run that nothing disturbed. Touches are
compared with those on record; where they differ, the record says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.config import ConfigError, read_text
from bench.files import Picture
from bench.record.reader import RunRecord, TrialRecord, guardian_files, read_run
from bench.record.schema import GUARDIAN_FACT, SCRIPT, Row
from bench.record.state import TRIP
from bench.record.writer import Store, Tables
from bench.rig.loading import LoadedRig, load_rig
from bench.run.events import EVENT, RunState
from bench.script.model import LoadedScript, load_script

ASKED, DEATHS = "asked", "deaths"  # facts
POISON_DEATHS = 2
IN_A_TRIAL = (RunState.RUNNING.value, RunState.PAUSED.value)


@dataclass(frozen=True, slots=True)
class ResumePoint:
    """What a run left: trials ``done``; ``deaths``: by the number of its last event, the trial of
    each; ``last_s``: the time of its last event or reading.
    """

    run: RunRecord
    done: frozenset[str]
    deaths: Mapping[str, str]
    last_s: float

    @property
    def poison(self) -> dict[str, str]:
        """Trials that aren't tried again, with the reason."""
        return {
            trial: f"the bench died in it {times} times, and doesn't try it again"
            for trial, times in Counter(self.deaths.values()).items()
            if times >= POISON_DEATHS
        }


def what_is_left(folder: Path, planned: Sequence[str]) -> ResumePoint:
    """Of the run in ``folder`` with ``planned`` trials. Raises ConfigError for a finished run."""
    run = read_run(folder)
    if run.ending == RunState.FINISHED:
        why = f"{folder} is finished: nothing is left to do."
        raise ConfigError.plain(f"{why} 'teatbench report' writes its report anew.")
    done = frozenset(
        {trial.id for trial in run.trials} | {str(row["trial"]) for row in run.skipped}
    )
    deaths = dict(run.facts.get(DEATHS, {}))
    states = [event for event in run.events if event["kind"] == EVENT]
    first = next((trial for trial in planned if trial not in done), None)
    if states and states[-1]["text"] in IN_A_TRIAL and first is not None:
        # by the event's number: looked at twice it is still one death
        deaths[str(states[-1]["number"])] = first
    times = [float(event["t_s"]) for event in run.events if event["t_s"] is not None]
    times += run.bath[-1:, 0].tolist()
    return ResumePoint(run, done, deaths, max(times, default=0.0))


def files_of(run: RunRecord) -> tuple[LoadedRig, LoadedScript]:
    """Rig and script of a run. Raises ConfigError where they are gone or were changed since."""
    asked, folder = run.facts.get(ASKED), run.folder
    if not isinstance(asked, dict):
        why = f"{folder} can't be resumed: it doesn't say which rig and script it was run with."
        raise ConfigError.plain(why)
    for path, copy in ((asked["rig"], "rig.toml"), (asked["script"], SCRIPT)):
        if not Path(path).is_file():
            why = f"{path} is not there any more; a copy of it is {folder / copy}."
            raise ConfigError.plain(f"{why} Put it back to resume the run.")
    rig = load_rig(Path(asked["rig"]))
    script = load_script(Path(asked["script"]), rig.rig.limits.set_point_c)
    calibration = rig.calibration_path
    for path, text, copy in (
        (rig.path, rig.text, "rig.toml"),
        (script.path, script.text, SCRIPT),  # of a Python file what it gives
        (calibration, read_text(calibration), "calibration.toml"),
    ):
        if text != read_text(folder / copy):
            cure = f"Put back {folder / copy}, or start a new run."
            raise ConfigError.plain(f"{path} has changed since the run in {folder} began. {cure}")
    return rig, script


class RehearsedStore(Store):
    """The store of a run whose finished trials are replayed: while ``silent`` it takes only newer
    bath readings and checks, and a trip, and compares touches with those on record.
    """

    def __init__(self, left: ResumePoint) -> None:
        self.silent = False
        super().__init__(left.run.folder)
        self._read_to_s = float(left.run.bath[:, 0].max(initial=-np.inf))
        self._checks = {int(row["number"]) for row in left.run.checks}
        self._invalid = {trial.id for trial in left.run.trials if trial.invalid is not None}
        self._known = {
            trial.id: [row["counts"] for row in trial.touches] for trial in left.run.trials
        }
        self.same: list[str] = []
        self.differ: list[str] = []

    def _add_row(self, table: str, row: Row, *, urgent: bool) -> None:
        new = not self.silent or TRIP in (row.get("kind"), row.get("key"))  # it ends the replay
        if row["t_s"] > self._read_to_s if table == "bath" else new:
            super()._add_row(table, row, urgent=urgent)

    def _write(self, tables: Tables) -> None:
        if not (self.silent and tables):
            super()._write(tables)

    def finished(self, done: TrialRecord) -> None:
        if self.silent and done.id in self._known:
            same = self._known[done.id] == [row["counts"] for row in done.touches]
            (self.same if same else self.differ).append(done.id)
        super().finished(done)

    def checked(self, touches: Sequence[Row], invalid: Sequence[str], reason: str) -> None:
        new = [touch for touch in touches if touch["number"] not in self._checks]
        lost = [trial for trial in invalid if trial not in self._invalid]
        if new or lost:
            super().checked(new, lost, reason)

    def frames(
        self, trial: str, images: Mapping[str, Picture], exposed_s: Mapping[str, float]
    ) -> list[Row]:
        return [] if self.silent else super().frames(trial, images, exposed_s)


def keep_guardians(store: Store) -> None:
    """Into the chain: what the guardians of earlier sessions did, once none of them acts."""
    for name, record in guardian_files(store.folder).items():
        store.fact(GUARDIAN_FACT.format(name), record)


def open_store(left: ResumePoint, *, rehearsed: bool) -> Store:
    """The run's store, open for a further session: with the deaths, without an ending."""
    store = RehearsedStore(left) if rehearsed else Store(left.run.folder)
    with store.step():
        store.fact(DEATHS, left.deaths)
        store.fact("ending", "interrupted")
    if isinstance(store, RehearsedStore):
        store.silent = True
    return store
