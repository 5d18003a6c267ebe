"""A scene as its differences from the plainest one: four places for upright teats, nothing else
there, plain light. Numbers are 0 where they are plain; `repr` shows what differs, as Python.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from functools import cache
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeVar, get_type_hints

from bench.api.loading import AnyRig
from bench.api.shots import Shot, draw
from bench.arguments import fits, words
from bench.campaign.perturbations import KINDS as PERTURBATIONS
from bench.campaign.perturbations import Applied
from bench.config import ArgumentError, short, wrong_use
from bench.rig.scenes import teat_temp_c
from instruments.world.backdrop import Backdrop
from instruments.world.objects import KINDS, make_object
from instruments.world.objects import SceneObject as Placed
from instruments.world.phantom import Phantom, PlatePose, TeatShape
from instruments.world.phantom import Teat as Standing
from instruments.world.setups import EYES_MM, Situation, apart, situation_faults
from instruments.world.shading import Lighting, Paint
from instruments.world.situations import CLEAR_MM
from instruments.world.state import SceneState

# where teats stand: as an udder from behind, the near ones closer together
PLACES_MM = ((-193.0, 210.0), (-137.0, 210.0), (-240.0, 270.0), (-90.0, 270.0))
LENGTH_MM, RADIUS_MM = 135.0, 11.0
WATER_C, ROOM_C = 33.0, 20.0
# teats and the board behind them
PAINTS = {"dark": (Paint(0.07, 0.05), 0.55), "skin": (Paint(0.45, 0.1), 0.15)}
Part = TypeVar("Part")
_hints = cache(get_type_hints)
NOISES = 4  # neighbours that differ in noise alone


class Steps(NamedTuple):
    """A number goes in whole steps of ``size``, so many from 0 at least and at most; those of the
    ``published`` range are what the thesis's scenes have.
    """

    size: float
    least: int
    most: int
    published: tuple[int, int] = (0, 0)

    def value(self, steps: int) -> float:
        """A whole number where the size is one."""
        return round(steps * self.size, 6) if self.size % 1 else steps * round(self.size)


@dataclass(frozen=True, slots=True, repr=False)
class _Differences:
    """What scene, teat, pose and object have in common."""

    STEPS: ClassVar[dict[str, Steps]]

    def __post_init__(self) -> None:
        of = _hints(type(self))  # type: ignore[arg-type]
        for name in (one.name for one in fields(self)):
            if not fits(value := getattr(self, name), of[name]):
                raise ArgumentError.plain(f"{name} is {short(repr(value))}, not {words(of[name])}")
            if isinstance(value, list):  # is a key of what was looked at
                object.__setattr__(self, name, tuple(value))

    def __repr__(self) -> str:
        shown = [
            repr(value) if one.default is MISSING else f"{one.name}={value!r}"
            for one in fields(self)
            if (value := getattr(self, one.name)) != one.default
        ]
        return f"{type(self).__name__}({', '.join(shown)})"

    def _repr_pretty_(self, printer: Any, *_: object) -> None:
        """As hypothesis prints it."""
        printer.text(repr(self))

    def differing(self) -> int:
        """How many of its numbers are not plain."""
        return sum(getattr(self, name) != 0 for name in self.STEPS)

    def nearer(self, share: float) -> Self:
        """Its numbers at a share of what they are, in whole steps."""
        kept = {name: share * getattr(self, name) / one.size for name, one in self.STEPS.items()}
        return replace(self, **{name: self.STEPS[name].value(round(n)) for name, n in kept.items()})

    def one_step_away(self) -> Iterator[Self]:
        """Each number a step up and down, within what it may be."""
        for name, steps in self.STEPS.items():
            at = round(getattr(self, name) / steps.size)
            for near in (at - 1, at + 1):
                if steps.least <= near <= steps.most:
                    yield replace(self, **{name: steps.value(near)})


@dataclass(frozen=True, slots=True, repr=False)
class Teat(_Differences):
    """A teat at its place: shifted, longer or thicker (its radius), leaning, cooler than others."""

    right_mm: float = 0
    away_mm: float = 0
    longer_mm: float = 0
    thicker_mm: float = 0
    lean_deg: float = 0
    lean_away_deg: float = 0
    cooler_k: float = 0

    @wrong_use()
    def at(self, place_mm: tuple[float, float]) -> Standing:
        """Raises ConfigError for a shape that can't be."""
        x, y = place_mm
        shape = TeatShape(LENGTH_MM + self.longer_mm, RADIUS_MM + self.thicker_mm)
        lean = math.radians(self.lean_deg), math.radians(self.lean_away_deg)
        return Standing((x + self.right_mm, y + self.away_mm), shape, lean)


