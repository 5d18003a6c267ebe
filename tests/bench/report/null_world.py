"""A world in which nothing is wrong: a detector that stands exactly at a limit, and a truth whose
errors are drawn as they are stated; run by script, rig, record and page. And one in which the
detector is off by a known amount.

Arm, table frame and registration are common to a run, touches fresh. The detector sees where the
ends are and looks at no picture, so none is rendered; arm, bath and stage stand in this process
without a wire, since what is asked here is what the pages say. All other parts are those of a run.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property, partial
from itertools import count, islice
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, points_mm, read_run
from bench.report.page import write_run_report
from bench.rig.arm_files import (
    LengthTest,
    LocationTest,
    TableFrame,
    TouchedPoint,
    Verification,
    VerificationLimits,
    frame_text,
    verification_text,
)
from bench.rig.devices import Devices
from bench.rig.loading import LoadedRig, load_rig
from bench.rig.model import ROUNDING_MM, EmulatedStage, StageTable
from bench.run.start import run_queue
from bench.script.model import load_script
from bench.truth.touching import TipReader, Toucher
from detector.protocol import Detection, Teat
from instruments.bath.profile import Profile
from instruments.bath.reading import BathReading
from instruments.camera.frame import FrameSet
from instruments.clock import Clock, VirtualClock
from instruments.microscribe.configuration import Identity
from instruments.microscribe.driver import Reading
from instruments.operators.emulated import EmulatedOperator
from instruments.stage.emulator.carriage import Mounting
from instruments.stage.settings import StageIdentity
from instruments.world.world import World as EmulatedWorld
from reports.render import Renderer, environment
from tests.bench import operated_runs
from tests.bench.killed_runs import Silent
from tests.conftest import ROOT
from tests.undrawn import bare

Floats = NDArray[np.float64]

POSES = 64  # 59 show 95 % with 95 %
PLACES_MM = np.random.default_rng(11).uniform(-100.0, 100.0, (POSES, 3)).round(1)
LIMIT_MM = 5.0
# of a normal error along each axis, which is beyond the limit in just 5 % of poses
AT_THE_LIMIT_MM = LIMIT_MM / np.sqrt(7.814727903251179)
MADE = datetime(2026, 11, 1, 8, 0, tzinfo=UTC)
SERIAL = "40937"

SCRIPT = (ROOT / "tests/data/null_world.toml.txt").read_text(encoding="utf-8")
STAGE = 'url = "emulator:"\naxes = "XYZ"'
MEMORY = Path("/dev/shm")  # where there is one, nothing is waited for that a disk has to write
CARRY = """[truth]
mode = "carry"
registration = "first"
registration_at_mm = [[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0], [0.0, 0.0]]
"""
ARM_RULE = "shift_limit_mm = 1.5"


@dataclass(frozen=True, slots=True)
class World:
    """How the truth is had; ``alike``: share of the arm's variance that all its points have in
    common; ``flat``: poses in one plane. The rig states ``arm_mm`` and ``hand_mm``, and they are so.
    """

    name: str
    truth: str = ""
    alike: float = 1.0
    flat: bool = False
    arm_mm: float = 0.23
    hand_mm: float = 0.1
    # by which the whole truth is displaced: nothing that the rig states
    away_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # along x, of all poses of the script
    beside_mm: float = 0.0


WORLDS = {
    world.name: world
    for world in (
        World("touched"),
        World("touched in one plane", flat=True),
        World("carried", CARRY, alike=0.0),
        World("half of the arm common", alike=0.5),
    )
}
# an arm, a hand and a frame with which the truth allows it
FINE = [
    World("touched, a finer arm", arm_mm=0.05, hand_mm=0.05),
    World("carried, a finer arm", CARRY, alike=0.0, arm_mm=0.05, hand_mm=0.05),
]


@dataclass(frozen=True, slots=True)
class Off:
    """What a detector is off by: normal noise, a bias along x, and a share of the planned x."""

    sd_mm: float = AT_THE_LIMIT_MM
    bias_mm: float = 0.0
    trend: float = 0.0


WORSE = Off(sd_mm=0.4, bias_mm=0.5, trend=0.01)


@dataclass(slots=True)
class _Errors:
    """What this run's truth is off by, and whose turn it is."""

    world: World
    seed: int
    scene: EmulatedWorld | None = None
    end: Floats | None = None  # of the end that is being touched, all its readings alike
    rng: np.random.Generator = field(init=False)
    arm: Floats = field(init=False)
    frame: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, 77])
        self.arm = np.sqrt(self.world.alike) * self._of(self.world.arm_mm) + self.world.away_mm
        self.frame = self.rng.normal(0.0, self.world.arm_mm, 9)

    def _of(self, sd_mm: float) -> Floats:
        return self.rng.normal(0.0, sd_mm, 3)

    def of_an_end(self) -> Floats:
        """The arm there, how the apex was found, and rounding."""
        own = np.sqrt(1.0 - self.world.alike) * self.world.arm_mm
        return self._of(own) + self._of(self.world.hand_mm) + self._of(ROUNDING_MM)

    def reading(self, frame: TableFrame) -> Reading:
        assert self.scene is not None
        held = self.scene.arm_target()
        assert held is not None
        tip, axis = held
        own = self._of(np.sqrt(1.0 - self.world.alike) * self.world.arm_mm) + self._of(ROUNDING_MM)
        if self.end is not None:
            own = self.end + self._of(np.hypot(self.world.hand_mm, ROUNDING_MM))
        shared = self.arm + _moved(frame, self.frame, tip)
        return Reading(np.asarray(tip + shared + own), 0.02, axis, 8, (0,) * 6)


