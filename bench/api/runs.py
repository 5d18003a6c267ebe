"""A script run on a rig, a recording scored, and what their folders hold: as typed rows, or as
tables of pandas.
"""

from __future__ import annotations

import importlib
import sqlite3
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, cast

from bench.api.loading import OUT, AnyRig, AnyScript, load_rig, load_script
from bench.config import ConfigError, all_of, check_within, several, wrong_use
from bench.record.check import Damage, known_damage
from bench.record.reader import RunRecord, opened
from bench.record.recording import RecordingError
from bench.record.schema import tables_of
from bench.results.status import Reported, RunStatus
from bench.rig.leaving import to_stderr
from bench.rig.loading import LoadedRig
from bench.run import estimate
from bench.run.events import ENDED, Events, Progress, event_lines
from bench.run.resume import ASKED, files_of
from bench.safety.signals import in_own_thread
from bench.script.model import LoadedScript
from detector.protocol import Detector
from instruments.captures.capture import CaptureFile
from instruments.errors import InstrumentError
from textfiles.bounds import FROM_0, SPEED
from textfiles.text import plural
from textfiles.whole import refusal

if TYPE_CHECKING:
    from bench.report.growing import TrialParts


class QuietProgress:
    """Shows what a person has to see at once, and nothing else."""

    def state(self, text: str) -> None: ...
    def trial(self, done: int, total: int, name: str) -> None: ...

    def warn(self, text: str) -> None:
        to_stderr(text)

    def aside(self) -> AbstractContextManager[None]:
        return nullcontext()


class _Parts:
    """Of the reports of runs under way, drawn between trials; what they need is loaded then."""

    def __init__(self, shown: Progress) -> None:
        self._warn = shown.warn
        self._parts: TrialParts | None = None

    def grow(self, folder: Path, done: int, planned: int) -> None:
        if self._parts is None:  # what a report needs is loaded before anything is measured
            from bench.report.growing import TrialParts

            self._parts = TrialParts(self._warn)
            self._parts.begin(planned)
            import bench.report.page  # noqa: F401

            self._parts.wait()
        self._parts.grow(folder, done, planned)

    def close(self) -> None:
        if self._parts:
            self._parts.close()

    def report(self, folder: Path, damage: tuple[str, ...] = ()) -> Reported:
        from bench.report.page import write_run_report
        from bench.run.engine import TRACEBACK

        write = partial(write_run_report, folder, (), damage, self._parts)
        return in_own_thread(write) if (folder / TRACEBACK).is_file() else write()


def run_script(
    script: AnyScript = None,
    rig: AnyRig = "emulated",
    *,
    out: Path | str = OUT,
    detectors: Sequence[str] = (),
    seed: int | None = None,
    record: Path | str | None = None,
    realtime: bool = False,
    speed: float | None = None,
    capture: CaptureFile | None = None,
    progress: Progress | None = None,
    typed: Callable[[], str | None] = lambda: None,
    begun: Callable[[str], None] = lambda _: None,
    events: Path | str | None = None,
    notify: Sequence[str] = (),
) -> Reported:
    """Run a trial script on a rig, and write its report: `teatbench run`. ``record``: also a
    recording there; ``speed`` of emulators that are watched, 1 for real time; ``typed``: lines of a
    person; ``begun`` gets where the run is kept and how long it takes; ``events``: a file for them,
    a JSON line each; ``notify``: who gets word, in place of the rig's [notify]. A fault ends the
    run, which is then reported. Raises ConfigError, LatchedError, RigInUseError before anything is
    opened.
    """
    (found,) = run_queue(
        [script],
        rig,
        out=out,
        detectors=detectors,
        seed=seed,
        record=record,
        realtime=realtime,
        speed=speed,
        capture=capture,
        progress=progress,
        typed=typed,
        begun=begun,
        events=events,
        notify=notify,
    )
    return found


