"""The jobs behind the commands: a run on a rig, scoring a recording; each ends in a run folder."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError, parse_config, read_calibration, read_text
from bench.record.reader import guardian_files, read_run
from bench.record.recording import Recording, TruthRow
from bench.record.schema import GUARDIAN, RULES, SCRIPT, Row
from bench.record.state import end_in_reserve, run_lock
from bench.record.writer import Store
from bench.results import health
from bench.results.answers import Answer, Examiner
from bench.results.cameras_agree import UNCHECKED_FACT, spread, unchecked_text, where_seen
from bench.results.doubts import DOUBTS_FACT, LOOKED_FACT, doubts_of, looked_at
from bench.results.exports import drop_report
from bench.results.queue import ENDED, QueueNote
from bench.results.stated_arm import contradictions, stated_fact
from bench.results.status import INSTRUMENTS_FACT
from bench.rig.devices import Devices
from bench.rig.guardian_client import GuardianClient, Heartbeat, signs_of
from bench.rig.hand_over import free_bath
from bench.rig.leaving import target_of
from bench.rig.loading import LoadedRig
from bench.rig.lock import lock_path, locked
from bench.rig.model import Rig
from bench.rig.opening import in_virtual_time, open_instruments
from bench.rig.urls import is_emulated
from bench.run.cameras_so_far import CamerasSoFar
from bench.run.context import RunContext
from bench.run.engine import RECORD_FAULTS, Engine
from bench.run.estimate import TimeEstimate, needs, no_room, read_durations, refuse_no_room
from bench.run.events import Events, Progress, RunState
from bench.run.interruptions import Requests
from bench.run.live import Live
from bench.run.packing import check_pack
from bench.run.recordings import RECORDED, Recorder, recorder_again
from bench.run.resume import (
    ASKED,
    RehearsedStore,
    ResumePoint,
    files_of,
    keep_guardians,
    open_store,
    what_is_left,
)
from bench.run.rows import write_facts
from bench.run.trial import write_trial
from bench.safety.interlocks import InterlockTrip
from bench.safety.latch import refuse_latched, refuse_unknown_unit, refuse_untested_cut_out
from bench.safety.signals import current, in_own_thread, undisturbed
from bench.script.calibration_age import (
    CALIBRATION_FACT,
    calibration_fact,
    not_fresh,
    refuse_old_calibration,
    refuse_other_cameras,
)
from bench.script.detectors import introduced, make_detectors
from bench.script.model import (
    CAMERAS_RULE,
    RECORDING_RULES,
    ArmRequirement,
    LoadedScript,
    Rules,
    refuse_carry,
)
from bench.script.planned_trials import pose_set
from bench.truth.touching import truth_row
from bench.version import overwritten
from detector.protocol import Detector
from instruments.camera.frame import FrameSet
from instruments.captures.capture import CaptureFile
from instruments.clock import VirtualClock, wall_time
from instruments.errors import InstrumentError
from instruments.operators.console import Console
from instruments.operators.operator import time_left
from textfiles.text import named, plural, sentence
from textfiles.whole import refusal, remove_empty

EMULATED_FACT = "emulated"  # of a run: which of its instruments are, where others are real
BETWEEN_S = 1.0  # of the bench's time, between two sessions of a run
# touches of one end scatter by less, and no bench sets a pose up again this well by chance
SAME_POSE_MM = 1.5
# of a frame set that came without instruments
NOT_KNOWN = ("started_s", "ended_s", "captured_s", "bath_c", "bath_state", "note")
INTERRUPTED = "interrupted (Ctrl-C)"


@dataclass(frozen=True, slots=True)
class RunOptions:
    """``seed`` and ``detectors`` instead of the rig's and the script's; ``speed`` of emulators that
    are watched; ``typed`` gives typed lines; ``begun`` gets where the run is kept, and how long it
    takes; ``between`` two trials gets the folder, how many have passed, and of how many.
    """

    seed: int | None = None
    detectors: Sequence[str] = ()
    record: Path | None = None
    realtime: bool = False
    speed: float | None = None
    capture: CaptureFile | None = None
    typed: Callable[[], str | None] = lambda: None
    begun: Callable[[str], None] = lambda _: None
    between: Callable[[Path, int, int], None] = lambda *_: None


def run_queue(
    rig: LoadedRig,
    scripts: Sequence[LoadedScript],
    out: Path,
    progress: Progress,
    how: RunOptions | None = None,
) -> list[tuple[Path, RunState]]:
    """Run ``scripts`` on ``rig``, shown on ``progress``; each run's folder and how it ended. After
    one that finished the rig stays open and warm; after a fault it is opened anew. A trip, an
    abort, what could not be made safe and a disk without room end them all. Raises ConfigError,
    LatchedError, RigInUseError before anything is opened.
    """
    how = how or RunOptions()
    events = progress if isinstance(progress, Events) else Events(progress)
    for script in scripts:
        refuse_carry(rig, script)
    under_test = [_allowed(rig, script, how.detectors) for script in scripts]
    how = replace(how, seed=rig.rig.seed if how.seed is None else how.seed)
    ended: list[tuple[Path, RunState]] = []
    refuse_no_room(rig, sum(len(script.planned) for script in scripts), out, how.record)
    with (
        locked(lock_path(rig), str(out.resolve()), events.warn),
        closing(RigSession(rig, how, events)) as held,
    ):
        warned = health.warnings(out, rig.rig.name)
        note = QueueNote.begin(out, rig.rig.name, [one.name for one in scripts])
        for number, (script, detectors) in enumerate(zip(scripts, under_test, strict=True), 1):
            held.more = number < len(scripts)
            stale = not_fresh(rig, script, wall_time().date())
            for text in (*_contradicted(rig, script), *stale, *filter(None, [overwritten()])):
                events.warn(text)
            recorded = None
            if how.record:
                recorded = Recorder(how.record, rig.calibration_path, events.warn)
            with introduced(detectors, script.scenes, rig.calibration):
                try:
                    if ended:
                        refuse_no_room(rig, len(script.planned), out)
                    store = _begun(held, script, out, detectors)
                except (ConfigError, KeyboardInterrupt) as error:
                    why = str(error) if isinstance(error, ConfigError) else INTERRUPTED
                    note.ends(why)
                    if not ended:
                        raise
                    events.warn(f"{script.name} and what follows are not begun. {why}")
                    break
                note.runs(store.folder)
                with locked(run_lock(store.folder), "", events.warn, "run"):
                    run = partial(_run, script, store, detectors, held, recorded, warned=warned)
                    ended.append(_of_a_queue(run, store, events) if len(scripts) > 1 else run())
            if ended[-1][1] is RunState.ABORTED:
                held.ends = held.ends or "a run was aborted"
            if held.ends:
                note.ends(held.ends)
                break
            warned = []
        note.ends(ENDED)
    return ended


def _of_a_queue(
    run: Callable[[], tuple[Path, RunState]], store: Store, events: Events
) -> tuple[Path, RunState]:
    """One run of a queue: a mistake of the bench in it does not end the queue."""
    try:
        return run()
    except Exception as error:
        events.warn(f"{store.folder}: {named(error)}")
        return store.folder, RunState.FAULTED


def resume_run(
    folder: Path, progress: Progress, how: RunOptions | None = None
) -> tuple[Path, RunState]:
    """Continue the run in ``folder`` at its first trial without a result, as it was begun. Raises
    ConfigError, LatchedError, RigInUseError.
    """
    how = how or RunOptions()
    events = progress if isinstance(progress, Events) else Events(progress)
    rig, script = files_of(run := read_run(folder))
    if rig.rig.cameras.recorded:
        raise ConfigError.plain(
            f"{folder} can't be resumed: its cameras play a recording, which would begin anew."
            " Start a new run."
        )
    asked = run.facts[ASKED]
    how = replace(
        how,
        seed=int(run.facts["seed"]),
        detectors=tuple(asked["detectors"]),
        record=None,
        realtime=bool(asked["realtime"]),
        speed=asked.get("speed"),
    )
    under_test = _allowed(rig, script, how.detectors)
    here = str(folder.resolve())
    run_locked = locked(run_lock(folder), here, lambda _: None, "run")
    with (
        introduced(under_test, script.scenes, rig.calibration),
        locked(lock_path(rig), here, events.warn),
        run_locked,
    ):
        left = what_is_left(folder, [trial.id for trial in script.planned])
        refuse_no_room(rig, len(script.planned) - len(left.done), folder)
        recorder = recorder_again(left.run, rig.calibration_path, events.warn)
        again = in_virtual_time(rig, realtime=how.realtime) and not asked.get("warm")
        store = open_store(left, rehearsed=again)
        with closing(RigSession(rig, how, events)) as held:
            return _run(script, store, under_test, held, recorder, left)


def _contradicted(rig: LoadedRig, script: LoadedScript) -> Iterator[str]:
    """Limits of the script that an arm exactly as the rig states it breaks."""
    arm = rig.rig.arm
    touches = (arm.check_touches,) * 2 if arm.check_point_mm is not None else ()
    for rule in script.script.requirements:
        if isinstance(rule, ArmRequirement):
            said = contradictions(rule, stated_fact(arm), touches, rig.verification)
            yield from (f"{rule.name}: {text}" for text in said)


def _allowed(rig: LoadedRig, script: LoadedScript, names: Sequence[str]) -> list[Detector]:
    """The detectors under test, unless a run is refused (LatchedError, ConfigError)."""
    today = wall_time().date()
    rig.refuse_unfilled()
    refuse_latched(rig)
    refuse_old_calibration(rig, script, today)
    refuse_untested_cut_out(rig, today)
    refuse_unknown_unit(rig, today)
    wanted = (names,) if names else (script.script.detectors, script.path.parent)
    return make_detectors(*wanted)


def kind_facts(rig: Rig) -> dict[str, Any]:
    """Whether its instruments are real, and where some are, which of them are emulated."""
    if rig.partly_emulated:
        return {"kind": "mixed", EMULATED_FACT: list(rig.partly_emulated)}
    real = "recorded" if rig.cameras.recorded else "real"
    return {"kind": "emulated" if rig.all_emulated else real}


def _begun(
    held: RigSession, script: LoadedScript, out: Path, under_test: Sequence[Detector]
) -> Store:
    """A new run folder that says what the run is."""
    rig, how = held.rig, held.how
    files = {**rig.arm_files, **rig.answer_files, **script.layout_files, **script.truth_files}
    files |= {**script.source_files, "rig.toml": rig.text, SCRIPT: script.text}
    table, trials = script.script, script.script.trials
    order = pose_set(trials, script.planned, seed=table.seed, order=table.order)
    today = wall_time().date()
    recorded = rig.rig.cameras.recorded
    facts = {
        **kind_facts(rig.rig),
        "title": table.title,
        "about": table.about,
        "seed": how.seed,
        "rig": rig.rig.name,
        "script": script.name,
        "set_point_c": table.bath.set_point_c,
        "planned": len(script.planned),
        CALIBRATION_FACT: calibration_fact(rig.calibration, today, emulated=rig.rig.all_emulated),
        "pose set": order,
        **({RECORDED: str(how.record.resolve())} if how.record else {}),
        ASKED: {
            "rig": str(rig.path.resolve()),
            "script": str(script.path.resolve()),
            "detectors": list(how.detectors),
            "realtime": how.realtime,
            "speed": how.speed,
            "warm": held.is_warm,  # as the run before left it
            **({"recorded": True} if recorded else {}),  # cameras: it can't be resumed
        },
    }
    with undisturbed():  # a run that is there at all says what it is, and how it ended
        store = _new_store(out, script.name, files, rig.calibration_path)
        try:
            write_facts(store, facts, under_test, rig.calibration_path)
        except BaseException:
            store.close()
            raise
    return store


def _run(
    script: LoadedScript,
    store: Store,
    under_test: Sequence[Detector],
    held: RigSession,
    recorder: Recorder | None,
    left: ResumePoint | None = None,
    warned: Sequence[str] = (),
) -> tuple[Path, RunState]:
    """From open files to an ended run; closes store and detectors."""
    rig, how, events = held.rig, held.how, held.events
    try:
        current().check_interrupts()
        expected = needs(rig, script, read_durations(store.folder.parent, rig)).time
        if held.warm_bath == script.script.bath:
            expected = replace(expected, preparing_s=0.0, settling_s=0.0)
        trials = len(script.planned)
        to_do = trials - len(left.done) if left else trials
        Requests(store.folder, how.typed, events.warn).forget()
        Live(store.folder).end()
        drop_report(store.folder)
        first_s = expected.preparing_s + expected.settling_s
        left_s = (first_s + to_do * expected.each_s(trials)) / (how.speed or 1.0)
        whose = f"at {how.speed:g} times the speed" if how.speed else "of the bench's time"
        note = f"{plural(to_do, 'trial')}, {time_left(left_s)} {whose}"
        how.begun(f"{note}. Run folder: {store.folder}")
        with events.kept_in(store.folder, lambda: read_run(store.folder, whole=False).events):
            for text in warned:
                events.warn(f"Bench health: {text}")
            if store.keeps_pictures:  # a minute's compiling, once: a bench that heats would hang
                import_module("detector.outline.kernels")
            try:
                engine = held.engine_of(
                    script, store, under_test, recorder=recorder, left=left, expected=expected
                )
                with engine.context.devices.practice(store.folder):
                    return store.folder, engine.run()
            finally:
                if not held.is_warm:
                    held.close()
    # before the engine had the instruments: nothing was switched on
    except (InstrumentError, KeyboardInterrupt) as error:
        if isinstance(store, RehearsedStore):
            store.silent = False
        if not left:  # else its bath may still heat, since an earlier session
            store.fact(INSTRUMENTS_FACT, {"session": store.session, "instruments": []})
        if isinstance(error, KeyboardInterrupt):
            return store.folder, _end(store, RunState.ABORTED, INTERRUPTED)
        return store.folder, _end(store, RunState.FAULTED, str(error))
    finally:
        _close(store)


def _close(store: Store) -> None:
    """Raises sqlite3.Error where what it had no room for isn't kept either."""
    try:
        store.close()
    except sqlite3.OperationalError:
        if not end_in_reserve(store.folder, store.session):
            raise


