"""Goes through a script on the twin of a rig: every trial is set up, moved to, settled, touched and
stored, by the bench's own engine.

It stops where the run would stop. Not gone through are most frames (`stand_in_cameras`), and all
detections but one a detector.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.dry_run.cameras import StandInCameras, lenient, to_render
from bench.dry_run.findings import Course, RehearsalStore
from bench.dry_run.operator import Person, ReachingHands, TimedOperator
from bench.dry_run.pose_checks import Finding
from bench.dry_run.twin import twin_of
from bench.record.schema import SCRIPT as SCRIPT_FILE
from bench.record.writer import Store
from bench.rig.devices import Cameras, Devices
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig
from bench.rig.opening import driver_openers
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import CONSOLE, SCRIPT
from bench.run.context import RunContext
from bench.run.engine import Engine
from bench.run.estimate import ASSUMED, SETTLING, TimeSpent, needs
from bench.run.events import Events
from bench.script.model import LoadedScript
from detector.protocol import Detector
from instruments.clock import VirtualClock
from instruments.operators.operator import Operator
from instruments.stage.settings import StageSettings

# of prompts; where they take longer, the rest of each passes beside the clock
ON_CLOCK_S = 6 * 3600.0


class NoTwinError(Exception):
    """There can be no emulated twin of this rig; the text says why."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What going through came to. ``trials`` were done of ``planned``; ``spent`` is the bench's
    time in s by `time_spent.KINDS`.

    ``prompts``: how often the operator was asked. ``disk_mb`` is for the run's record and frames.
    ``rendered``: frame sets that were. ``on_clock`` is the share of the operator's time that the
    clock saw; ``got_over`` counts what the run got over by itself.
    """

    planned: int
    trials: int
    findings: tuple[Finding, ...]
    recovered: Mapping[str, int]
    spent: Mapping[str, float]
    prompts: int
    disk_mb: float
    rendered: int
    on_clock: float

    @property
    def total_s(self) -> float:
        """The bench's time, all of it."""
        return sum(self.spent.values())


@dataclass(frozen=True, slots=True)
class Pace:
    """How long the operator takes: a person ``seconds`` by what it is, emulated hands ``prompt_s``;
    ``on_clock`` is the clock's share.
    """

    seconds: Mapping[str, float]
    prompt_s: float
    on_clock: float
    in_person: bool


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
    figures = {**ASSUMED, **(learnt or {})}
    pace = _pace(rig, script, figures)
    clock = VirtualClock()
    spent = TimeSpent(clock.now)
    course = Course(script.planned, spent, shown)
    person = _person(rig, clock, pace, spent)
    twin_rig = _slowed(twin_of(rig, script, stage), pace)
    with TemporaryDirectory(prefix="teatbench-dry-run-") as folder:
        run = Path(folder) / "run"
        with (
            closing(
                RehearsalStore.begun(run, {"rig.toml": rig.text, SCRIPT_FILE: script.text})
            ) as store,
            _twin(
                twin_rig,
                clock,
                rig.rig.seed if seed is None else seed,
                by_hand=not rig.rig.emulated,
            ) as twin,
        ):
            store.heard = course.heard
            cameras = StandInCameras(
                twin.cameras, twin_rig, course, to_render(script.planned), detectors, clock
            )
            cameras.takes_s = 0.0 if rig.rig.emulated else figures["capture"]
            hands = ReachingHands(
                twin, twin_rig.rig.emulation.arm_placed, course.met, leans=pace.in_person
            )
            person.hands = hands
            operator = TimedOperator(person, person, spent, pace.seconds)
            _go_through(lenient(twin_rig), script, twin, store, cameras, operator, course)
        if course.interrupted:
            raise KeyboardInterrupt
        disk_mb = (_written(run) + cameras.bytes_of(len(script.planned))) / 1e6
    return Rehearsal(
        planned=len(script.planned),
        trials=store.trials,
        findings=tuple(course.findings),
        recovered=dict(course.recovered),
        spent=_as_learnt(spent, rig, script, learnt or {}),
        prompts=person.asked,
        disk_mb=disk_mb,
        rendered=cameras.rendered,
        on_clock=pace.on_clock,
    )


