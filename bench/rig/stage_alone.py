"""One stage without a script: opened by its port or by a rig file, looked at, homed, moved and
jogged.

Opening the port resets most controllers, and nothing moves before homing: who wants to move homes
first, each time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from bench.config import ConfigError
from bench.rig.loading import find_rig, load_rig
from bench.rig.model import Stage as StageTable
from bench.rig.opening import open_instruments, rig_of
from bench.rig.urls import EMULATED
from instruments.captures.capture import NO_CAPTURE, Captures
from instruments.errors import InstrumentError
from instruments.stage.driver import Stage
from instruments.stage.settings import check_within, declared

KEYS = {"X": "x_mm", "Y": "y_mm", "Z": "z_mm", "A": "a_deg"}
_STEP = re.compile(r"([XYZA])([-+]?(?:\d+\.?\d*|\.\d+))", re.IGNORECASE)


def of_rig(name: str) -> StageTable:
    """The stage of a rig. Raises ConfigError where it has none, or an emulated one."""
    rig = load_rig(find_rig(name))
    stage = rig.rig.stage
    if stage is None:
        raise ConfigError.plain(
            f"{rig.path}: this rig has no stage; the operator moves its phantom"
        )
    if stage.url == EMULATED:
        raise ConfigError.plain(
            f"{rig.path}: its stage is emulated; 'teatbench emulate' serves one at a port, for"
            " --port"
        )
    return stage


@contextmanager
def open_stage(at: StageTable, capture: Captures = NO_CAPTURE) -> Iterator[Stage]:
    """The stage, connected and in real time; brought to a stand whatever goes wrong. Raises
    InstrumentError.
    """
    with open_instruments(rig_of(stage=at), ("stage",), capture=capture) as devices:
        stage = devices.stage
        assert stage  # noqa: S101 - it was asked for
        try:
            stage.connect()
            yield stage
        except BaseException as error:
            try:
                stage.safe()
            except InstrumentError as worse:
                error.add_note(str(worse))
            raise


def described(stage: Stage) -> dict[str, object]:
    """Who it is, its state, position and travel: plain text, numbers and lists; units are in the
    names.
    """
    identity, settings, status = stage.identity, stage.settings, stage.status()
    return {
        "dialect": identity.dialect,
        "version": identity.version,
        "build": identity.build,
        "state": status.name,
        "homed": stage.homed,
        **position(stage),
        **{
            f"travel_{KEYS[axis]}": [limits.low_mm, limits.high_mm]
            for axis, limits in stage.limits.items()
        },
        "homing": settings.homing,
        "soft_limits": settings.soft_limits,
        "hard_limits": settings.hard_limits,
    }


def position(stage: Stage) -> dict[str, float]:
    """Where the controller believes the stage is, by axis with its unit, machine coordinates."""
    return {
        KEYS[axis]: round(float(at), 3)
        for axis, at in zip("XYZA", stage.position(), strict=False)
        if axis in stage.axes
    }


def shown(stage: Stage) -> str:
    """The position as one line of text."""
    return ", ".join(f"{key[0].upper()} {at:.3f} {key[2:]}" for key, at in position(stage).items())


def check_target(
    stage: Stage, x_mm: float, y_mm: float, *, z_mm: float | None = None, a_deg: float | None = None
) -> None:
    """Raise LimitError for a place that the stage can't go to, before anything moves."""
    wanted = {"X": x_mm, "Y": y_mm, "Z": z_mm, "A": a_deg}
    target = declared(wanted, stage.axes, who="stage")
    check_within(target, stage.settings, "move", who="stage")


def step(text: str) -> dict[str, float]:
    """A way as ``X-5Y2.5``: arguments of `Stage.jog`. Raises ValueError."""
    found = _STEP.findall(text)
    axes = [axis.upper() for axis, _ in found]
    if (
        not found
        or "".join(axis + way for axis, way in found) != text
        or len(set(axes)) != len(axes)
    ):
        raise ValueError(
            f"{text!r} is no way to go; write X-5, or X-5Y2.5 for both at once (mm, degrees for A)"
        )
    return {KEYS[axis]: float(way) for axis, (_, way) in zip(axes, found, strict=True)}


def jog(stage: Stage, way: dict[str, float], feed_mm_min: float | None) -> None:
    """Go by ``way`` and wait; an interrupt ends the jog where it is. Raises InstrumentError."""
    stage.jog(**way, feed_mm_min=feed_mm_min)
    try:
        stage.finish_move()
    except KeyboardInterrupt:
        stage.cancel_jog()
        raise