def _moved(frame: TableFrame, touches: Floats, point: Floats) -> Floats:
    """By how much a point is misplaced where the frame's nine coordinates were off by ``touches``:
    of rigid motions, worked out here by hand. Origin o, on x, in the plane: identity.
    """
    (o, x, y), arms = touches.reshape(3, 3), [np.array(p.arm_mm) for p in frame.points[:3]]
    along, across = arms[1][0], arms[2][1]
    # small turns of the table about z, y and x as the arm sees it
    about_z, about_y = (x[1] - o[1]) / along, -(x[2] - o[2]) / along
    about_x = (y[2] - o[2]) / across
    return np.asarray(-(o + np.cross([about_x, about_y, about_z], point)))


class NullDetector:
    """Knows the ends, and is off by what it is told; states its covariance as it is."""

    name, version, parameters = "null", "1", {}  # type: ignore[var-annotated]

    def __init__(self, errors: _Errors, off: Off) -> None:
        self._errors, self._off = errors, off
        self._rng = np.random.default_rng([errors.seed, 99])

    def detect(self, _frames: object, _calibration: object) -> Detection:
        assert self._errors.scene is not None
        off, ends = self._off, self._errors.scene.ends_mm()
        teats = []
        for end in ends:
            error = self._rng.normal(0.0, off.sd_mm, 3)
            error[0] += off.bias_mm + off.trend * (end[0] - MIDDLE_X_MM)
            teats.append(Teat(world_mm=end + error, covariance_mm2=off.sd_mm**2 * np.eye(3)))
        return Detection(tuple(teats), 0, None, ())


# of the ends: a trend about it moves no mean error
MIDDLE_X_MM = -115.0 + float(np.mean(PLACES_MM[:, 0]))


class _Bath:
    """At its set point, from the first second."""

    url, pump_url, who, pump = "null", "", "bath", "none"
    safe_state, watchdog_s, doubt = "standby", None, ""
    heats = pump_on = False
    identity: ClassVar[dict[str, str]] = {"family": "null"}

    def __init__(self, clock: Clock, profile: Profile) -> None:
        self._clock, self._rng = clock, np.random.default_rng(5)
        self.profile = profile

    def read(self) -> BathReading:
        temp_c = 33.0 + float(self._rng.normal(0.0, 0.005))
        now_s, raw = self._clock.now(), (round(1e3 * temp_c),)
        return BathReading(now_s, temp_c, raw, None, 10.0, None, 0, 0, True, True, 33.0)

    def check_start(self, set_point_c: float) -> None: ...
    def start(self, set_point_c: float) -> None: ...
    def safe(self) -> None: ...


