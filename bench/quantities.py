"""Numbers as the files that people write take them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Millimetres = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Point = tuple[Millimetres, Millimetres, Millimetres]
Radians = Annotated[float, Field(ge=-7, le=7, allow_inf_nan=False)]
