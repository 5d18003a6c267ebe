"""The arm's 14-bit clock, made to go on."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.microscribe.protocol import ArmTime

TICK_S, WRAP = 0.001111, 16384  # of the sheet


def test_a_wrap_is_some_eighteen_seconds() -> None:
    arm = ArmTime()
    assert arm.seconds(16000, 100.0) == 0.0
    assert arm.seconds(16383, 100.4) == pytest.approx(383 * TICK_S)
    assert arm.seconds(0, 100.5) == pytest.approx(384 * TICK_S)
    assert arm.seconds(0, 118.7) == pytest.approx((384 + WRAP) * TICK_S)


def test_a_long_pause_loses_no_wrap() -> None:
    arm = ArmTime()
    arm.seconds(5, 0.0)
    ticks = round(3600.0 / TICK_S)
    assert arm.seconds((5 + ticks) % WRAP, 3600.0) == pytest.approx(3600.0, abs=0.002)


@given(
    st.integers(0, WRAP - 1),
    st.lists(st.tuples(st.integers(0, 200_000), st.floats(0.0, 4.0)), min_size=1, max_size=30),
)
def test_any_steps_add_up_whatever_the_hosts_delays(
    first: int, steps: list[tuple[int, float]]
) -> None:
    arm, made = ArmTime(), 0
    assert arm.seconds(first, 0.0) == 0.0
    for step, late_s in steps:
        made += step
        assert arm.seconds((first + made) % WRAP, made * TICK_S + late_s) == pytest.approx(
            made * TICK_S
        )
