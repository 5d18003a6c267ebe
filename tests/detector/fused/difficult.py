"""Scenes of the bench's own renderer, and those on which decisions of the detector failed."""

from __future__ import annotations

import tomllib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.rig.scenes import warm
from instruments.world.scene import Renderer
from instruments.world.situations import situation
from tests.conftest import ROOT


class Rendered(NamedTuple):
    """Pictures, ends (n, 3) mm, and which of them all cameras see."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    thermal_k: NDArray[np.float64]
    ends_mm: NDArray[np.float64]
    visible: NDArray[np.bool_]


def rendered(renderer: Renderer, family: str, noise: int, member: int) -> Rendered:
    """A member of a family by a renderer of that noise."""
    state = warm(situation(family, member))
    taken = renderer.render(state, np.random.default_rng([noise, member, *family.encode()]))
    visible = np.array([row.all() for row in renderer.visible_ends(state)])
    thermal_k = taken.thermal_ck / 100.0
    return Rendered(taken.left, taken.right, thermal_k, state.phantom.ends_mm, visible)


FILE = ROOT / "tests/data/difficult_scenes.toml"
DIFFICULT = [
    (str(f), int(n), int(m)) for f, n, m in tomllib.loads(FILE.read_text("utf-8"))["scenes"]
]