class RigSession:
    """The instruments of one run after the other: opened with the first, made safe and closed where
    one has not finished or none follows. ``more``: another script follows.
    """

    def __init__(self, rig: LoadedRig, how: RunOptions, events: Events) -> None:
        self.rig, self.how, self.events = rig, how, events
        self.more = False
        self.ends = ""  # why no script may follow
        self._stack = ExitStack()
        self._opened: tuple[Devices, Heartbeat, GuardianClient | None] | None = None
        self._engine: Engine | None = None

    @property
    def is_warm(self) -> bool:
        """Whether the last run left all open, heated and watched."""
        return self._engine is not None and self._engine.is_warm

    @property
    def warm_bath(self) -> object:
        """The script's bath table that the last run left the rig warm with, else None."""
        return self._engine.context.script.script.bath if self._engine and self.is_warm else None

    def engine_of(
        self,
        script: LoadedScript,
        store: Store,
        under_test: Sequence[Detector],
        *,
        recorder: Recorder | None,
        left: ResumePoint | None,
        expected: TimeEstimate,
    ) -> Engine:
        """The engine of a run on this rig. Raises as opening the rig does."""
        before, self._engine = self._engine, None
        if self._opened is None:
            guarded = _guarded_instruments(self.rig, store, self.how, self.events, left)
            self._opened = self._stack.enter_context(guarded)
        devices, heartbeat, guardian = self._opened
        if before and isinstance(devices.operator, Console):
            devices.operator.asked_in(store.folder)
        refuse_other_cameras(self.rig.calibration.record, devices.cameras.identity)
        of_rig = (devices, store, self.events, heartbeat, guardian)
        ctx = RunContext(self.rig, script, *of_rig, before.context if before else None)
        if guardian:
            guardian.heats = True
        self._engine = Engine(
            ctx,
            under_test,
            exact_ends=devices.exact_ends,
            recorder=recorder,
            left=left,
            typed=self.how.typed,
            expected=expected,
            more=self.more,
            between=partial(self.how.between, store.folder),
        )
        return self._engine

    def close(self) -> None:
        """Make safe what is warm, and close all; nothing where that is done."""
        engine, opened, self._engine, self._opened = self._engine, self._opened, None, None
        try:
            if engine:
                ctx = engine.context
                trip = ctx.watch.tripped or (ctx.before and ctx.before.watch.tripped)
                if engine.is_warm:
                    engine.let_go()
                by = "tripped by" if isinstance(trip, InterlockTrip) else "the watch failed:"
                of_run = isinstance(trip, RECORD_FAULTS)  # it ended that one
                self.ends = self.ends or ("" if of_run or not trip else f"{by} {trip}")
                unsafe = not engine.bath_is_safe or ctx.devices.active
                self.ends = self.ends or ("an instrument is not safe" if unsafe else "")
                if opened and (guardian := opened[2]) and engine.bath_is_safe:
                    guardian.done()
        finally:
            if engine and engine.mistaken:
                in_own_thread(self._stack.close)
            else:
                self._stack.close()


