"""Goes through a script on the twin of a rig, in a temporary run folder, by the bench's own engine:
every trial is set up, moved to, settled, touched and stored. Then the record and the events are
read back, as of any run: what was done, what went wrong where, and what the time went to.

It stops where the run would stop. Not gone through are most frames, and all detections but one a
detector.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.dry_run.pose_checks import Finding
from bench.dry_run.twin import (
    CountedAnswers,
    ReachingHands,
    StandInCameras,
    lenient,
    to_render,
    twin_of,
)
from bench.files import Picture
from bench.record.reader import read_run
from bench.record.schema import SCRIPT as SCRIPT_FILE
from bench.record.schema import Row
from bench.record.writer import Store
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig
from bench.rig.opening import open_instruments
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import CONSOLE, SCRIPT
from bench.run.context import RunContext
from bench.run.engine import Engine
from bench.run.estimate import ASSUMED, PREPARING, SET_UPS, SETTLING, TOUCHES, needs, spent_of
from bench.run.events import Events, read_events
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial
from detector.protocol import Detector
from instruments.clock import VirtualClock
from instruments.stage.settings import StageSettings

BEFORE, AFTER = "before the trials", "after the trials"
INTERRUPTED = "the run was interrupted"
OPERATOR_SKIPPED = "the operator skipped it"
# kinds of events that no run should have, and what the finding is
FINDINGS = {
    "trip": "interlock",
    "fault": "fault",
    "invalid": "truth",
    "reach": "reach",
    "frames": "frames",
    "detector": "detector",
}
GOT_OVER = {
    "dropped out": "an instrument dropped out and came back",
    "suspended": "the bath left its band, and settled again",
    "repeated": "a trial was repeated",
    "registration": "the stage's registration is in doubt",
}


class NoTwinError(Exception):
    """There can be no emulated twin of this rig; the text says why."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What going through came to. ``trials`` were done of ``planned``; ``spent`` is the bench's
    time in s by `estimate.KINDS`.

    ``prompts``: how often the operator was asked. ``disk_mb`` is for the run's record and frames.
    ``rendered``: frame sets that were; ``recovered`` counts what the run got over by itself.
    """

    planned: int
    trials: int
    findings: tuple[Finding, ...]
    recovered: Mapping[str, int]
    spent: Mapping[str, float]
    prompts: int
    disk_mb: float
    rendered: int

    @property
    def total_s(self) -> float:
        """The bench's time, all of it."""
        return sum(self.spent.values())


class PicturelessStore(Store):
    """A record that keeps no pictures."""

    def frames(
        self,
        trial: str,  # noqa: ARG002
        images: Mapping[str, Picture],  # noqa: ARG002
        exposed_s: Mapping[str, float | None],  # noqa: ARG002
    ) -> list[Row]:
        return []


class Course:
    """The screen of a rehearsal: tells ``cameras`` which trial is now, and ``shown`` how many were
    begun, of how many.
    """

    def __init__(self, planned: Sequence[PlannedTrial], shown: Callable[[int, int], None]) -> None:
        self._ids = {one.number: one.id for one in planned}
        self._begun = 0
        self._shown = shown
        self.cameras: StandInCameras | None = None

    def state(self, text: str) -> None:
        """Nobody reads along."""

    def trial(self, done: int, total: int, name: str) -> None:  # noqa: ARG002
        if self.cameras:
            self.cameras.trial = self._ids[done + 1] if name else ""
        self._shown(self._begun, len(self._ids))
        self._begun += 1

    def warn(self, text: str) -> None:
        """An event says the same."""

    def aside(self) -> AbstractContextManager[None]:
        return nullcontext()


