"""The main jobs behind the commands: a run on a rig, and scoring a recording; both end in one run folder and one report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from bench.config import ConfigError, read_config, read_text
from bench.detector_choice import make_detectors
from bench.engine import Ending, Engine
from bench.examine import Examiner, TruthRow, close_detectors
from bench.exits import current, undisturbed
from bench.facts import write_facts
from bench.hookup import open_rig
from bench.latch import refuse_latched
from bench.lifeline import Charge, guarded
from bench.planning import pose_set
from bench.recorder import Recorder
from bench.rig import LoadedRig, read_calibration
from bench.rows import frame_rows, judged, truth_row
from bench.script import RECORDING_RULES, LoadedScript, Rules
from bench.showing import Progress
from bench.store import RULES, SCRIPT, FinishedTrial, Store, new_run_folder
from bench.truth.choosing import refuse_carry
from instruments.camera.recording import Recording
from instruments.capture import NO_CAPTURE, Captures
from instruments.clock import wall_time
from instruments.errors import InstrumentError

SAME_POSE_MM = 1.5  # touches of one end scatter by less, and no bench sets a pose up again this well by chance


def run_script(
    rig: LoadedRig,
    script: LoadedScript,
    out: Path,
    progress: Progress,
    *,
    seed: int | None = None,
    detectors: Sequence[str] = (),
    record: Path | None = None,
    realtime: bool = False,
    capture: Captures = NO_CAPTURE,
) -> tuple[Path, Ending]:
    """Run ``script`` on ``rig``; gives back the run's folder and how it ended.

    Raises ConfigError before anything is opened, and LatchedError where an interlock's trip has not been acknowledged.
    """
    refuse_latched(rig)
    refuse_carry(rig, script)
    under_test = make_detectors(detectors) if detectors else make_detectors(script.script.detectors, script.path.parent)
    used_seed = rig.rig.seed if seed is None else seed
    recorder = Recorder(record, rig.calibration_path) if record else None
    files = {**rig.arm_files, **rig.answer_files, **script.layout_files, **script.truth_files, "rig.toml": rig.text, SCRIPT: script.text}
    emulated = set(rig.rig.emulated)
    kind = "emulated" if emulated else "recorded" if rig.rig.cameras.url.startswith("recording:") else "real"
    facts = {"kind": kind, "title": script.script.title, "about": script.script.about, "seed": used_seed, "rig": rig.rig.name}
    facts |= {"script": script.name, "set_point_c": script.script.bath.set_point_c, "planned": len(script.planned)}
    facts["pose set"] = pose_set(script.script.trials, script.planned, seed=script.script.seed, order=script.script.order)
    with undisturbed():  # a run that is there at all says what it is, and how it ended
        store = _new_store(out, script.name, files, rig.calibration_path)
        try:
            write_facts(store, facts, under_test, rig.calibration_path)
        except BaseException:
            store.close()
            raise
    try:
        try:
            current().heed()
            with open_rig(rig, seed=used_seed, realtime=realtime, capture=capture, screen=progress.aside) as hookup:
                bath, clock = hookup.devices.bath, hookup.devices.clock
                charge = Charge(bath.url, rig.profile_source, bath.pump_url, rig.relay_source, rig.rig.bath.allow_inferred)
                with guarded(charge, store.folder, clock) as (pulse, lifeline):
                    engine = Engine(
                        rig, script, hookup.devices, store, under_test, progress,
                        exact_ends=hookup.exact_ends, sink=recorder, pulse=pulse, lifeline=lifeline,
                    )  # fmt: skip
                    try:
                        return store.folder, engine.run()
                    finally:
                        if lifeline and engine.bath_is_safe:
                            lifeline.done()
        except (InstrumentError, KeyboardInterrupt) as error:  # before the engine had the instruments: nothing was switched on
            return store.folder, _never_started(store, error)
    finally:
        close_detectors(under_test)
        store.close()


def score_recording(path: Path, out: Path, progress: Progress, detectors: Sequence[str]) -> Path:
    """Run detectors over a recording and score them; gives back the run's folder. Raises ConfigError, RecordingError."""
    under_test = make_detectors(detectors)
    recording = Recording(path)
    calibration = read_calibration(recording.calibration_path)
    rules = read_config(RECORDING_RULES, Rules)
    store = _new_store(out, f"score-{path.resolve().name}", {RULES: read_text(RECORDING_RULES)}, recording.calibration_path)
    facts = {
        "kind": "recorded",
        "title": f"Recording {path.resolve().name}",
        "about": str(path.resolve()),
        "planned": len(recording.frames),
    }
    poses, examiner = pose_names(recording), Examiner(calibration)
    try:
        write_facts(store, facts, under_test, recording.calibration_path)
        for number, frame in enumerate(recording.frames, 1):
            progress.trial(number - 1, len(recording.frames), frame)
            frames = recording.load(frame)
            answers = [examiner.ask(detector, frames) for detector in under_test]
            known = recording.truth.get(frame, ())
            truth = [TruthRow(t.teat, t.xyz_mm, t.visible, t.u_mm) for t in known]
            situation = known[0].situation if known else "unknown"
            trial = f"{number:03d}-{frame}"
            head = _head(trial, number, poses[frame], situation)
            scored = judged(trial, answers, truth, rules.visible_within_mm, rules.time_limit_s)
            rows = [truth_row(trial, row) for row in truth]
            store.finished(FinishedTrial(head, frame_rows(store, trial, frames, answers), [], rows, *scored))
        progress.trial(len(recording.frames), len(recording.frames), "")
        _end(store, Ending.FINISHED)
    except KeyboardInterrupt:
        store.event(None, "aborted", "interrupted (Ctrl-C)", wall_time())
        _end(store, Ending.ABORTED)
    finally:
        close_detectors(under_test)
        store.close()
    return store.folder


