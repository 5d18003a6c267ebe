"""The rig file's `[cameras]`: a table for each camera, or one URL for all; what a frame set must
pass; what the rig's cameras become of it.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from bench.config import Positive, Section
from instruments.camera.frame import Channel, Conversion, Flip, Radiometry, Turn
from instruments.camera.settings import Settings, Trigger, Value

Share = Annotated[float, Field(gt=0, le=1)]
Setting = Literal["resolution", "pixel_format", "exposure", "gain", "fps"]
ALL_AT_ONCE = ("emulator:", "recording:", "opencv:")
GENICAM_ONLY = ("features", "trigger", "trigger_source")


def _all_url(url: str) -> str:
    if url in ("", "emulator:") or re.match(r"(opencv|recording):\S+", url):
        return url
    raise ValueError(
        'not a camera; allowed: "emulator:", "opencv:LEFT,RIGHT,THERMAL" (device numbers, files or'
        ' streams), "recording:FOLDER", or a table for each camera: [cameras.left],'
        " [cameras.right], [cameras.thermal]"
    )


def camera_url(url: str) -> str:
    """``url`` where it is one camera's. Raises ValueError that says what is allowed."""
    if re.match(r"opencv:\S", url) or re.match(r"genicam:", url):
        return url
    raise ValueError(
        'not a camera; allowed: "opencv:0" (a device number, a file, "http://…" or "rtsp://…"'
        ' behind it), "genicam:NAME" (as `teatbench camera list` prints it, a serial number or an'
        " address)"
    )


class OneCamera(Section):
    """One camera: where it is, what it is set to, and how its frames stand."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    url: Annotated[str, AfterValidator(camera_url)]
    resolution: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] | None = None
    pixel_format: str | None = None
    exposure: Positive | None = None
    gain: Annotated[float, Field(allow_inf_nan=False)] | None = None
    fps: Positive | None = None
    trigger: Trigger = "free"
    trigger_source: str = "Line0"
    features: dict[str, Value] = Field(default_factory=dict)
    tries: Annotated[bool | tuple[str, ...], Field(alias="try")] = False
    grey: Channel = "luma"
    mirrored: bool | None = None
    turn_deg: Turn = 0
    flip: Flip = "none"
    white: Annotated[int, Field(gt=0, le=65535)] | None = None

    @field_validator("tries")
    @classmethod
    def _known(cls, tries: bool | tuple[str, ...], info: ValidationInfo) -> bool | tuple[str, ...]:
        known = {*Setting.__args__, *info.data.get("features", {})}  # type: ignore[attr-defined]
        wrong = [name for name in tries if name not in known] if isinstance(tries, tuple) else []
        if wrong:
            raise ValueError(
                f'"{wrong[0]}" is no setting; try = true tries all, or name some of'
                f" {', '.join(sorted(known))}"
            )
        return tries

    @model_validator(mode="after")
    def _fits(self) -> OneCamera:
        given = [
            name
            for name in GENICAM_ONLY
            if getattr(self, name)
            != type(self).model_fields[name].get_default(call_default_factory=True)
        ]
        if given and not self.url.startswith("genicam:"):
            raise ValueError(
                f'{given[0]} is for cameras of the kind "genicam:", this one is {self.url}'
            )
        return self

    @property
    def settings(self) -> Settings:
        """What is asked of the camera."""
        tries = frozenset({"all"} if self.tries is True else self.tries or ())
        asked = {name: getattr(self, name) for name in (*Setting.__args__, *GENICAM_ONLY)}  # type: ignore[attr-defined]
        return Settings(**asked, tries=tries)

    def conversion(self) -> Conversion:
        """What becomes of its frames."""
        return Conversion(self.grey, bool(self.mirrored), self.turn_deg, self.flip, self.white)


class RadiometricTable(Section):
    kelvin_per_count: Positive
    kelvin_at_zero: Annotated[float, Field(ge=-300, le=1000)] = 0.0


class ThermalTable(OneCamera):
    """The thermal camera: 8-bit as it delivers it, or with ``radiometric`` temperatures."""

    polarity: Literal["hot_is_black", "hot_is_white"] | None = None
    radiometric: RadiometricTable | None = None

    def calibrated(self, *, mirrored: bool, hot_is_black: bool) -> Conversion:
        """To the picture as the calibration has it, which its arguments tell, or to temperatures,
        which are never mirrored.
        """
        comes_mirrored = mirrored if self.mirrored is None else self.mirrored
        comes_black = hot_is_black if self.polarity is None else self.polarity == "hot_is_black"
        r = self.radiometric
        return Conversion(
            self.grey,
            comes_mirrored != (mirrored and r is None),
            self.turn_deg,
            self.flip,
            self.white,
            comes_black != hot_is_black,
            Radiometry(r.kelvin_per_count, r.kelvin_at_zero) if r else None,
        )


class FocusTable(Section):
    """Edge blur in px of each camera when it was in focus; `teatbench camera focus` tells it."""

    left: Positive | None = None
    right: Positive | None = None
    thermal: Positive | None = None


class Checks(Section):
    """What a frame set must pass before it is measured with. Levels are 0 to 255."""

    frozen: bool = True
    swapped: bool = True
    black_dn: Annotated[int, Field(ge=0, le=255)] = 12
    saturated_share: Share = 0.25
    missing_rows_share: Share = 0.02
    flat_k: Annotated[float, Field(ge=0, le=50)] = 1.5
    flat_dn: Annotated[int, Field(ge=0, le=255)] = 24
    focus_px: FocusTable = FocusTable()
    focus_times: Annotated[float, Field(gt=1, le=20)] = 2.5


class Cameras(Section):
    url: Annotated[str, AfterValidator(_all_url)] = ""
    left: OneCamera | None = None
    right: OneCamera | None = None
    thermal: ThermalTable | None = None
    settle_s: Annotated[float, Field(ge=0, le=600)] = 1.0
    max_skew_s: Positive = 0.05
    retries: Annotated[int, Field(ge=0, le=100)] = 3
    retry_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    checks: Checks = Checks()

    @model_validator(mode="after")
    def _one_way(self) -> Cameras:
        tables = [name for name, table in self.tables.items() if table is not None]
        if self.url and tables:
            raise ValueError(
                "either url for all cameras or a table for each, not both (here: url and"
                f" [cameras.{tables[0]}])"
            )
        missing = [name for name in ("left", "right") if name not in tables]
        if not self.url and missing:
            raise ValueError(f"no url for all cameras, and no [cameras.{missing[0]}]")
        return self

    @property
    def tables(self) -> dict[str, OneCamera]:
        """Each camera that has a table of its own."""
        return {
            name: table
            for name in ("left", "right", "thermal")
            if (table := getattr(self, name)) is not None
        }

    @property
    def told(self) -> str:
        """Where the cameras are, in one line."""
        return self.url or ", ".join(f"{name} {table.url}" for name, table in self.tables.items())