@dataclass(frozen=True, slots=True, repr=False)
class Pose(_Differences):
    """Where the phantom's plate stands, and how it is turned."""

    right_mm: float = 0
    away_mm: float = 0
    turn_deg: float = 0


@dataclass(frozen=True, slots=True, repr=False)
class Object(_Differences):
    """A thing beside the phantom (docs/scene.md has the kinds), as far off its usual place."""

    kind: str
    right_mm: float = 0
    away_mm: float = 0
    warmer_k: float = 0
    lighter_percent: float = 0

    @wrong_use()
    def placed(self) -> Placed:
        """Raises ConfigError for a kind that isn't known."""
        if self.kind not in KINDS:
            return make_object(self.kind)
        shape, (_, offset_k, albedo, _, _) = KINDS[self.kind]
        usual = inspect.signature(shape).parameters
        return make_object(
            self.kind,
            x_mm=float(usual["x_mm"].default + self.right_mm),
            y_mm=float(usual["y_mm"].default + self.away_mm),
            offset_k=float(offset_k + self.warmer_k),
            albedo=_share(albedo + self.lighter_percent / 100.0),
        )


@dataclass(frozen=True, slots=True, repr=False)
class Scene(_Differences):
    """All of a scene. ``light_percent`` more light, the board so much lighter (of white) and
    textured, a room so much warmer; ``noise`` numbers the pictures' noise.
    """

    teats: tuple[Teat, ...] = (Teat(),)
    pose: Pose = Pose()
    paint: Literal["dark", "skin"] = "dark"
    light_percent: float = 0
    board_percent: float = 0
    texture_percent: float = 0
    room_k: float = 0
    objects: tuple[Object, ...] = ()
    perturbations: tuple[Applied, ...] = ()
    noise: int = 0

    def differences(self, plainest: Scene | None = None) -> int:
        """How many things differ from the plainest scene of a range: a teat, an object or a
        perturbation more, the paint, and each number that is not plain.
        """
        parts = (self, *self.teats, self.pose, *self.objects)
        more = abs(len(self.teats) - len((plainest or Scene()).teats))
        more += len(self.objects) + len(self.perturbations) + (self.paint != "dark")
        return more + sum(map(_Differences.differing, parts))

    @property
    @wrong_use()
    def situation(self) -> Situation:
        """What stands where. Raises ConfigError for what can't be."""
        if not 0 < len(self.teats) <= len(PLACES_MM):
            raise ValueError(f"a scene has 1 to {len(PLACES_MM)} teats, this one {len(self.teats)}")
        paint, board = PAINTS[self.paint]
        pose = self.pose
        return Situation(
            "given",
            0,
            "",
            Phantom(
                tuple(one.at(place) for one, place in zip(self.teats, PLACES_MM, strict=False)),
                PlatePose(pose.right_mm, pose.away_mm, 0.0, math.radians(pose.turn_deg)),
            ),
            tuple(one.placed() for one in self.objects),
            lighting=Lighting(1.15 * (1.0 + self.light_percent / 100.0)),
            backdrop=Backdrop(
                board_albedo=_share(board + self.board_percent / 100.0),
                board_texture=self.texture_percent / 100.0,
            ),
            teat_paint=paint,
        )

    @wrong_use()
    def state(self) -> SceneState:
        """With its temperatures: the bath at 33 degC. Raises ConfigError for what can't be."""
        return self._warm(self.situation)

    def _warm(self, situation: Situation) -> SceneState:
        room_c = ROOM_C + self.room_k
        warm_c = teat_temp_c(WATER_C, room_c)
        teats_c = tuple(warm_c - one.cooler_k for one in self.teats)
        return situation.state(teats_c, WATER_C, room_c)

    def draw(self, rig: AnyRig = "emulated") -> Shot:
        """Its pictures by the emulated cameras of ``rig``, and the truth. Raises ConfigError for
        what can't be, or is too near a camera.
        """
        return draw(self.state(), self.noise, rig=rig, perturbations=self.perturbations)

    def faults(self) -> tuple[str, ...]:
        """What keeps it from being set up on a bench, in words."""
        try:
            situation = self.situation
            self._warm(situation)
        except ValueError as error:
            return (str(error),)
        if len(self.teats) > 1 and apart(situation.phantom, EYES_MM) < CLEAR_MM:
            return ("a teat stands before another one",)
        return situation_faults(situation)

    def neighbours(self) -> tuple[Scene, ...]:
        """All that can be set up one step away: a number a step up or down, or other noise."""
        near = list(self.one_step_away())
        near += [replace(self, pose=one) for one in self.pose.one_step_away()]
        step = Teat.one_step_away
        near += [replace(self, teats=few) for few in _one_changed(self.teats, step)]
        moved = _one_changed(self.objects, Object.one_step_away)
        near += [replace(self, objects=few) for few in moved]
        done = _one_changed(self.perturbations, _beside)
        near += [replace(self, perturbations=few) for few in done]
        near += [replace(self, noise=self.noise + 1 + number) for number in range(NOISES)]
        return tuple(one for one in near if not one.faults())