def pose_names(recording: Recording) -> dict[str, str]:
    """For each frame the first one that shows the same pose: frames of one pose are repeats, not independent trials.

    A recording has no word for it, so it is told by the truth: same situation, same teats, each end within SAME_POSE_MM.
    """
    names: dict[str, str] = {}
    for frame in recording.frames:
        names[frame] = next((first for first in dict.fromkeys(names.values()) if _same_pose(recording, first, frame)), frame)
    return names


def _same_pose(recording: Recording, one: str, other: str) -> bool:
    a, b = recording.truth.get(one, ()), recording.truth.get(other, ())
    if not a or [(t.situation, t.teat) for t in a] != [(t.situation, t.teat) for t in b]:
        return False
    return all(math.dist(p.xyz_mm, q.xyz_mm) <= SAME_POSE_MM for p, q in zip(a, b, strict=True))


def _new_store(out: Path, name: str, files: dict[str, str], calibration: Path) -> Store:
    try:
        folder = new_run_folder(out, name, wall_time())
        return Store.create(folder, {**files, "calibration.toml": calibration.read_text(encoding="utf-8")})
    except OSError as error:
        raise ConfigError.plain(f"a run can't be kept in {out}: {error.strerror or error}. Name another folder with --out.") from error


def _never_started(store: Store, error: BaseException) -> Ending:
    aborted = isinstance(error, KeyboardInterrupt)
    store.event(None, "aborted" if aborted else "fault", "interrupted (Ctrl-C)" if aborted else str(error), wall_time())
    return _end(store, Ending.ABORTED if aborted else Ending.FAULTED)


def _end(store: Store, ending: Ending) -> Ending:
    store.event(None, "end", ending.value, wall_time())
    store.fact("ending", ending.value)
    store.fact("wall_ended", wall_time().isoformat(timespec="seconds"))
    return ending


def _head(trial: str, number: int, frame: str, situation: str) -> dict[str, object]:
    """The row of a frame set that came without instruments: each is a pose of its own."""
    unknown = ("started_s", "ended_s", "captured_s", "bath_c", "bath_state", "note")
    head = {"id": trial, "number": number, "name": frame, "situation": situation, "repeat": 1}
    return {**head, **dict.fromkeys(unknown), "wall_time": wall_time().isoformat(timespec="milliseconds")}
