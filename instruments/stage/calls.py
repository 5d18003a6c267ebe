"""The calls of an open stage, the same for every driver; and what all drivers do alike: identity,
travel, moves to a place and by so much.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from instruments.errors import LimitError
from instruments.stage.protocol import AXES, Status
from instruments.stage.settings import AxisLimits, StageIdentity, StageSettings, Target, declared


class Stage(ABC):
    """The stage of ``axes`` at ``url``, in machine coordinates: mm by axis letter, degrees for A.
    ``before_moving`` is called before anything is sent that moves it; what it raises keeps that
    from being sent. ``moves``: by a call of ours, and it was not read back at rest since. Any
    thread may call `brake` and `stands`.
    """

    def __init__(self, url: str, who: str, axes: str) -> None:
        self.url, self.who, self.axes = url, who, axes
        self.before_moving: Callable[[], None] = lambda: None
        self.moves = False
        self._identified: tuple[StageIdentity, StageSettings] | None = None

    @property
    def identity(self) -> StageIdentity:
        """Who answered ``connect``. Raises LimitError before."""
        return self._known[0]

    @property
    def settings(self) -> StageSettings:
        """The controller's settings as ``connect`` read them. Raises LimitError before."""
        return self._known[1]

    @property
    def _known(self) -> tuple[StageIdentity, StageSettings]:
        if self._identified is None:
            raise LimitError(self.who, "not connected yet", hint="Call connect().")
        return self._identified

    @property
    def limits(self) -> dict[str, AxisLimits]:
        """Travel by axis letter: mm, or degrees for A. Raises LimitError before ``connect``."""
        return {axis: limits for axis, limits in self.settings.limits.items() if axis in self.axes}

    def move_to(
        self,
        x_mm: float,
        y_mm: float,
        *,
        z_mm: float | None = None,
        a_deg: float | None = None,
        feed_mm_min: float | None = None,
    ) -> None:
        """Move and wait until the stage stands at the target, as read back. Raises LimitError
        before homing, outside the travel or unless idle, DeviceError when it ends elsewhere.
        """
        self.begin_move(x_mm, y_mm, z_mm=z_mm, a_deg=a_deg, feed_mm_min=feed_mm_min)
        self.finish_move()

    def begin_move(
        self,
        x_mm: float,
        y_mm: float,
        *,
        z_mm: float | None = None,
        a_deg: float | None = None,
        feed_mm_min: float | None = None,
    ) -> None:
        """Start what ``finish_move`` waits for. Raises as ``move_to``."""
        wanted = {"X": x_mm, "Y": y_mm, "Z": z_mm, "A": a_deg}
        self._begin_move(declared(wanted, self.axes, who=self.who), feed_mm_min)

    def jog(
        self,
        *,
        x_mm: float = 0.0,
        y_mm: float = 0.0,
        z_mm: float = 0.0,
        a_deg: float = 0.0,
        feed_mm_min: float | None = None,
    ) -> None:
        """Start a relative move for ``finish_move`` or ``cancel_jog``. Raises as ``move_to``."""
        wanted = {"X": x_mm or None, "Y": y_mm or None, "Z": z_mm or None, "A": a_deg or None}
        way = declared(wanted, self.axes, who=self.who)
        if not way:
            raise LimitError(self.who, "a jog without a distance", hint="Give a way along an axis.")
        self._begin_jog(way, feed_mm_min)

    @property
    @abstractmethod
    def safe_state(self) -> str: ...
    @property
    @abstractmethod
    def homed(self) -> bool: ...
    @abstractmethod
    def connect(self) -> StageIdentity: ...
    @abstractmethod
    def reconnect(self) -> StageIdentity: ...
    @abstractmethod
    def recover(self) -> None: ...
    @abstractmethod
    def home(self) -> None: ...
    @abstractmethod
    def position(self) -> NDArray[np.float64]: ...
    @abstractmethod
    def status(self) -> Status: ...
    @abstractmethod
    def finish_move(self) -> None: ...
    @abstractmethod
    def cancel_jog(self) -> None: ...
    @abstractmethod
    def brake(self) -> None: ...
    @abstractmethod
    def stands(self) -> Status | None: ...
    @abstractmethod
    def stop(self) -> None: ...
    @abstractmethod
    def close(self) -> None: ...
    @abstractmethod
    def _begin_move(self, target: Target, feed_mm_min: float | None) -> None: ...

    @abstractmethod
    def _begin_jog(self, way: Target, feed_mm_min: float | None) -> None: ...

    def safe(self) -> None:
        """As ``stop``."""
        self.stop()

    @property
    def _letters(self) -> str:
        """In the order of places, which have Z whether it is declared or not."""
        return AXES if "A" in self.axes else AXES[:3]

    def _begin_moving(self) -> None:
        """From now on the stage may move by a call of ours."""
        self.before_moving()
        self.moves = True