def run_queue(
    scripts: Sequence[AnyScript],
    rig: AnyRig = "emulated",
    *,
    out: Path | str = OUT,
    detectors: Sequence[str] = (),
    seed: int | None = None,
    record: Path | str | None = None,
    realtime: bool = False,
    speed: float | None = None,
    capture: CaptureFile | None = None,
    progress: Progress | None = None,
    typed: Callable[[], str | None] = lambda: None,
    begun: Callable[[str], None] = lambda _: None,
    events: Path | str | None = None,
    notify: Sequence[str] = (),
) -> tuple[Reported, ...]:
    """As `run_script`, one script after the other on a rig that stays open and warm. Fewer come
    back where a trip, an abort or what could not be made safe ended them.
    """
    from bench.run.start import RunOptions
    from bench.run.start import run_queue as started

    shown, tested = progress or QuietProgress(), several("detectors", detectors)
    loaded, *found = all_of(
        lambda _: load_rig(rig),
        *(lambda to, one=one: load_script(one, to[0]) for one in several("scripts", scripts, 1)),
    )
    check_within(FROM_0, seed=seed)
    check_within(SPEED, speed=speed)
    if speed is not None and not loaded.rig.simulated:
        raise ConfigError.plain("speed is for an emulated rig: no real instrument is hurried.")
    to = Path(record) if record is not None else None
    if to and len(found) > 1:
        raise ConfigError.plain("`record` is of one script. Give one, or leave `record` out.")
    how = RunOptions(seed, tested, to, realtime or speed is not None, speed, capture, typed, begun)
    urls = several("notify", notify) or loaded.rig.notify.urls
    with closing(_Parts(shown)) as parts, _followed(shown, events, urls) as (stream, word):
        ended = started(loaded, found, Path(out), stream, replace(how, between=parts.grow))
        stream.state("writing the report")
        reports: list[Reported] = []
        for (folder, _), script in zip(ended, found, strict=False):
            try:
                reports.append(_timed(parts.report(folder), loaded, script))
            # of a full disk, or a file that is gone: each is kept, whatever becomes of the others
            except (OSError, sqlite3.Error, ConfigError, RecordingError) as error:
                if len(found) == 1:
                    raise
                at = getattr(error, "filename", None) or folder
                stream.warn(f"{at}: {refusal(error)}")
        word([one.status for one in reports], Path(out) if len(found) > 1 else None)
    return tuple(reports)


Word = Callable[[Sequence[RunStatus], Path | None], None]


@contextmanager
def _followed(
    shown: Progress, file: Path | str | None, urls: Sequence[str]
) -> Iterator[tuple[Events, Word]]:
    """A run's events, shown, written to ``file`` and sent as word to ``urls``; what sends the last
    word, of all runs as they ended, and how the queue in a folder did.
    """
    from bench.run.notify import notifying, text_of

    with event_lines(None if file is None else Path(file)) as lines:
        events = Events(shown, lines)
        with notifying(urls, events.warn) as send:

            def ended(runs: Sequence[RunStatus], queue: Path | None = None) -> None:
                where = f" ({runs[0].rig})" if runs else ""
                title, texts = " ".join(f"Queue{where}: {ENDED}".split()), list[str]()
                if queue:
                    from bench.report.runs import queue_headline

                    texts.append(f"Queue: {queue_headline(queue, [one.run for one in runs])}")
                for status in runs:
                    own, text = text_of(ENDED, status) or ("", "")
                    title = title if queue else own
                    texts.append(f"{status.run}: {text}" if queue else text)
                send(ENDED, lambda: (title, "\n\n".join(texts)))

            events.notify = lambda kind: send(kind, lambda: text_of(kind, events.status()))
            yield events, ended


def _timed(found: Reported, rig: LoadedRig, script: LoadedScript) -> Reported:
    """With how long it took, by which the next estimate is better. A run that stopped shows
    nothing, and one on a warm rig did not heat.
    """
    spent = estimate.took(record := found.record)
    if found.status.state != "finished" or "total_s" not in spent:
        return found
    expected = estimate.needs(rig, script, estimate.read_durations(record.folder.parent, rig)).time
    warm = record.facts[ASKED].get("warm")
    if warm and "settling_s" not in spent:  # the bath was stable since the run before
        expected = replace(expected, preparing_s=0.0, settling_s=0.0)
    if not warm:
        with suppress(OSError):  # an estimate isn't worth a fault
            figures = estimate.figures(record, rig, script, spent)
            estimate.write_durations(record.folder, rig, expected, spent, figures)
    return replace(found, took=estimate.estimate_text(expected, spent))