def stand(teats: Mapping[int, Teat]) -> bool:
    """Whether teats, by the numbers of their places, can be set up where nothing else is."""
    standing = (one.at(PLACES_MM[i]) for i, one in teats.items())
    phantom = Phantom(tuple(standing))
    clear = len(teats) < 2 or apart(phantom, EYES_MM) >= CLEAR_MM
    return clear and not situation_faults(Situation("given", 0, "", phantom))


Teat.STEPS = {
    "right_mm": Steps(1, -60, 60, (-8, 8)),
    "away_mm": Steps(1, -60, 60, (-8, 8)),
    "longer_mm": Steps(1, -20, 15, (-15, 15)),
    "thicker_mm": Steps(0.5, -3, 3, (-3, 3)),
    "lean_deg": Steps(1, -16, 16, (-13, 13)),
    "lean_away_deg": Steps(1, -16, 16, (-13, 13)),
    "cooler_k": Steps(0.5, 0, 10),
}
Pose.STEPS = {
    "right_mm": Steps(5, -20, 20),
    "away_mm": Steps(5, -20, 20),
    "turn_deg": Steps(5, -9, 9),
}
Object.STEPS = {
    "right_mm": Steps(5, -50, 50, (-20, 20)),
    "away_mm": Steps(5, -50, 50, (-20, 20)),
    "warmer_k": Steps(0.5, -10, 10, (-4, 4)),
    "lighter_percent": Steps(5, -10, 14),
}
Scene.STEPS = {
    "light_percent": Steps(10, -7, 5, (-1, 1)),
    "board_percent": Steps(2, -20, 10, (-3, 5)),
    "texture_percent": Steps(2, 0, 10, (0, 2)),
    "room_k": Steps(1, -5, 11, (-3, 4)),
}
PUBLISHED_KINDS = ("cold_teat", "hot_cup", "warm_arm", "cooler_body")  # the thesis's, section 5.2
# by name: a plain amount, and steps from it
AMOUNTS = {
    "defocus": (0.0, Steps(0.5, 1, 6)),
    "noise": (0.0, Steps(1, 1, 10)),
    "exposure": (1.0, Steps(0.1, -5, 10)),
    "gamma": (1.0, Steps(0.1, -4, 10)),
    "blur-across": (0.0, Steps(1, 2, 10)),
    "jpeg": (100.0, Steps(10, -9, -1)),
    "dirt": (0.0, Steps(1, 1, 20)),
    "thermal-drift": (0.0, Steps(1, -4, 4)),
    "thermal-noise": (0.0, Steps(0.1, 1, 5)),
    "out-of-step": (0.0, Steps(0.5, -4, 4)),
    "vergence": (0.0, Steps(0.01, -10, 10)),
}


def _one_changed(
    parts: tuple[Part, ...], changes: Callable[[Part], Iterator[Part]]
) -> Iterator[tuple[Part, ...]]:
    for i, part in enumerate(parts):
        for one in changes(part):
            yield (*parts[:i], one, *parts[i + 1 :])


def _share(albedo: float) -> float:
    return min(max(albedo, 0.0), 1.0)


def _beside(done: Applied) -> Iterator[Applied]:
    """A perturbation with an amount one step less or more."""
    if done.name not in AMOUNTS:
        return
    plain, steps = AMOUNTS[done.name]
    at = round((done.amount - plain) / steps.size)
    for near in (at - 1, at + 1):
        amount = round(plain + near * steps.size, 6)
        if PERTURBATIONS[done.name].low <= amount <= PERTURBATIONS[done.name].high:
            yield Applied(done.name, amount)
