"""The parameters of a bundle adjustment: which there are, which may move, and what a step of them does. No fitting here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from detector.geometry import Array, Camera, Motion

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
POSE = ("om1", "om2", "om3", "T1", "T2", "T3")


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What camera ``camera`` saw of the board in its pose number ``pose``: points on the board (n, 3) mm and their pixels (n, 2)."""

    camera: str
    pose: int
    board_mm: Array
    pixels_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras by name, and the motion of each from the frame of reference, which is the first camera's."""

    cameras: Mapping[str, Camera]
    from_reference: Mapping[str, Motion]

    @property
    def reference(self) -> str:
        """The camera in whose frame all is told."""
        return next(iter(self.cameras))


@dataclass(frozen=True, slots=True)
class Freedom:
    """What may move. ``lens`` names the free parameters of each camera (of `LENS`); ``aspect`` fixes fx / fy as it is at the start.

    ``motions``: whether the cameras may move against each other.
    """

    lens: Mapping[str, frozenset[str]]
    aspect: frozenset[str] = frozenset()
    motions: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Cameras, and reference_from_board of each view."""

    rig: Rig
    poses: tuple[Motion, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Which column of the Jacobian is which parameter: those of cameras and motions first, then six a pose."""

    shared: tuple[tuple[str, str], ...]
    ratio: Mapping[str, float]  # fy / fx where it is held
    poses: int

    @classmethod
    def of(cls, start: Rig, poses: int, freedom: Freedom) -> Layout:
        """The parameters that ``freedom`` leaves to ``poses`` views of the cameras of ``start``."""
        lens = [
            (name, p)
            for name in start.cameras
            for p in LENS
            if p in freedom.lens.get(name, frozenset()) and not (p == "fy" and name in freedom.aspect)
        ]
        moved = [(name, p) for name in start.cameras if name != start.reference for p in POSE] if freedom.motions else []
        ratio = {name: start.cameras[name].fc[1] / start.cameras[name].fc[0] for name in freedom.aspect}
        return cls((*lens, *moved), ratio, poses)

    @property
    def size(self) -> int:
        """How many parameters there are."""
        return len(self.shared) + 6 * self.poses

    def columns(self, camera: str, names: Sequence[str]) -> tuple[list[int], list[int]]:
        """Of the parameters ``names`` of a camera, those that are free: their places among ``names``, and their columns."""
        at = {key: column for column, key in enumerate(self.shared)}
        free = [(i, at[camera, name]) for i, name in enumerate(names) if (camera, name) in at]
        return [i for i, _ in free], [column for _, column in free]

    def moved(self, state: State, step: Array) -> State:
        """The state after a step (size,)."""
        cameras, motions = dict(state.rig.cameras), dict(state.rig.from_reference)
        for name, camera in cameras.items():
            values = np.array([*camera.fc, *camera.cc, *camera.kc])
            places, columns = self.columns(name, LENS)
            values[places] += step[columns]
            if name in self.ratio:
                values[1] = values[0] * self.ratio[name]
            if not (values[:2] > 0).all():
                return state  # a step to nowhere: no better than before, so the damping grows
            fx, fy, cx, cy, *kc = (float(v) for v in values)
            cameras[name] = replace(camera, fc=(fx, fy), cc=(cx, cy), kc=(kc[0], kc[1], kc[2], kc[3], kc[4]))
            places, columns = self.columns(name, POSE)
            if places:
                motions[name] = _shifted(motions[name], step[columns])
        tail = step[len(self.shared) :].reshape(-1, 6)
        poses = tuple(_shifted(pose, part) for pose, part in zip(state.poses, tail, strict=True))
        return State(Rig(cameras, motions), poses)

    def told(self, column: int) -> str:
        """A parameter's name for a sentence."""
        if column < len(self.shared):
            camera, name = self.shared[column]
            return f"{name} of the {camera} camera"
        return f"where the board was in view {(column - len(self.shared)) // 6 + 1}"


def _shifted(motion: Motion, step: Array) -> Motion:
    return Motion.from_vectors(motion.om + step[:3], motion.T + step[3:])