def rig_of_run(run: Path | str) -> LoadedRig:
    """The rig that a run was begun on. Raises ConfigError where it is gone or was changed since."""
    return files_of(read_run(run))[0]


@contextmanager
def program(usage: str, *kinds: Callable[[str], Any]) -> Iterator[Sequence[Any]]:
    """The words after a program's name as ``kinds``; without any, you read them. Wrong ones, and
    errors of ours within, end it as a command: by a sentence, and exit code 2, or 3 (instruments).
    """
    try:
        with wrong_use():
            if len(words := sys.argv[1:]) != len(kinds) > 0:
                raise ValueError(f"{plural(len(kinds), 'word')} needed.\n\n{usage.strip()}")
            given = [kind(word) for kind, word in zip(kinds, words, strict=False)]
        yield given
    except (ConfigError, RecordingError, InstrumentError, OSError) as error:
        to_stderr(str(error))
        sys.exit(3 if isinstance(error, InstrumentError) else 2)


def resume_run(
    folder: Path | str,
    *,
    capture: CaptureFile | None = None,
    progress: Progress | None = None,
    typed: Callable[[], str | None] = lambda: None,
    begun: Callable[[str], None] = lambda _: None,
    events: Path | str | None = None,
    notify: Sequence[str] = (),
    damage: Damage = None,
) -> Reported:
    """Go on with a run that stopped, at its first trial without a result: `teatbench resume`.
    ``damage`` of its record is what `checked_first` found; without it that is looked at first.
    Raises ConfigError, also for a damaged record.
    """
    from bench.run.start import RunOptions
    from bench.run.start import resume_run as resumed

    shown = progress or QuietProgress()
    with closing(_Parts(shown)) as parts, known_damage([Path(folder)], damage) as there:
        how = RunOptions(capture=capture, typed=typed, begun=begun, between=parts.grow)
        urls = several("notify", notify) or rig_of_run(folder).rig.notify.urls
        with _followed(shown, events, urls) as (stream, word):
            resumed(Path(folder), stream, how)
            stream.state("writing the report")
            found = parts.report(Path(folder), there)
            word([found.status], None)
            return found


def score_recording(
    recording: Path | str,
    detectors: Sequence[str | Detector] = ("fused",),
    *,
    out: Path | str = OUT,
    progress: Progress | None = None,
) -> Reported:
    """Score detectors on recorded frames, into a run folder with a report: `teatbench score`.
    Raises ConfigError, RecordingError.
    """
    from bench.run.events import SafeProgress
    from bench.run.start import score_recording as scored

    shown = SafeProgress(progress or QuietProgress())
    folder = scored(Path(recording), Path(out), shown, several("detectors", detectors, 1))
    shown.state("writing the report")
    return write_report(folder, damage=())


def write_report(
    folder: Path | str, *, baseline: Path | str | None = None, damage: Damage = None
) -> Reported:
    """Write the report of a run again: `teatbench report`; compared with the older run ``baseline``
    of the same scenes. ``damage`` as of `resume_run`. Raises ConfigError; a damaged record's report
    of before is withdrawn then.
    """
    from bench.report.comparison import baseline_parts
    from bench.report.page import write_run_report
    from bench.results.exports import report_withdrawn

    run, older = Path(folder), [Path(baseline)] if baseline is not None else []
    with report_withdrawn(run), known_damage([run, *older], damage) as there:
        # first: a comparison is a look, which the record that is reported then has
        parts = tuple(part for one in older for part in baseline_parts(one, run, there))
        return write_run_report(run, parts, there)


def read_run(folder: Path | str) -> RunRecord:
    """What a run's folder holds: trials with frames, touches, truth, answers and scores; the bath;
    events; facts. Raises ConfigError.
    """
    from bench.record.reader import read_run as read

    return read(Path(folder))


@dataclass(frozen=True, slots=True)
class TrialRow:
    """One trial that has its result; times are the bench's clock."""

    table: ClassVar[str] = "trials"
    id: str
    session: int
    number: int
    name: str
    situation: str
    repeat: int
    started_s: float | None
    ended_s: float | None
    captured_s: float | None
    bath_c: float | None
    bath_state: str | None
    note: str | None
    stage_mm: str | None
    wall_time: str


