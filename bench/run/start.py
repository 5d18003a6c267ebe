"""The main jobs behind the commands: a run on a rig, and scoring a recording; both end in one run
folder and one report.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bench.config import ConfigError, read_calibration, read_config, read_text
from bench.record.reader import TrialRecord, read_run
from bench.record.schema import RULES, SCRIPT
from bench.record.writer import Store, new_run_folder
from bench.results.answers import Examiner, close_detectors
from bench.rig.loading import LoadedRig
from bench.rig.opening import in_virtual_time, open_instruments
from bench.run.context import RunContext
from bench.run.engine import Ending, Engine
from bench.run.estimate import needs, read_learnt
from bench.run.events import Events, Progress
from bench.run.lock import lock_path, locked, run_lock
from bench.run.recordings import RECORDED, Recorder, recorder_again
from bench.run.resume import ASKED, RehearsedStore, ResumePoint, files_of, open_store, what_is_left
from bench.run.rows import frame_rows, judged, truth_row, write_facts
from bench.run.truth_source import refuse_carry
from bench.safety.guardian_client import GuardianTarget, guarded
from bench.safety.latch import refuse_latched, refuse_untested_cut_out
from bench.safety.signals import current, undisturbed
from bench.script.calibration_age import (
    CALIBRATION_FACT,
    calibration_fact,
    refuse_old_calibration,
    refuse_other_cameras,
)
from bench.script.detectors import make_detectors
from bench.script.model import RECORDING_RULES, LoadedScript, Rules
from bench.script.planned_trials import pose_set
from detector.protocol import Detector
from instruments.camera.recording import Recording
from instruments.captures.capture import NO_CAPTURE, Captures
from instruments.clock import wall_time
from instruments.errors import InstrumentError
from instruments.operators.operator import time_left

BETWEEN_S = 1.0  # of the bench's time, between two sessions of a run
# touches of one end scatter by less, and no bench sets a pose up again this well by chance
SAME_POSE_MM = 1.5


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What a command line says of how a run is run: ``seed`` and ``detectors`` instead of the rig's
    and the script's; ``typed`` gives lines that somebody typed, None while there is none.

    ``begun`` gets a line for the person at the terminal: where the run is kept, and how long it
    takes.
    """

    seed: int | None = None
    detectors: Sequence[str] = ()
    record: Path | None = None
    realtime: bool = False
    capture: Captures = NO_CAPTURE
    typed: Callable[[], str | None] = lambda: None
    begun: Callable[[str], None] = lambda _: None


def run_script(
    rig: LoadedRig,
    script: LoadedScript,
    out: Path,
    progress: Progress,
    how: RunOptions | None = None,
) -> tuple[Path, Ending]:
    """Run ``script`` on ``rig``, shown on ``progress`` (which may be the stream itself, `Events`);
    gives back the run's folder and how it ended.

    Raises ConfigError before anything is opened, LatchedError where an interlock's trip has not
    been acknowledged, and RigInUseError.
    """
    how, events = how or RunOptions(), _stream(progress)
    refuse_carry(rig, script)
    under_test = _allowed(rig, script, how.detectors)
    how = replace(how, seed=rig.rig.seed if how.seed is None else how.seed)
    with locked(lock_path(rig), str(out.resolve()), events.warn):
        recorder = Recorder(how.record, rig.calibration_path, events.warn) if how.record else None
        store = _begun(rig, script, out, under_test, how)
        with locked(run_lock(store.folder), "itself", events.warn, "run"):
            return _run(rig, script, store, under_test, events, how, recorder)


def resume_run(
    folder: Path, progress: Progress, how: RunOptions | None = None
) -> tuple[Path, Ending]:
    """Go on with the run in ``folder`` at its first trial without a result. Raises ConfigError,
    LatchedError, RigInUseError.

    Seed, detectors, kind of time and where it is recorded are the run's own.
    """
    how, events = how or RunOptions(), _stream(progress)
    rig, script = files_of(run := read_run(folder))
    if rig.rig.cameras.url.startswith("recording:"):
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
    )
    under_test = _allowed(rig, script, how.detectors)
    here = str(folder.resolve())
    with (
        locked(lock_path(rig), here, events.warn),
        locked(run_lock(folder), here, lambda _: None, "run"),
    ):
        left = what_is_left(folder, [trial.id for trial in script.planned])
        recorder = recorder_again(left.run, rig.calibration_path, events.warn)
        store = open_store(left, rehearsed=in_virtual_time(rig, realtime=how.realtime))
        return _run(rig, script, store, under_test, events, how, recorder, left)