def _go_through(
    rig: LoadedRig,
    script: LoadedScript,
    twin: EmulatedRig,
    store: Store,
    cameras: Cameras,
    operator: Operator,
    course: Course,
) -> None:
    """As a run, without detectors. What an instrument's fault or an abort ends is in the record,
    and heard by ``course``.
    """
    clock = twin.world.clock
    openers = driver_openers(rig, clock, twin.urls)
    with ExitStack() as stack:
        opened = {name: stack.enter_context(closing(openers[name]())) for name in openers}
        devices = Devices(
            clock, opened["arm"], opened["bath"], opened.get("stage"), cameras, operator
        )
        ctx = RunContext(rig, script, devices, store, Events(course))
        Engine(ctx, (), exact_ends=twin.world.ends_mm).run()


def _pace(rig: LoadedRig, script: LoadedScript, figures: Mapping[str, float]) -> Pace:
    """A person takes his time, emulated hands the rig file's, and a script of answers none."""
    in_person = rig.rig.operator.url == CONSOLE
    seconds = {name: figures[name] if in_person else 0.0 for name in ("set-up", "placing", "touch")}
    prompt_s = rig.rig.emulation.prompt_s if rig.rig.emulated else 0.0
    wanted = needs(rig, script, figures)
    busy_s = wanted.prompts * (seconds["touch"] + prompt_s) + (
        wanted.time.set_ups_s if in_person else 0.0
    )
    return Pace(seconds, prompt_s, min(1.0, ON_CLOCK_S / busy_s) if busy_s else 1.0, in_person)


def _slowed(twin: LoadedRig, pace: Pace) -> LoadedRig:
    """The twin whose hands take their share of the clock."""
    emulation = twin.rig.emulation.model_copy(update={"prompt_s": pace.prompt_s * pace.on_clock})
    return replace(twin, rig=twin.rig.model_copy(update={"emulation": emulation}))


def _person(rig: LoadedRig, clock: VirtualClock, pace: Pace, spent: TimeSpent) -> Person:
    url = rig.rig.operator.url
    answers = (
        load_answers(rig.path.parent / url.removeprefix(SCRIPT)) if url.startswith(SCRIPT) else None
    )
    return Person(
        clock,
        pace.seconds,
        spent,
        pace.on_clock,
        beside_s=pace.prompt_s * (1.0 - pace.on_clock),
        answers=answers,
    )


@contextmanager
def _twin(
    rig: LoadedRig, clock: VirtualClock, seed: int, *, by_hand: bool
) -> Iterator[EmulatedRig]:
    """``by_hand``: a pump that no instrument turns on is turned on by somebody, as in a lab."""
    try:
        twin = EmulatedRig(rig, clock, seed)
    # a calibration that nothing can be rendered with, a table that an emulator can't be made of
    except ValueError as error:
        raise NoTwinError(str(error)) from error
    if by_hand and rig.profile.capabilities.pump == "none" and rig.relay is None:
        twin.world.plant.pump = "on"
    with twin:
        yield twin


def _written(folder: Path) -> int:
    """Bytes that a run's folder has, of a run that left no pictures."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _as_learnt(
    spent: TimeSpent, rig: LoadedRig, script: LoadedScript, learnt: Mapping[str, float]
) -> dict[str, float]:
    """The seconds, with the time that the real bath takes to heat where earlier runs told."""
    seconds, first_s = spent.seconds, spent.first_settling_s
    if "heating" in learnt and first_s is not None and not rig.rig.emulated:
        seconds[SETTLING] += needs(rig, script, learnt).time.settling_s - first_s
    return seconds