@contextmanager
def _guarded_instruments(
    rig: LoadedRig, store: Store, how: RunOptions, events: Events, left: ResumePoint | None
) -> Iterator[tuple[Devices, Heartbeat, GuardianClient | None]]:
    """The instruments and, in real time, their guardian: before them, since an earlier one may have
    the bath and its port; behind them where the bath is this process's own.
    """
    heartbeat = Heartbeat()
    with ExitStack() as stack:

        def guardian_of(bath_url: str, pump_url: str, stage_url: str) -> GuardianClient:
            target = target_of(rig, bath=bath_url, pump=pump_url, stage=stage_url)
            name = GUARDIAN.format(store.session)
            client = GuardianClient(target, store.folder, heartbeat, name)
            stack.enter_context(client)
            client.heats = bool(client.taken_from)  # or not yet
            if client.taken_from:
                text = f"{client.taken_from}; this session has the bath now"
                store.event(None, "guardian", text, wall_time())
                events.warn(sentence(text))
            return client

        bath, guardian = rig.rig.bath, None
        if not is_emulated(bath.url):
            stage = rig.rig.stage
            real = stage and not is_emulated(stage.url)
            guardian = guardian_of(bath.url, bath.pump_url, stage.url if stage and real else "")
        again = isinstance(store, RehearsedStore)  # from the time when it began
        if left:
            if is_emulated(bath.url):
                for note in guardian_files(store.folder).values():
                    free_bath(str(note["bath"]), store.folder)  # it died with its bench
            keep_guardians(store)
        opened = open_instruments(
            rig,
            seed=how.seed or 0,
            realtime=how.realtime,
            speed=how.speed,
            capture=how.capture,
            supervised=True,
            screen=events.aside,
            start_s=left.last_s + BETWEEN_S if left and not again else 0.0,
            folder=store.folder,
        )
        devices = stack.enter_context(opened)
        if is_emulated(bath.url) and not isinstance(devices.clock, VirtualClock):
            of_stage = devices.stage.url if devices.stage else ""
            guardian = guardian_of(devices.bath.url, devices.bath.pump_url, of_stage)
        stack.enter_context(signs_of(heartbeat, devices.clock))
        yield devices, heartbeat, guardian