def _stream(progress: Progress) -> Events:
    return progress if isinstance(progress, Events) else Events(progress)


def _allowed(rig: LoadedRig, script: LoadedScript, names: Sequence[str]) -> list[Detector]:
    """The detectors under test, once nothing stands against a run. Raises LatchedError,
    ConfigError.
    """
    today = wall_time().date()
    refuse_latched(rig)
    refuse_old_calibration(rig, script, today)
    refuse_untested_cut_out(rig, today)
    if names:
        return make_detectors(names)
    return make_detectors(script.script.detectors, script.path.parent)


def _begun(
    rig: LoadedRig, script: LoadedScript, out: Path, under_test: Sequence[Detector], how: RunOptions
) -> Store:
    """A new run folder that says what the run is."""
    files = {
        **rig.arm_files,
        **rig.answer_files,
        **script.layout_files,
        **script.truth_files,
        **script.source_files,
        "rig.toml": rig.text,
        SCRIPT: script.text,
    }
    recorded = rig.rig.cameras.url.startswith("recording:")
    kind = "emulated" if rig.rig.all_emulated else "recorded" if recorded else "real"
    facts = {
        "kind": kind,
        "title": script.script.title,
        "about": script.script.about,
        "seed": how.seed,
        "rig": rig.rig.name,
        "script": script.name,
        "set_point_c": script.script.bath.set_point_c,
        "planned": len(script.planned),
        CALIBRATION_FACT: calibration_fact(
            rig.calibration, wall_time().date(), emulated=kind == "emulated"
        ),
        "pose set": pose_set(
            script.script.trials, script.planned, seed=script.script.seed, order=script.script.order
        ),
        **({RECORDED: str(how.record.resolve())} if how.record else {}),
        ASKED: {
            "rig": str(rig.path.resolve()),
            "script": str(script.path.resolve()),
            "detectors": list(how.detectors),
            "realtime": how.realtime,
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
    rig: LoadedRig,
    script: LoadedScript,
    store: Store,
    under_test: Sequence[Detector],
    events: Events,
    how: RunOptions,
    recorder: Recorder | None,
    left: ResumePoint | None = None,
) -> tuple[Path, Ending]:
    """From open files to an ended run; closes store and detectors."""
    try:
        try:
            current().check_interrupts()
            expected = needs(rig, script, read_learnt(store.folder.parent, rig)).time
            trials = len(script.planned)
            to_do = trials - len(left.done) if left else trials
            left_s = expected.settling_s + to_do * expected.each_s(trials)
            how.begun(
                f"{to_do} trials, {time_left(left_s)} of the bench's time. Run folder:"
                f" {store.folder}"
            )
            with (
                events.kept_in(store.folder),
                open_instruments(
                    rig,
                    seed=how.seed or 0,
                    realtime=how.realtime,
                    capture=how.capture,
                    screen=events.aside,
                    start_s=left.last_s + BETWEEN_S if left else 0.0,
                ) as devices,
            ):
                refuse_other_cameras(rig.calibration.record, devices.cameras.identity)
                charge = GuardianTarget(
                    devices.bath.url,
                    rig.profile_source,
                    devices.bath.pump_url,
                    rig.relay_source,
                    rig.rig.bath.allow_inferred,
                )
                with guarded(charge, store.folder, devices.clock) as (pulse, guardian_client):
                    ctx = RunContext(rig, script, devices, store, events, pulse, guardian_client)
                    engine = Engine(
                        ctx,
                        under_test,
                        exact_ends=devices.exact_ends,
                        recorder=recorder,
                        left=left,
                        typed=how.typed,
                        expected=expected,
                    )
                    try:
                        return store.folder, engine.run()
                    finally:
                        if guardian_client and engine.bath_is_safe:
                            guardian_client.done()
        # before the engine had the instruments: nothing was switched on
        except (InstrumentError, KeyboardInterrupt) as error:
            if isinstance(store, RehearsedStore):
                store.go_live()
            if isinstance(error, KeyboardInterrupt):
                return store.folder, _end(store, Ending.ABORTED, "interrupted (Ctrl-C)")
            return store.folder, _end(store, Ending.FAULTED, str(error))
    finally:
        close_detectors(under_test)
        store.close()


def score_recording(path: Path, out: Path, progress: Progress, detectors: Sequence[str]) -> Path:
    """Run detectors over a recording and score them; gives back the run's folder. Raises
    ConfigError, RecordingError.
    """
    under_test = make_detectors(detectors)
    recording = Recording(path)
    calibration = read_calibration(recording.calibration_path)
    rules = read_config(RECORDING_RULES, Rules)
    store = _new_store(
        out,
        f"score-{path.resolve().name}",
        {RULES: read_text(RECORDING_RULES)},
        recording.calibration_path,
    )
    facts = {
        "kind": "recorded",
        "title": f"Recording {path.resolve().name}",
        "about": str(path.resolve()),
        "planned": len(recording.frames),
    }
    poses, examiner, ended = pose_names(recording), Examiner(calibration), False
    try:
        write_facts(store, facts, under_test, recording.calibration_path)
        for number, frame in enumerate(recording.frames, 1):
            progress.trial(number - 1, len(recording.frames), frame)
            frames = recording.load(frame)
            answers = [examiner.ask(detector, frames) for detector in under_test]
            known = recording.truth.get(frame, ())
            situation = known[0].situation if known else "unknown"
            trial = f"{number:03d}-{frame}"
            head = _head(trial, number, poses[frame], situation)
            scored = judged(trial, answers, known, rules.visible_within_mm, rules.time_limit_s)
            rows = [truth_row(trial, row) for row in known]
            store.finished(
                TrialRecord(head, frame_rows(store, trial, frames, answers), [], rows, *scored)
            )
        progress.trial(len(recording.frames), len(recording.frames), "")
        _end(store, Ending.FINISHED)
        ended = True
    except KeyboardInterrupt:
        _end(store, Ending.ABORTED, "interrupted (Ctrl-C)")
        ended = True
    finally:
        close_detectors(under_test)
        try:
            store.close()
        finally:
            # as by a frame that can't be read: the recording is still there, and half a run is of
            # no use
            if not ended:
                shutil.rmtree(store.folder, ignore_errors=True)
    return store.folder


def pose_names(recording: Recording) -> dict[str, str]:
    """For each frame the first one that shows the same pose: frames of one pose are repeats, not
    independent trials.

    A recording has no word for it, so it is told by the truth: same situation, same teats, each end
    within SAME_POSE_MM.
    """
    names: dict[str, str] = {}
    # by situation and teats: only frames that share those are compared
    firsts: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for frame in recording.frames:
        known = firsts.setdefault(
            tuple((teat.situation, teat.teat) for teat in recording.truth.get(frame, ())), []
        )
        names[frame] = next(
            (first for first in known if _same_ends(recording, first, frame)), frame
        )
        if names[frame] == frame and frame in recording.truth:
            known.append(frame)
    return names


def _same_ends(recording: Recording, one: str, other: str) -> bool:
    pairs = zip(recording.truth[one], recording.truth[other], strict=True)
    return all(math.dist(p.xyz_mm, q.xyz_mm) <= SAME_POSE_MM for p, q in pairs)


def _new_store(out: Path, name: str, files: dict[str, str], calibration: Path) -> Store:
    try:
        folder = new_run_folder(out, name, wall_time())
        return Store.create(
            folder, {**files, "calibration.toml": calibration.read_text(encoding="utf-8")}
        )
    except OSError as error:
        raise ConfigError.plain(
            f"a run can't be kept in {out}: {error.strerror or error}. Name another folder with"
            " --out."
        ) from error


def _end(store: Store, ending: Ending, why: str = "") -> Ending:
    if why:
        kind = "aborted" if ending is Ending.ABORTED else "fault"
        store.event(None, kind, why, wall_time())
    store.event(None, "end", ending.value, wall_time())
    store.fact("ending", ending.value)
    store.fact("wall_ended", wall_time().isoformat(timespec="seconds"))
    return ending


def _head(trial: str, number: int, frame: str, situation: str) -> dict[str, object]:
    """The row of a frame set that came without instruments: each is a pose of its own."""
    unknown = ("started_s", "ended_s", "captured_s", "bath_c", "bath_state", "note")
    head = {"id": trial, "number": number, "name": frame, "situation": situation, "repeat": 1}
    return {
        **head,
        **dict.fromkeys(unknown),
        "wall_time": wall_time().isoformat(timespec="milliseconds"),
    }
