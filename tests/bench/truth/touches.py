"""What the tests of the truth share: an arm and an operator in one, that is told where each touch
lands; stages, noise, registrations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.rig.model import ArmTable
from bench.script.phantom import find_layout, load_layout
from bench.truth.registration import Registration, StageAccuracy, Station
from bench.truth.touching import Ends, TipReader, Toucher
from bench.truth.uncertainty import CHI2_95, TrueEnd, triple
from detector.geometry import Motion
from instruments.clock import VirtualClock
from instruments.microscribe.configuration import Identity
from instruments.microscribe.driver import Reading
from instruments.microscribe.errors import ArmMovesError
from instruments.operators.operator import OperatorSkip, Release, Request, Touch
from instruments.world.phantom import Phantom

Floats = NDArray[np.float64]

MADE = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
# table 5.1
ENDS_MM = np.array(
    [[-110.2, 284.2, 134.2], [-161.9, 192.6, 137.6], [-224.9, 199.4, 136.7], [-260.6, 267.1, 136.3]]
)
UP = np.tile([0.0, 0.0, 1.0], (4, 1))
CORNERS_MM = np.array(
    [
        [-225.0, -212.5, -1.0],
        [-75.0, -212.5, -1.0],
        [-75.0, -62.5, -1.0],
        [-225.0, -62.5, -1.0],
        [-150.0, -137.5, -1.0],
    ]
)
ACCURACY = StageAccuracy(scale_u=5e-4, squareness_u_rad=5e-4, repeatability_mm=0.02)
U_MM = 0.28  # of one registration touch along an axis


def arm_settings(**settings: float) -> ArmTable:
    return ArmTable.model_validate({"url": "emulator:", **settings})


@dataclass
class Hand:
    """Operator and arm: each touch that is asked for lands at the next of ``places``, or on the
    asked end when they are used up.

    The next ``skips`` prompts are answered with a skip.
    """

    ends: Floats
    places: Sequence[Floats | None] = ()  # None: the arm moves while it is read
    asked: list[tuple[int, int, int]] = field(default_factory=list)
    again: list[str] = field(default_factory=list)
    released: int = 0
    skips: int = 0
    _next: Iterator[Floats | None] | None = None
    _at: Floats | None = None

    def ask(self, request: Request) -> None:
        if isinstance(request, Release):
            self.released += 1
        elif isinstance(request, Touch):
            self._touch(request)

    def _touch(self, asked: Touch) -> None:
        assert asked.of == len(self.ends)
        if self.skips:
            self.skips -= 1
            raise OperatorSkip("tired")
        self.asked.append((asked.teat, asked.number, asked.numbers))
        if asked.again:
            self.again.append(asked.again)
        self._next = iter(self.places) if self._next is None else self._next
        self._at = next(self._next, self.ends[asked.teat - 1])

    @property
    def identity(self) -> Identity:
        raise NotImplementedError("these tests never ask who the arm is")

    touches = False

    def touch(self, point_mm: Floats, axis: Floats) -> None:
        raise AssertionError("it is moved by hand")

    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading:
        if self._at is None:
            raise ArmMovesError(
                "arm", f"the tip moved by more than {max_spread_mm:g} mm while it was read"
            )
        return Reading(self._at, 0.05, np.array([0.0, 0.0, 1.0]), n, (0,) * 6)


def toucher(hand: Hand, *, readings: int | None = None, arm: ArmTable | None = None) -> Toucher:
    settings = arm or arm_settings()
    return Toucher(
        hand.ask, TipReader(hand, settings, None), settings, VirtualClock(), lambda: None, readings
    )


def layout(name: str) -> Phantom:
    return load_layout(find_layout(name)).phantom(0)


def table_5_1() -> Ends:
    return Ends(ENDS_MM, UP)


@dataclass(frozen=True)
class TrueStage:
    """A stage whose axes are off by E, (3, 3), turned in the world by R."""

    R: Floats
    E: Floats

    def moves(self, way_mm: Floats) -> Floats:
        return np.asarray(way_mm @ (self.R @ (np.eye(3) + self.E)).T)


def stage_of(rng: np.random.Generator, *, scale: float = 0.0, squareness: float = 0.0) -> TrueStage:
    """Scale and squareness drawn with these standard deviations, any turn about the vertical."""
    sx, sy, sz = rng.normal(0.0, scale, 3)
    a, b, c = rng.normal(0.0, squareness, 3)
    R = Motion.from_vectors(rng.normal(0.0, 1.0, 3) * [0.02, 0.02, 0.6], (0.0, 0.0, 0.0)).R
    return TrueStage(R, np.array([[sx, -a, -b], [0.0, sy, -c], [0.0, 0.0, sz]]))


def registered(
    stage: TrueStage, rng: np.random.Generator, *, u_mm: float = U_MM, at_mm: Floats = CORNERS_MM
) -> Registration:
    """What touches of one end at ``at_mm`` give, each coordinate off by ``u_mm``."""
    touched = ENDS_MM[0] + stage.moves(at_mm - CORNERS_MM[-1]) + rng.normal(0.0, u_mm, at_mm.shape)
    stations = tuple(
        Station(triple(at), triple(end), u_mm) for at, end in zip(at_mm, touched, strict=True)
    )
    return Registration(MADE, "40937", "Grbl 1.1h", 1, stations, ACCURACY)


def axes_turned(found: Registration) -> tuple[Motion, Floats]:
    """The rotation with the stage's x axis as reference (squareness is y's alone), and the
    covariance (3, 3) of its rotation vector in the stage's axes.
    """
    free = found._free
    turn = Motion.from_vectors(free.rotation, (0.0, 0.0, 0.0)).R
    turned = Motion(found.world_from_stage.R @ turn, np.zeros(3))
    return turned, np.asarray(found.u_mm**2 * free.covariance[:3, :3])


def holds(truth: TrueEnd, point_mm: ArrayLike) -> bool:
    """Whether the stated 95 % region, an ellipsoid, holds a point (3,)."""
    off = np.subtract(point_mm, truth.xyz_mm)
    return bool(off @ np.linalg.solve(truth.covariance_mm2, off) <= CHI2_95)