def score_recording(
    path: Path, out: Path, progress: Progress, detectors: Sequence[str | Detector]
) -> Path:
    """Score detectors over a recording; the run's folder. Raises ConfigError, RecordingError."""
    check_pack(path)
    under_test, recording, path = make_detectors(detectors), Recording(path), path.resolve()
    calibration = read_calibration(recording.calibration_path, doubtful=True)
    pictures = (path / "frames").rglob("*.png")  # kept once more, beside those of the stages
    if room := no_room(2e-6 * sum(one.stat().st_size for one in pictures), out):
        raise ConfigError.plain(room)
    doubts = doubts_of(recording, calibration)
    # a rig is refused by what it is, and a calibration that can't be does not say
    of_rig = None if doubts else calibration
    with introduced(under_test, members_of(recording), of_rig):
        truth = {} if doubts else recording.truth  # nothing is charged where none can be found
        examiner, so_far = Examiner(calibration), CamerasSoFar()
        rules, planned, poses = RECORDING_RULES, len(recording.frames), _pose_names(recording)
        seen = {
            frame: where_seen(recording.load(frame), calibration, truth.get(frame, ()))
            for frame in spread(dict.fromkeys(poses.values()))
        }
        unchecked = unchecked_text(seen, recording.truth)
        text = read_text(rules)
        if not unchecked:  # what can't be checked in a recording keeps no detector from its verdict
            text = f"{text}\n{read_text(CAMERAS_RULE)}"
        facts: dict[str, Any] = {"kind": "recorded", "title": f"Recording {path.name}"}
        facts |= {"about": str(path), "planned": planned}
        facts |= {DOUBTS_FACT: doubts} if doubts else {}
        facts |= {UNCHECKED_FACT: unchecked} if unchecked else {}
        facts |= {LOOKED_FACT: looked_at(recording)}
        with ScoredFrames(
            out, f"score-{path.name}", rules, text, recording.calibration_path, facts, under_test
        ) as run:
            for number, frame in enumerate(recording.frames, 1):
                progress.trial(number - 1, planned, frame)
                frames = recording.load(frame)
                off = so_far.context
                answers = [examiner.ask(one, frames, off) for one in under_test if not doubts]
                known, scored = recording.truth.get(frame, ()), truth.get(frame, ())
                ends = seen.get(frame, {})
                rows = [truth_row("", row, seen=ends.get(row.teat)) for row in known]
                so_far.add(poses[frame], rows)
                situation = known[0].situation if known else "unknown"
                run.add(frame, poses[frame], situation, frames, answers, scored, rows)
            progress.trial(planned, planned, "")
        return run.folder