@dataclass(frozen=True, slots=True)
class TouchRow:
    """One touch of a teat end by the arm, world mm; ``refused``: why it isn't used."""

    table: ClassVar[str] = "touches"
    trial: str
    teat: str
    touch: int
    t_s: float
    x_mm: float
    y_mm: float
    z_mm: float
    spread_mm: float
    packets: int
    counts: str
    refused: str | None
    wall_time: str | None


@dataclass(frozen=True, slots=True)
class TruthOfTeat:
    """The truth of one teat end, world mm, with its standard uncertainty; texts are JSON."""

    table: ClassVar[str] = "truth"
    trial: str
    teat: str
    x_mm: float
    y_mm: float
    z_mm: float
    u_mm: float | None
    visible: int
    exact_mm: str | None
    how: str | None
    budget: str | None
    covariance_mm2: str | None
    cameras: str | None


@dataclass(frozen=True, slots=True)
class DetectionRow:
    """One answer of a detector; ``wall_…`` is real time."""

    table: ClassVar[str] = "detections"
    trial: str
    detector: str
    hidden: int
    reason: str | None
    outcome: str
    cold: int
    trace: str
    wall_seconds: float
    wall_start_up_s: float | None
    wall_stderr: str | None
    wall_cpu_s: float | None
    wall_load: float | None


@dataclass(frozen=True, slots=True)
class FoundRow:
    """One teat end that a detector found, world mm; texts are JSON."""

    table: ClassVar[str] = "found"
    trial: str
    detector: str
    number: int
    x_mm: float
    y_mm: float
    z_mm: float
    covariance_mm2: str | None
    left_px: str | None
    right_px: str | None


@dataclass(frozen=True, slots=True)
class BathRow:
    """One reading of the bath, degC."""

    table: ClassVar[str] = "bath"
    session: int
    t_s: float
    temp_c: float
    external_c: float | None
    power_percent: float | None
    state: str
    wall_time: str | None


@dataclass(frozen=True, slots=True)
class EventRow:
    """Something that happened."""

    table: ClassVar[str] = "events"
    number: int
    session: int
    t_s: float | None
    kind: str
    text: str
    wall_time: str


class TableRow(Protocol):
    """A class of rows: `TrialRow`, `TouchRow`, `TruthOfTeat`, `DetectionRow`, `FoundRow`,
    `BathRow`, `EventRow`.
    """

    table: ClassVar[str]


SomeRow = TypeVar("SomeRow", bound=TableRow)


def read_rows(folder: Path | str, kind: type[SomeRow]) -> tuple[SomeRow, ...]:
    """All rows of one kind, in the order in which they were written. Raises ConfigError."""
    if not hasattr(kind, "table"):
        raise ConfigError.plain(f"kind is {kind.__name__}, no class of rows such as bench.TrialRow")
    names = ", ".join(field.name for field in fields(cast(Any, kind)))
    with opened(Path(folder)) as db:
        found = db.execute(f"SELECT {names} FROM {kind.table} ORDER BY rowid")  # noqa: S608 - our own names
        return tuple(kind(*row) for row in found)


def read_table(folder: Path | str, table: str) -> Any:
    """One table of a run as a DataFrame of pandas, docs/record.md has them. Raises ConfigError for
    an unknown one, and without pandas.
    """
    try:
        pandas = importlib.import_module("pandas")
    except ImportError as error:
        raise ConfigError.plain(f"a table needs pandas: pip install pandas ({error})") from error
    with opened(Path(folder)) as db:
        if table not in (known := tables_of(db)):
            raise ConfigError.plain(f"no table {table!r} (there are: {', '.join(known)})")
        found: sqlite3.Cursor = db.execute(f"SELECT * FROM {table} ORDER BY rowid")  # noqa: S608 - a table's own name
        columns: Sequence[str] = [one[0] for one in found.description]
        rows: Iterator[Any] = iter(found)
        return pandas.DataFrame(list(map(tuple, rows)), columns=columns)
