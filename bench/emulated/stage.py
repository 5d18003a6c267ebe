"""What a rig file says of the emulated stage: its firmware and its errors. Values only; a real rig has no use for it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from bench.config import Section

_Scale = Annotated[float, Field(ge=-0.1, le=0.1)]
_Angle = Annotated[float, Field(ge=-0.2, le=0.2)]
_Setting = Annotated[float, Field(ge=0, le=1e6)]
_Play = Annotated[float, Field(ge=0, le=5)]


class EmulatedStage(Section):
    """``[emulation.stage]``. Axes in the order X Y Z A; an axis that the stage doesn't have moves nothing.

    ``settings`` are the controller's, by number without the dollar sign; those that aren't named are as `store.DEFAULTS` has them.
    """

    dialect: Literal["grbl", "grblHAL"] = "grbl"
    settings: dict[int, _Setting] = Field(default_factory=dict)
    scale_errors: tuple[_Scale, _Scale, _Scale, _Scale] = (0.0, 0.0, 0.0, 0.0)
    squareness_rad: _Angle = 0.0
    yaw_rad: _Angle = 0.0
    backlash_mm: tuple[_Play, _Play, _Play] = (0.0, 0.0, 0.0)
    backlash_deg: _Play = 0.0

    def fault(self, axes: str) -> str | None:
        """What is wrong with it for a stage of ``axes``, as a sentence; None if nothing."""
        if "A" in axes and self.dialect == "grbl":
            return 'the firmware "grbl" has no axis A: set dialect = "grblHAL", or declare [stage] axes without A'
        return self._settings_fault(axes) if self.settings else None

    def _settings_fault(self, axes: str) -> str | None:
        from instruments.stage.emulator.dialect import CLASSIC, GRBL_HAL  # a real rig needs no emulator
        from instruments.stage.emulator.store import Store

        try:
            Store(self.settings, dialect=GRBL_HAL if self.dialect == "grblHAL" else CLASSIC, axes=4 if "A" in axes else 3)
        except ValueError as error:
            return f"[emulation.stage] settings: {error}"
        return None