@dataclass(eq=False)
class ScoredFrames:
    """A run of frames without a script, each a trial as it comes, held against the rules in
    ``text``. Leaving it ends the run; an error leaves none.
    """

    out: Path
    name: str
    rules: Path
    text: str
    calibration: Path
    facts: Mapping[str, Any]
    under_test: Sequence[Detector]
    early: str = field(default="", init=False)  # why it is left before its end

    def __post_init__(self) -> None:
        self._rules, self._count = parse_config(self.rules, self.text, Rules), 0
        self._is_new = not self.out.exists()
        self._store = _new_store(self.out, self.name, {RULES: self.text}, self.calibration)
        try:
            write_facts(self._store, self.facts, self.under_test, self.calibration)
        except BaseException:
            self._drop()
            raise

    @property
    def folder(self) -> Path:
        return self._store.folder

    def __enter__(self) -> Self:
        return self

    def fact(self, name: str, value: Any) -> None:
        """Write a further fact of the run."""
        self._store.fact(name, value)

    def add(
        self,
        frame: str,
        pose: str,
        situation: str,
        frames: FrameSet,
        answers: Sequence[Answer],
        truth: Sequence[TruthRow],
        rows: Sequence[Row],
    ) -> None:
        """Score ``answers`` against ``truth`` and write the trial; ``rows``: the truth as kept."""
        self._count += 1
        trial = f"{self._count:03d}-{frame}"
        head = {
            **dict.fromkeys(NOT_KNOWN),
            "id": trial,
            "number": self._count,
            "name": pose,
            "situation": situation,
            "repeat": 1,  # each is a pose of its own
            "wall_time": wall_time().isoformat(timespec="milliseconds"),
        }
        kept = [{**row, "trial": trial} for row in rows]
        write_trial(self._store, self._rules, head, frames, answers, truth, kept)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if error is not None and not isinstance(error, KeyboardInterrupt):
            self._drop()  # a frame that can't be read: half a run is of no use
            return False
        try:
            if why := INTERRUPTED if error else self.early:
                _end(self._store, RunState.ABORTED, why)
            else:
                _end(self._store, RunState.FINISHED)
        finally:
            self._store.close()
        return error is not None

    def _drop(self) -> None:
        try:
            self._store.close()
        finally:
            shutil.rmtree(self._store.folder, ignore_errors=True)
            if self._is_new:
                remove_empty([self.out])


