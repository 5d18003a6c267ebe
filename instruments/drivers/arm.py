"""A measuring arm of another package as the bench's own: several points make a reading, unless it
moved meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.drivers.border import Plugged, PluginBoundary
from instruments.drivers.entry_points import Plugin
from instruments.drivers.plugin import ArmDriver, ArmPoint
from instruments.errors import (
    DeviceError,
    InstrumentError,
    LimitError,
    ProtocolError,
    TouchAgainError,
)
from instruments.microscribe.configuration import Identity
from instruments.microscribe.driver import ArmView, Reading

INTERVAL_S, STOP_S, TOUCH_S = 0.05, 5.0, 60.0
FARTHEST_MM = 20_000.0  # no arm reaches as far: the unit is wrong
Floats = NDArray[np.float64]


class PluggedArm(Plugged):
    """As `instruments.microscribe.driver.MicroScribe`. ``moves``: by a call of ours, and no stand
    was read back since.
    """

    pedals = False
    warnings: tuple[str, ...] = ()

    def __init__(self, plugged: Plugin, clock: Clock) -> None:
        self.who = f"arm {plugged.name}"
        self.touches = getattr(plugged.maker, "touches", False)
        said = getattr(plugged.maker, "homing", "")
        if not isinstance(self.touches, bool) or not isinstance(said, str):
            what = "its class has to say touches, True or False, and homing, a text"
            raise LimitError(self.who, what, hint=f"Correct {plugged}.")
        self.homing = self.homing_again = said or "Reference the measuring arm as its maker says."
        self.moves = False
        self._clock = clock
        self._border: PluginBoundary[ArmDriver] = PluginBoundary(plugged, self.who, clock)
        self._identity: Identity | None = None
        self._homed_at = 0

    @property
    def safe_state(self) -> str:
        return "at a stand, as it reads back itself" if self.touches else "it has no motor"

    @property
    def identity(self) -> Identity:
        """Who answered ``sign_on``. Raises LimitError before."""
        if self._identity is None:
            raise LimitError(self.who, "not signed on yet", hint="Call sign_on().")
        return self._identity

    @property
    def homed(self) -> bool:
        return bool(self._homed_at) and self._homed_at == self._border.link

    @property
    def live(self) -> bool:
        return self._identity is not None

    def asked_of(self, operator: object) -> None:
        """Does nothing: a plug-in's arm asks no operator."""

    def record(self) -> dict[str, object]:
        """What it says of itself."""
        return {"plug-in": str(self._border.plugged), **self._texts()}

    def sign_on(self) -> Identity:
        """Open it and ask who it is; homing has to be confirmed then."""
        self._homed_at = 0
        texts, name = self._texts(), self._border.plugged.name
        serial = texts.get("serial_number", "not stated")
        self._identity = Identity(name, "", texts.get("model", ""), serial, "", "", "")
        return self._identity

    def recover(self, timeout_s: float = 30.0) -> Identity:  # noqa: ARG002 - each call has a limit
        """Open it again. Raises as `sign_on`, DeviceError for another arm."""
        before = self._identity
        self._border.forget()
        now = self.sign_on()
        if before and before.serial_number != now.serial_number:
            what = f"arm {before.serial_number} was lost, and arm {now.serial_number} answers"
            raise DeviceError(self.who, what, hint="Plug the first arm in again.")
        return now

    def confirm_homed(self) -> None:
        """A person says that it is referenced."""
        _ = self.identity
        self._homed_at = self._border.link

    home = confirm_homed

    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading:
        """The median of ``n`` points. Raises TouchAgainError where it moved meanwhile, LimitError
        before homing.
        """
        if not self.homed:
            raise LimitError(self.who, "no position before homing", hint="Call confirm_homed().")
        points = []
        for _ in range(max(1, n)):
            points.append(self._point())
            self._clock.sleep(INTERVAL_S)
        tips = np.array([point.tip_mm for point in points], dtype=np.float64)
        middle = np.median(tips, axis=0)
        spread_mm = float(np.linalg.norm(tips - middle, axis=1).max())
        if spread_mm > max_spread_mm:
            what = f"it moved: its points spread by {spread_mm:.2f} mm, limit {max_spread_mm:g} mm"
            raise TouchAgainError(self.who, what, hint="Hold it still.")
        axes = [point.axis for point in points if point.axis is not None]
        axis = None
        if len(axes) == len(points):
            axis = np.median(np.array(axes, dtype=np.float64), axis=0)
            if not (length := np.linalg.norm(axis)):
                raise self._border.broken("its axes are opposite", axes[-1])
            axis = axis / length
        written = " ".join(f"{value:.4f}" for value in middle)
        return Reading(middle, spread_mm, axis, len(points), written=written)

    def glance(self) -> Reading | None:
        """Where its tip is now, to show."""
        point = self._point()
        return Reading(np.asarray(point.tip_mm), 0.0, point.axis, 1)

    def watch(self, every_s: float) -> Iterator[ArmView]:
        """A view each ``every_s``, without an end. Raises LimitError before homing."""
        while True:
            tip_mm = self.read(1).tip_mm
            yield ArmView(self._clock.now(), tip_mm, {}, 1.0 / every_s, 0)
            self._clock.sleep(every_s)

    def buttons(self) -> int:
        """No pedals are known of it."""
        return 0

    def touch(self, point_mm: Floats, axis: Floats) -> None:
        """Go to ``point_mm`` (3,) in its frame, the stylus along ``axis`` (3,), and wait."""
        if not self.touches:
            raise LimitError(self.who, f"it has no motor to go to {point_mm}")
        if not self.homed:
            raise LimitError(self.who, "no way before homing", hint="Call confirm_homed().")
        self.moves = True
        self._border.call("touch", lambda arm: arm.touch(point_mm, axis), TOUCH_S)
        self._until_still(TOUCH_S)
        self.moves = False

    def safe(self) -> None:
        """At a stand, as read back; tried twice, on a link each. Raises DeviceError: it goes on."""
        if not self.touches:
            return
        try:
            self._stop()
        except InstrumentError:
            self._border.forget()  # another link may answer
            self._stop()
        self.moves = False

    def _stop(self) -> None:
        self._border.aside("stop", lambda arm: arm.stop())
        self._until_still(STOP_S, aside=True)

    def _texts(self) -> Mapping[str, str]:
        return self._border.call("identity", lambda arm: self._border.texts(arm.identity))

    def _until_still(self, limit_s: float, *, aside: bool = False) -> None:
        end_s = self._clock.now() + limit_s
        while self._point(aside=aside).moving:
            if self._clock.now() > end_s:
                what, hint = "it does not stand", f"STOP IT. {self._border.look}"
                raise DeviceError(self.who, what, seen="moving", hint=hint)
            self._clock.sleep(INTERVAL_S)

    def _point(self, *, aside: bool = False) -> ArmPoint:
        ask = self._border.aside if aside else self._border.call
        return ask("read", lambda arm: self._checked(arm.read()))

    def _checked(self, given: object) -> ArmPoint:
        if not isinstance(given, ArmPoint):
            raise self._border.broken("its reading is no ArmPoint", given)
        if (tip := self._three(given.tip_mm)) is None:
            raise self._border.broken("its tip is no three numbers", given)
        if np.abs(tip).max() > FARTHEST_MM:
            raise self._border.broken("its tip is farther than any arm reaches (mm?)", given)
        axis = None
        if given.axis is not None:
            axis = self._three(given.axis)
            if axis is None or not 0.0 < np.linalg.norm(axis) < np.inf:
                raise self._border.broken("its axis is no direction", given)
        return ArmPoint(tip, axis, self._border.flag(given.moving, "moving"))

    def _three(self, given: object) -> Floats | None:
        """Three finite numbers, whatever they are given as; None for what is none."""
        numbers = np.asarray(given)
        if numbers.shape != (3,) or numbers.dtype.kind == "b":
            return None
        try:
            each = [self._border.number(one, "coordinate") for one in numbers.tolist()]
        except ProtocolError:
            return None
        return np.array(each, dtype=np.float64)
