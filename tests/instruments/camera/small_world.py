"""A world where nothing happens but what a test changes, for emulated cameras to look at."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from instruments.clock import Clock, VirtualClock
from instruments.world.scene import RenderedSet, Renderer
from instruments.world.state import SceneState
from tests.conftest import ROOT
from tests.situations import situation


@cache
def renderer() -> Renderer:
    table = tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))
    return Renderer.from_calibration(table, camera_seed=7)


@dataclass
class SmallWorld:
    """``state`` is what stands there; tests may set another."""

    state: SceneState = field(default_factory=lambda: situation("spurious_teat"))
    clock: Clock = field(default_factory=VirtualClock)

    @property
    def renderer(self) -> Renderer:
        return renderer()

    def scene(self) -> SceneState:
        return self.state

    def frame_rng(self, kind: str, index: int) -> np.random.Generator:
        return np.random.default_rng([3, *kind.encode(), index])


@cache
def gallery() -> tuple[RenderedSet, ...]:
    """Five frame sets of one scene, each with noise of its own: drawn once."""
    return tuple(
        renderer().render(situation("spurious_teat"), np.random.default_rng(seed))
        for seed in range(5)
    )


class Gallery:
    """A renderer that shows the gallery in turn, whatever stands in the world: for tests of what is
    done with frames.
    """

    def __init__(self) -> None:
        self.cameras, self.depth = renderer().cameras, None
        self._shown = 0

    def render(self, _state: SceneState, _rng: np.random.Generator) -> RenderedSet:
        self._shown += 1
        return gallery()[self._shown % 5]


@dataclass
class GalleryWorld(SmallWorld):
    """The gallery before the cameras."""

    shown: Any = field(default_factory=Gallery)

    @property
    def renderer(self) -> Renderer:
        shown: Renderer = self.shown
        return shown
