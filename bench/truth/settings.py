"""A script's `[truth]`: how the truth of its trials is had, fixed before the run. May not open anything."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from bench.config import Section

FIRST = "first"
Shift = Annotated[float, Field(ge=-2000, le=2000)]


class TruthTable(Section):
    """``touch``: every end in every trial. ``carry``: once, and by the stage from then on, with check touches.

    ``readings`` of each end, None for what the rig says. ``registration`` is a file of 'teatbench calibrate stage' beside the
    script, or "first": made at the start of the run by touches of teat ``registration_teat`` at ``registration_at_mm`` (x, y from the
    reference place; left out, at the corners and the middle of all the script's poses). A check after every ``check_every``
    carried trials (0: only at the end, and before the phantom is rearranged), which may be off by ``check_limit_mm``.
    """

    mode: Literal["touch", "carry"] = "touch"
    readings: Annotated[int, Field(ge=1, le=20)] | None = None
    registration: str = ""
    registration_at_mm: Annotated[tuple[tuple[Shift, Shift], ...], Field(min_length=3)] | None = None
    registration_teat: Annotated[int, Field(ge=1, le=8)] = 1
    check_every: Annotated[int, Field(ge=0, le=100_000)] = 0
    check_limit_mm: Annotated[float, Field(gt=0, le=50)] = 1.5

    @field_validator("registration")
    @classmethod
    def _there(cls, name: str, info: ValidationInfo) -> str:
        folder: Any = (info.context or {}).get("folder")
        if name not in ("", FIRST) and folder is not None and not (Path(folder) / name).is_file():
            raise ValueError(f'no such file beside the script ({Path(folder) / name}); "{FIRST}" makes one at the start of the run')
        return name

    @model_validator(mode="after")
    def _whole(self) -> TruthTable:
        given = self.model_fields_set - {"mode", "readings"}
        if self.mode == "touch" and given:
            raise ValueError(f'{", ".join(sorted(given))}: only for mode = "carry"; here every end is touched in every trial')
        if self.mode == "carry" and not self.registration:
            raise ValueError(f'carry needs a registration: a file of "teatbench calibrate stage", or "{FIRST}"')
        if self.registration != FIRST and self.registration_at_mm:
            raise ValueError(f'registration_at_mm is for registration = "{FIRST}"; the file has its own positions')
        return self

    @property
    def file(self) -> str:
        """The registration's file, beside the script; empty where there is none."""
        return "" if self.registration == FIRST else self.registration
