"""A reading of a bath that nothing is wrong with."""

from __future__ import annotations

from instruments.bath.reading import BathReading

CALM = BathReading(
    t_s=0.0,
    temp_c=33.0,
    raw=(1, 2),
    external_c=None,
    power_percent=2.0,
    safety_c=None,
    alarm=0,
    warning=0,
    remote=True,
)