class _Stage:
    """Moves at once, and carries the world's phantom as a stage does whose axes are off."""

    who, homed, safe_state, moves = "stage", True, "still", False
    identity = StageIdentity("null", "1", "", "")

    def __init__(self, table: StageTable, off: EmulatedStage, world: EmulatedWorld) -> None:
        reference = (*table.reference_mm, table.reference_z_mm, table.reference_a_deg)
        mounting = Mounting(table.axes, reference, off.scale_errors, off.squareness_rad)
        self._at = list(reference[:3])
        world.stage_pose = lambda: mounting.pose(self._at)
        world.stage_velocity = lambda: (0.0, 0.0, 0.0)

    def connect(self) -> None: ...
    def reconnect(self) -> None: ...
    def home(self) -> None: ...
    def safe(self) -> None: ...

    def position(self) -> Floats:
        return np.array(self._at)

    def move_to(self, **to: Any) -> None:
        self._at = [to.get(f"{axis}_mm", here) for axis, here in zip("xyz", self._at, strict=True)]


class _Arm:
    """Signed on and homed; what it reads is drawn."""

    who, homing, safe_state, homed = "arm", "", "closed", True
    touches = moves = pedals = False
    identity = Identity("MicroScribe", "1", "3DX", SERIAL, "", "", "1")

    def record(self) -> dict[str, object]:
        return {}

    def sign_on(self) -> None: ...
    def confirm_homed(self) -> None: ...
    def safe(self) -> None: ...


class _Cameras:
    identity: ClassVar[dict[str, str]] = {}


class _Renderer:
    """Every camera sees every end."""

    def visible_ends(self, scene: Any) -> Any:
        return np.ones((len(scene.phantom.teats), 3), dtype=np.bool_)


class _Frames:
    """In the place of cameras: four grey levels, and never a fault."""

    looked: ClassVar[dict[str, int]] = {}  # it looks at no picture

    def __init__(self, *_: object, **__: object) -> None:
        self.counts: dict[str, int] = {}

    def take(self) -> FrameSet:
        left, right, thermal = (np.full((16, 16), level, np.uint8) for level in (90, 100, 110))
        return FrameSet(left, right, thermal)

    def look(self) -> None: ...


@dataclass(frozen=True)
class Done:
    """A run's page, and beside it what is exactly so."""

    page: str
    run: RunRecord

    @cached_property
    def truth_off_mm(self) -> Floats:
        """By how much each truth is off (n, 3)."""
        rows = [row for trial in self.run.counted for row in trial.truth]
        return np.asarray(points_mm(rows) - [json.loads(row["exact_mm"]) for row in rows])

    @cached_property
    def errors_mm(self) -> Floats:
        """By how much each answer is off the exact end (n, 3)."""
        found = points_mm(row for trial in self.run.counted for row in trial.found)
        rows = [row for trial in self.run.counted for row in trial.truth]
        return np.asarray(found - [json.loads(row["exact_mm"]) for row in rows])

    @cached_property
    def distances_mm(self) -> Floats:
        return np.asarray(np.linalg.norm(self.errors_mm, axis=1))


def done(world: World, off: Off, seed: int, *, arm_rule: str = ARM_RULE) -> Done:
    """One run, from its script to its page."""
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as made:
        folder = Path(made)
        errors = _Errors(world, seed)
        frame = _write(folder, world, errors, arm_rule)
        rig, script = load_rig(folder / "rig.toml"), load_script(folder / "script.toml")
        with _world(errors, off, frame):
            ((run, state),) = run_queue(rig, [script], folder / "runs", Silent())
            assert state == "finished", state
            path = write_run_report(run).page
        first = sorted(path.parent.glob("trials/*.html"))[:1]
        pages = [one.read_text(encoding="utf-8") for one in (path, *first)]
        return Done("\n".join(pages), read_run(run))


def _write(folder: Path, world: World, errors: _Errors, arm_rule: str) -> TableFrame:
    """The rig, its files about the arm, and the script."""
    rng = np.random.default_rng([errors.seed, 55])
    u_mm = float(np.hypot(world.arm_mm, ROUNDING_MM))
    scale, square = rng.normal(0.0, 5e-4, 3), rng.normal(0.0, 5e-4)
    axes = f"scale_errors = [{scale[0]}, {scale[1]}, {scale[2]}, 0.0], squareness_rad = {square}"
    operated_runs.files(
        folder,
        stage=f"[stage]\n{STAGE}",
        touches=3,
        check_point="check_point_mm = [-190.0, 120.0, 15.0]\ncheck_touches = 5\n"
        f"accuracy_mm = {world.arm_mm}\ndefinition_mm = {world.hand_mm}\n"
        'frame = "arm-frame.toml"\nverification = "arm-verification.toml"',
        emulation=f"hand_error_mm = 0.0\nstage = {{ {axes} }}",
    )
    frame = table_frame()
    (folder / "arm-frame.toml").write_text(frame_text(frame), encoding="utf-8")
    verified = _verification(rng, u_mm)
    text = verification_text(verified, VerificationLimits(5.0, 5.0))
    (folder / "arm-verification.toml").write_text(text, encoding="utf-8")
    drawn = np.add(PLACES_MM, [world.beside_mm, 0.0, 0.0])
    drawn[:, 2] = 0.0 if world.flat else (25.0 + drawn[:, 2] / 4.0).round(1)
    poses = [f"  {{ x_mm = {x}, y_mm = {y}, z_mm = {z} }}," for x, y, z in drawn]
    script = SCRIPT.format(truth=world.truth, arm_rule=arm_rule, poses="\n".join(poses))
    (folder / "script.toml").write_text(script, encoding="utf-8")
    return frame


