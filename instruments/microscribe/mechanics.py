"""The body of the emulated arm: encoder counts for a hand that holds the tip somewhere; bouncing
pedals.

A target goes through inverse kinematics, plus the arm's own inaccuracy (fixed for a pose) and the
hand's tremor (new for each packet), and is rounded last. Chance comes from the seed and the
packet's number.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from instruments.microscribe.kinematics import JOINTS, RANGES_RAD, ArmGeometry, Floats, inverse

_POSES = 4000
_BLOCK = 1024
_PARAMETERS, _TREMOR, _CONTACTS = 0, 1, 3  # streams of chance; 2 is that of the faults


class Contacts:
    """Bit 0 is the single or right pedal, bit 1 the left one; 1 is pressed."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._moved = 0
        self._before = self._after = 0
        self._settled_s = 0.0

    @property
    def meant(self) -> int:
        """What the feet do."""
        return self._after

    def move(self, buttons: int, now_s: float, bounce_s: float) -> None:
        """The feet press or release; what changes bounces for ``bounce_s``."""
        self._before, self._after, self._settled_s = self._after, buttons, now_s + bounce_s
        self._moved += 1

    def at(self, now_s: float, look: int) -> int:
        """What the contacts show at the ``look``-th look: before they have settled, either."""
        if now_s >= self._settled_s:
            return self._after
        chance = np.random.default_rng([self._seed, _CONTACTS, self._moved, look])
        return self._before if chance.random() < 0.5 else self._after


class Hand(Protocol):
    """Whoever holds the stylus."""

    def arm_target(self) -> tuple[Floats, Floats | None] | None:
        """Tip (3,) mm in the arm's frame, and direction (3,) from it up the stylus or None for any.
        None altogether: the stylus is on its peg.
        """
        ...


class KinematicError:
    """The tip's distance from where the counts say, as a smooth function of the pose.

    Lengths, twists and encoder zeros differ a little from the stored ones. Joint 0 stays true and
    the mean is removed, since both would be another frame. The mean distance over the workspace is
    ``accuracy_mm``.
    """

    def __init__(
        self, geometry: ArmGeometry, home_rad: Floats, *, seed: int, accuracy_mm: float
    ) -> None:
        chance = np.random.default_rng([seed, _PARAMETERS])
        later = np.arange(JOINTS) > 0
        self._stored = geometry
        self._real = dataclasses.replace(
            geometry,
            alpha_rad=geometry.alpha_rad + later * chance.normal(0.0, 3e-4, JOINTS),
            a_mm=geometry.a_mm + later * chance.normal(0.0, 0.1, JOINTS),
            d_mm=geometry.d_mm + later * chance.normal(0.0, 0.1, JOINTS),
        )
        self._zeros_rad = later * geometry.active * chance.normal(0.0, 5e-4, JOINTS)
        poses = workspace(geometry, home_rad, chance)
        if not len(poses):
            raise ValueError(
                "this arm's tip never comes above the table that it stands on: check its parameters"
                " and home counts"
            )
        raw = self._raw(poses)
        self._mean = raw.mean(axis=0)
        self._scale = accuracy_mm / float(np.linalg.norm(raw - self._mean, axis=1).mean())

    def at(self, angles_rad: Floats) -> Floats:
        """Error of the tip (n, 3) mm at joint angles (n, 6) rad."""
        error: Floats = self._scale * (self._raw(angles_rad) - self._mean)
        return error

    def _raw(self, angles_rad: Floats) -> Floats:
        real, _ = self._real.forward_angles(angles_rad + self._zeros_rad)
        stored, _ = self._stored.forward_angles(angles_rad)
        return real - stored


def workspace(geometry: ArmGeometry, home_rad: Floats, chance: np.random.Generator) -> Floats:
    """Poses (n, 6) rad spread over the joint ranges whose tip is above the table."""
    turned = chance.uniform(RANGES_RAD[:, 0], RANGES_RAD[:, 1], (_POSES, JOINTS))
    poses = home_rad + turned * geometry.active
    tips, _ = geometry.forward_angles(poses)
    return poses[tips[:, 2] > 0.0]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Counts that are not rounded, and the least joint motion that moves the tip."""

    counts: Floats  # (6,)
    counts_per_mm: Floats  # (6, 3)


class Mechanics:
    """The joints of one arm in one hand. ``home`` (6,) are the counts on the peg, ``accuracy_mm``
    the mean error over the workspace, ``tremor_mm`` the tip's rms distance from its target.
    """

    def __init__(
        self,
        geometry: ArmGeometry,
        home: tuple[int, ...],
        hand: Hand,
        *,
        seed: int,
        accuracy_mm: float,
        tremor_mm: float,
    ) -> None:
        self._geometry = geometry
        self._home = np.array(home, dtype=np.float64)
        self._on_peg = home
        self._hand = hand
        self._seed = seed
        self._tremor_mm = tremor_mm
        self._error = KinematicError(
            geometry, geometry.angles(self._home)[0], seed=seed, accuracy_mm=accuracy_mm
        )
        self._held: tuple[bytes, Pose] | None = None
        self._block: tuple[Pose, int, list[list[int]]] | None = None

    def counts(self, packet: int) -> list[int]:
        """Counts (6,) of the ``packet``-th packet; made a thousand at a time, for hosts that poll
        fast. Raises OutOfReachError.
        """
        target = self._hand.arm_target()
        if target is None:
            return list(self._on_peg)
        pose = self._pose(*target)
        block, row = divmod(packet, _BLOCK)
        if self._block is None or self._block[0] is not pose or self._block[1] != block:
            counts = np.rint(pose.counts + self.tremor(block) @ pose.counts_per_mm.T)
            self._block = pose, block, counts.astype(np.int64).tolist()
        return self._block[2][row]

    def _pose(self, point_mm: Floats, direction: Floats | None) -> Pose:
        key = point_mm.tobytes() + (b"" if direction is None else direction.tobytes())
        if self._held is None or self._held[0] != key:
            self._held = key, self.solve(point_mm, direction)
        return self._held[1]

    def solve(self, point_mm: Floats, direction: Floats | None) -> Pose:
        """The pose for this target, the arm's inaccuracy included. Raises OutOfReachError."""
        counts = inverse(self._geometry, point_mm, direction, start=self._home)
        goal = np.asarray(point_mm) + self._error.at(self._geometry.angles(counts))[0]
        # a step of a fraction of a millimetre: Newton is exact to 1e-9 mm after three
        for _ in range(3):
            tip, _ = self._geometry.forward(counts)
            counts = counts + self._counts_per_mm(counts) @ (goal - tip[0])
        return Pose(counts, self._counts_per_mm(counts))

    def _counts_per_mm(self, counts: Floats) -> Floats:
        slopes = self._geometry.jacobian(self._geometry.angles(counts))[0, :3]
        per_rad = self._geometry.turns / (2.0 * np.pi)
        moved: Floats = np.linalg.pinv(slopes) * per_rad[:, None]
        return moved

    def tremor(self, block: int) -> Floats:
        """How far the hand is off at each packet of a block, (n, 3) mm."""
        chance = np.random.default_rng([self._seed, _TREMOR, block])
        return chance.normal(0.0, self._tremor_mm / np.sqrt(3.0), (_BLOCK, 3))