def rehearse(
    rig: LoadedRig,
    script: LoadedScript,
    detectors: Sequence[Detector],
    *,
    stage: StageSettings | None = None,
    learnt: Mapping[str, float] | None = None,
    seed: int | None = None,
    shown: Callable[[int, int], None] = lambda _done, _of: None,
) -> Rehearsal:
    """Go through ``script`` on the twin of ``rig``; ``stage`` is what its controller says,
    ``learnt`` what earlier runs took.

    ``shown`` gets how many trials are done, of how many. Raises NoTwinError, and KeyboardInterrupt
    where somebody ended it.
    """
    figures, emulated = {**ASSUMED, **(learnt or {})}, bool(rig.rig.emulated)
    in_person, url = rig.rig.operator.url == CONSOLE, rig.rig.operator.url
    file = rig.path.parent / url.removeprefix(SCRIPT)
    operator = CountedAnswers(load_answers(file) if url.startswith(SCRIPT) else None)
    clock, twin_rig = VirtualClock(), twin_of(rig, script, stage)
    course = Course(script.planned, shown)
    events = Events(course)
    with TemporaryDirectory(prefix="teatbench-dry-run-") as folder:
        run = Path(folder) / "run"
        files = {"rig.toml": rig.text, SCRIPT_FILE: script.text}
        used_seed = rig.rig.seed if seed is None else seed
        with (
            closing(PicturelessStore.create(run, files)) as store,
            events.kept_in(run),
            _twin(twin_rig, clock, used_seed, by_hand=not emulated) as twin,
        ):
            store.fact("detectors", [])
            takes_s, due = 0.0 if emulated else figures["capture"], to_render(script.planned)
            cameras = StandInCameras(twin, twin_rig, events.event, due, detectors, takes_s)
            course.cameras, placed = cameras, twin_rig.rig.emulation.arm_placed
            operator.hands = ReachingHands(twin, placed, events.event, leans=in_person)
            tested = lenient(twin_rig)
            with open_instruments(tested, ("arm", "bath", "stage"), clock, twin=twin) as opened:
                devices = replace(opened, cameras=cameras, operator=operator)
                ctx = RunContext(tested, script, devices, store, events)
                Engine(ctx, (), exact_ends=twin.world.ends_mm).run()
        lines = list(read_events(run))
        if any(e.get("kind") == "aborted" and e["text"].startswith(INTERRUPTED) for e in lines):
            raise KeyboardInterrupt
        trials = len(read_run(run).trials)
        written = sum(path.stat().st_size for path in run.rglob("*") if path.is_file())
    findings, recovered = _findings(lines)
    spent = spent_of(lines)
    wanted = needs(rig, script, figures if in_person else learnt).time
    if in_person:  # on the twin a prompt takes no time
        spent[PREPARING] += operator.asked["homing"] * figures["placing"]
        spent[SET_UPS] += wanted.set_ups_s
        touches = operator.asked["touch"] + operator.asked["check point"]
        spent[TOUCHES] += touches * figures["touch"]
    if learnt and "heating" in learnt and not emulated:
        # the time that the real bath takes to heat, where earlier runs told
        spent[SETTLING] += wanted.settling_s - spent_of(lines, first_settling=True)[SETTLING]
    return Rehearsal(
        planned=len(script.planned),
        trials=trials,
        findings=findings,
        recovered=recovered,
        spent=spent,
        prompts=operator.asked.total(),
        disk_mb=(written + cameras.bytes_of(len(script.planned))) / 1e6,
        rendered=cameras.rendered,
    )


def _findings(lines: Sequence[Mapping[str, Any]]) -> tuple[tuple[Finding, ...], Mapping[str, int]]:
    """What would end the run, or leave a trial without a truth, with the trial's name; and what the
    run gets over by itself, counted.
    """
    where = BEFORE
    found: dict[Finding, None] = {}
    recovered: Counter[str] = Counter()

    def known(kind: str) -> bool:
        return any((one.trial, one.kind) == (where, kind) for one in found)

    for line in lines:
        kind, text = line.get("kind", ""), line.get("text", "")
        if line["what"] == "trial":
            where = line["name"] or AFTER
        elif line["what"] != "event":
            continue
        elif kind in FINDINGS:
            if kind != "fault" or not known("interlock"):  # by which the run ends too
                found[Finding(where, FINDINGS[kind], text)] = None
        elif kind in GOT_OVER:
            recovered[GOT_OVER[kind]] += 1
        # an arm that doesn't reach skips a trial and ends a run, and was found already
        elif kind == "skipped" and OPERATOR_SKIPPED in text and not known("reach"):
            recovered["the operator's script skips a trial"] += 1
        elif kind in ("skipped", "aborted") and not known("reach"):
            found[Finding(where, "truth" if kind == "skipped" else kind, text)] = None
    return tuple(found), recovered


@contextmanager
def _twin(
    rig: LoadedRig, clock: VirtualClock, seed: int, *, by_hand: bool
) -> Iterator[EmulatedRig]:
    """``by_hand``: a pump that no instrument turns on is turned on by somebody, as in a lab."""
    if by_hand:
        still = rig.rig.emulation.model_copy(update={"prompt_s": 0.0})
        rig = replace(rig, rig=rig.rig.model_copy(update={"emulation": still}))
    try:
        twin = EmulatedRig(rig, clock, seed)
    # a calibration that nothing can be rendered with, a table that an emulator can't be made of
    except ValueError as error:
        raise NoTwinError(str(error)) from error
    if by_hand and rig.profile.capabilities.pump == "none" and rig.relay is None:
        twin.world.plant.pump = "on"
    with twin:
        yield twin