def table_frame() -> TableFrame:
    """Of three touches that were exact."""
    corners = {"origin": (0.0, 0.0, 0.0), "x axis": (600.0, 0.0, 0.0), "plane": (0.0, 600.0, 0.0)}
    return TableFrame.from_touches(MADE, SERIAL, [TouchedPoint(*one) for one in corners.items()])


def _verification(rng: np.random.Generator, u_mm: float) -> Verification:
    """Three divots of ten touches and seven lengths of 300 mm, of an arm that is as stated."""
    leans = np.array([[0.5, 0.0, 0.87], [-0.5, 0.0, 0.87]] * 5)
    locations = tuple(
        LocationTest(name, np.add(rng.normal(0.0, u_mm, (10, 3)), [at, 0.0, 0.0]), leans)
        for name, at in (("near", 200.0), ("middle", 330.0), ("far", 450.0))
    )
    a = rng.normal(0.0, u_mm, (7, 3))
    b = np.add(rng.normal(0.0, u_mm, (7, 3)), [300.0, 0.0, 0.0])
    lengths = tuple(LengthTest(f"direction {k}", a[k], b[k], 300.0) for k in range(7))
    return Verification(MADE, SERIAL, locations, lengths, "a bar")


_ENVIRONMENT = cache(environment)  # its templates are compiled once


@contextmanager
def _world(errors: _Errors, off: Off, frame: TableFrame) -> Iterator[None]:
    touch, trials = Toucher._touch_end, Renderer.trials

    @contextmanager
    def opened(rig: LoadedRig, *_: Any, **__: Any) -> Iterator[Devices]:
        clock, table = VirtualClock(), rig.rig
        world: Any = EmulatedWorld(clock, errors.seed, _Renderer)  # type: ignore[arg-type]
        errors.scene = world
        at = table.arm.check_point_mm
        hands = EmulatedOperator(world, hand_error_mm=0.0, check_point_mm=at)
        assert table.stage is not None
        devices: Any = Devices
        with closing(world):
            stage = _Stage(table.stage, table.emulation.stage, world)
            there = _Arm(), _Bath(clock, rig.profile), stage, _Cameras(), hands
            yield devices(clock, *there, world.ends_mm)

    def first(press: Renderer, apart: Any) -> Iterator[tuple[str, str]]:
        """The trials' own pages are alike; most of the time would go into them."""
        yield from islice(trials(press, apart), 1)
        yield from ((f"{trial.id}.html", "") for trial in press._page.trials[1:])

    def touched(toucher: Toucher, *given: Any) -> Any:
        errors.end = errors.of_an_end()
        try:
            return touch(toucher, *given)
        finally:
            errors.end = None

    with ExitStack() as stack:
        stack.enter_context(bare())
        for of, name, what in (
            (Toucher, "_touch_end", touched),
            (TipReader, "read", lambda _: errors.reading(frame)),
            (Renderer, "trials", first),
        ):
            stack.enter_context(patch.object(of, name, what))
        for name, new in (
            ("bench.run.trial.FrameTaker", _Frames),
            ("bench.run.start.open_instruments", opened),
            ("bench.run.start.make_detectors", lambda *_: [NullDetector(errors, off)]),
            ("reports.render.environment", _ENVIRONMENT),
            # each answer takes 5 ms, on any machine
            ("bench.results.answers.stopwatch_s", partial(next, count(0.0, 0.005))),
            ("bench.results.answers.processor_s", partial(next, count(0.0, 0.005))),
        ):
            stack.enter_context(patch(name, new))
        yield