def members_of(recording: Recording) -> dict[str, list[int]]:
    """Family -> members, of the frames that are called as `scene record` calls them."""
    members: dict[str, list[int]] = {}
    for frame, rows in recording.truth.items():
        family, _, number = frame.rpartition("-")
        if rows[0].situation == family and number.isdecimal():
            members.setdefault(family, []).append(int(number))
    return members


def _pose_names(recording: Recording) -> dict[str, str]:
    """For each frame the first one of the same pose (same situation and teats, each end within
    SAME_POSE_MM): frames of one pose are repeats.
    """
    names: dict[str, str] = {}
    # by situation and teats: names of the first frames, and their ends (n, 3)
    firsts: dict[tuple[tuple[str, str], ...], dict[str, NDArray[np.float64]]] = {}
    for frame in recording.frames:
        names[frame] = frame
        if truth := recording.truth.get(frame):
            ends = np.array([teat.xyz_mm for teat in truth])
            known = firsts.setdefault(tuple((teat.situation, teat.teat) for teat in truth), {})
            for first, there in known.items():
                if (np.linalg.norm(ends - there, axis=1) <= SAME_POSE_MM).all():
                    names[frame] = first
                    break
            else:
                known[frame] = ends
    return names


def _new_store(out: Path, name: str, files: dict[str, str], calibration: Path) -> Store:
    try:
        files = {**files, "calibration.toml": read_text(calibration)}
        return Store.create_next(out, name, wall_time(), files)
    except OSError as error:
        why = refusal(error, "Name another folder as `out`.")
        raise ConfigError.plain(f"a run can't be kept in {out}: {why}") from error


def _end(store: Store, ending: RunState, why: str = "") -> RunState:
    if why:
        kind = "aborted" if ending is RunState.ABORTED else "fault"
        store.event(None, kind, why, wall_time())
    store.event(None, "end", ending.value, wall_time())
    store.fact("ending", ending.value)
    store.fact("wall_ended", wall_time().isoformat(timespec="seconds"))
    return ending
