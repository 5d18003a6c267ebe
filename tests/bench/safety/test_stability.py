"""The bath's gate: when it opens, when it closes, and that its running figures are those of numpy
on the same window.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.safety.stability import BathState, StabilityGate
from tests.examples import examples

SP = 33.0
HEATING, SETTLING, STABLE = BathState.HEATING, BathState.SETTLING, BathState.STABLE


def feed(
    gate: StabilityGate, temps: list[float], start_s: float = 0.0, step_s: float = 1.0
) -> list[BathState]:
    return [gate.add(start_s + k * step_s, t) for k, t in enumerate(temps)]


def quiet(n: int, offset_k: float = 0.0, amplitude_k: float = 0.01, seed: int = 0) -> list[float]:
    """A controlled bath: noise of a 0.01 K step about the set point."""
    noise = np.random.default_rng(seed).integers(-1, 2, n) * amplitude_k
    return [float(v) for v in np.round(SP + offset_k + noise, 4)]


def stable_gate() -> StabilityGate:
    gate = StabilityGate(SP)
    assert feed(gate, quiet(601))[-1] is STABLE
    return gate


def test_a_quiet_bath_is_stable_when_the_window_is_full_and_not_before() -> None:
    states = feed(StabilityGate(SP), quiet(700))
    assert set(states[:600]) == {SETTLING}
    assert set(states[600:]) == {STABLE}  # the reading at 600 s spans the 10 min


def test_a_bath_that_heats_up_goes_through_all_three_states() -> None:
    ramp = [float(v) for v in np.linspace(20, 33, 400, endpoint=False)]
    states = feed(StabilityGate(SP), ramp + quiet(1100))
    changes = [s for s, after in pairwise([*states, None]) if s is not after]
    assert changes == [HEATING, SETTLING, STABLE]
    assert states.index(STABLE) >= 400 + 590  # the ramp has to leave the window first


def test_what_is_waited_for_is_reported_by_the_readings_near_the_set_point() -> None:
    """The way there fills the window too, and has a slope and a range that say nothing of how
    steady the bath is now.
    """
    gate = StabilityGate(SP)
    feed(gate, [float(v) for v in np.linspace(20, 32.8, 1500)])
    assert gate.reasons == ["32.80 degC, needs 33 ± 0.15"]
    assert gate.at_least_s == gate.window_s
    feed(gate, [SP - 0.05 + 0.02 / 60 * k for k in range(261)], start_s=1500.0)
    assert gate.reasons == ["stable for 4 of 10 min", "slope +0.020 K/min, needs 0.01"]
    assert gate.near.span_s == 260.0
    assert gate.at_least_s == 340.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("temps", "reason"),
    [
        (quiet(2000, offset_k=0.12), "mean +0.1"),
        (
            [SP + 0.06 * (-1) ** (k // 30) for k in range(2000)],
            "half the range 0.060 K, needs 0.05",
        ),
        ([SP - 0.04 + 0.011 / 60 * k for k in range(700)], "slope +0.011 K/min, needs 0.01"),
    ],
)
def test_each_criterion_alone_keeps_the_gate_shut(temps: list[float], reason: str) -> None:
    gate = StabilityGate(SP, half_range_k=0.07 if "slope" in reason else 0.05)
    assert STABLE not in feed(gate, temps)
    assert len(gate.reasons) == 1
    assert gate.reasons[0].startswith(reason)


def test_just_within_each_criterion_it_opens() -> None:
    assert feed(StabilityGate(SP), quiet(601, offset_k=0.08))[-1] is STABLE
    square = [SP + 0.04 * (-1) ** (k // 30) for k in range(601)]
    assert feed(StabilityGate(SP), square)[-1] is STABLE
    assert feed(StabilityGate(SP), [SP - 0.04 + 0.0075 / 60 * k for k in range(601)])[-1] is STABLE


def test_hysteresis_holds_it_until_the_leaving_limit() -> None:
    gate = stable_gate()
    assert feed(gate, [SP + 0.14] * 5, start_s=601) == [STABLE] * 5
    assert gate.reasons  # the window no longer fulfils the gate, and the report says so
    assert gate.add(606, SP + 0.16) is HEATING
    assert gate.add(607, SP) is SETTLING
    assert stable_gate().add(601, SP - 0.16) is HEATING


def test_after_leaving_the_whole_window_has_to_be_quiet_again() -> None:
    gate = stable_gate()
    gate.add(601, SP + 0.2)
    states = feed(gate, quiet(700, seed=1), start_s=602)
    # at 1201 s the window still begins with the excursion at 601 s
    assert states.index(STABLE) == 600
    assert set(states[:600]) == {SETTLING}


def test_an_alarm_throws_away_the_evidence() -> None:
    gate = stable_gate()
    assert gate.add(601, SP, alarm=True) is SETTLING
    assert gate.reasons == ["the bath has an alarm"]
    states = feed(gate, quiet(700, seed=2), start_s=602)
    assert states.index(STABLE) == 600


def test_a_gap_throws_away_the_evidence() -> None:
    gate = stable_gate()
    assert gate.add(605, SP + 0.01) is STABLE  # 5 s are allowed
    assert gate.add(610.5, SP) is SETTLING
    assert len(gate.window) == 1


class TestFrozenReading:
    def test_a_dead_controller_at_the_set_point_is_never_stable(self) -> None:
        gate = StabilityGate(SP)
        assert STABLE not in feed(gate, [SP] * 3000)
        assert gate.frozen
        assert "does the controller still run?" in gate.reasons[0]

    def test_a_bath_that_freezes_while_stable_leaves(self) -> None:
        gate = stable_gate()
        states = feed(gate, [SP + 0.005] * 400, start_s=601)
        assert states[:301] == [STABLE] * 301
        assert set(states[301:]) == {SETTLING}

    def test_a_value_held_for_a_while_is_no_dead_controller(self) -> None:
        held = [SP + 0.01 * (k // 200 % 2) for k in range(900)]
        assert feed(StabilityGate(SP), held)[-1] is STABLE

    def test_too_few_distinct_readings(self) -> None:
        gate, still = (StabilityGate(SP, window_s=60, min_distinct=4) for _ in range(2))
        feed(still, [SP] * 90)
        assert "1 distinct reading, needs 4" in still.reasons[0]
        assert STABLE not in feed(gate, quiet(200))  # three values: -1, 0, +1 steps
        assert "3 distinct readings, needs 4" in gate.reasons[0]

    def test_a_moving_heartbeat_in_the_raw_reading_keeps_a_steady_bath_alive(self) -> None:
        gate = StabilityGate(SP)
        assert [gate.add(float(t), SP, raw=(3300, t // 10)) for t in range(700)][-1] is STABLE

    def test_a_raw_reading_that_stands_still_is_not_saved_by_a_moving_temperature(self) -> None:
        gate = StabilityGate(SP)
        assert STABLE not in [
            gate.add(float(t), temp, raw=3300) for t, temp in enumerate(quiet(1500))
        ]


REST_C = 32.68  # of teats in a bath of 33 degC, with the room at 20


class TestTeats:
    """The sensor at the teats, where there is one, has a level and a slope of its own."""

    @pytest.mark.parametrize(
        ("k_per_min", "state"), [(0.018, STABLE), (0.022, SETTLING), (-0.022, SETTLING)]
    )
    def test_teats_that_still_warm_up_keep_the_gate_shut(
        self, k_per_min: float, state: BathState
    ) -> None:
        gate = StabilityGate(SP)
        for t, temp in enumerate(quiet(700)):
            gate.add(float(t), temp, teat_c=REST_C + k_per_min * t / 60)
        assert gate.state is state
        assert (gate.reasons == []) is (state is STABLE)
        if state is SETTLING:
            assert gate.reasons == [f"slope at the teats {k_per_min:+.3f} K/min, needs 0.02"]

    @pytest.mark.parametrize("teat_c", [20.05, 31.9, 34.1])
    def test_teats_off_their_level_keep_it_shut_however_steady(self, teat_c: float) -> None:
        gate = StabilityGate(SP, window_s=2.0, slope_k_per_min=1e6, teat_slope_k_per_min=1e6)
        for t, temp in enumerate(quiet(700)):
            assert gate.add(float(t), temp, teat_c=teat_c) is not STABLE
        assert gate.reasons == [
            f"the teats are {teat_c - SP:+.2f} K from the set point, needs ± 1: does the pump turn?"
        ]

    def test_teats_that_leave_their_level_close_it(self) -> None:
        gate = StabilityGate(SP)
        states = [
            gate.add(float(t), temp, teat_c=REST_C - 0.02 * max(0, t - 650))
            for t, temp in enumerate(quiet(800))
        ]
        assert set(states[601:690]) == {STABLE}
        off = next(t for t in range(650, 800) if states[t] is SETTLING)
        assert 0.02 * (off - 650) == pytest.approx(1.15 - 0.32, abs=0.021)
        assert set(states[off:]) == {SETTLING}

    def test_they_have_to_be_on_their_level_for_the_whole_window_again(self) -> None:
        gate = StabilityGate(SP)
        states = [
            gate.add(float(t), temp, teat_c=25.0 if 650 <= t < 660 else REST_C)
            for t, temp in enumerate(quiet(1400))
        ]
        assert states[650] is SETTLING
        assert states.index(STABLE, 650) == 660 + 600

    def test_a_sensor_that_has_gone_closes_it(self) -> None:
        gate = StabilityGate(SP)
        states = [
            gate.add(float(t), temp, teat_c=REST_C if t < 650 else None)
            for t, temp in enumerate(quiet(700))
        ]
        assert states[654] is STABLE, "one reading may fail"
        assert set(states[655:]) == {SETTLING}
        assert "no value any more" in gate.reasons[0]
        gate.restart()
        assert STABLE not in [gate.add(float(t), temp) for t, temp in enumerate(quiet(700))]

    @pytest.mark.slow
    @settings(max_examples=examples(15), deadline=None)
    @given(
        st.floats(1.0, 600.0),
        st.floats(0.01, 1.0),
        st.floats(0.01, 1.5),
        st.floats(15.0, 31.0),
        st.floats(-0.02, 0.02),
    )
    def test_no_script_opens_it_on_cold_teats(
        self, window_s: float, leave_k: float, level_k: float, teat_c: float, drift: float
    ) -> None:
        gate = StabilityGate(
            SP, window_s, leave_k, leave_k, 1e9, 1e9, teat_level_k=level_k, leave_k=leave_k
        )
        states = [
            gate.add(float(t), temp, teat_c=min(teat_c + drift * t, 31.4))
            for t, temp in enumerate(quiet(700))
        ]
        assert STABLE not in states


def test_a_new_set_point_restarts_and_the_same_does_not() -> None:
    gate = stable_gate()
    gate.change_set_point(SP)
    assert gate.state is STABLE
    gate.change_set_point(32.0)
    assert (gate.state, len(gate.window), gate.set_point_c) == (HEATING, 0, 32.0)
    assert gate.add(0.0, 32.0) is SETTLING  # time may start again too


STEPS = st.lists(
    st.tuples(st.sampled_from([0.1, 0.5, 1.0, 2.5, 5.0]), st.integers(-300, 300)),
    min_size=2,
    max_size=250,
)


@pytest.mark.slow
@settings(max_examples=examples(40), deadline=None)
@given(STEPS, st.sampled_from([2.0, 10.0, 60.0]), st.sampled_from([0.0, 1e6]))
def test_the_running_figures_are_those_of_numpy(
    steps: list[tuple[float, int]], window_s: float, start_s: float
) -> None:
    gate = StabilityGate(SP, window_s=window_s, frozen_s=1e9)
    times = start_s + np.cumsum([dt for dt, _ in steps])
    temps = np.array([SP + k / 1000 for _, k in steps])
    for t, temp in zip(times.tolist(), temps.tolist(), strict=True):
        gate.add(t, temp)
    after = np.flatnonzero(times[-1] - times >= window_s - 1e-6)
    t, y = times[after[-1] if len(after) else 0 :], temps[after[-1] if len(after) else 0 :]
    window = gate.window
    assert len(window) == len(t)
    assert SP + window.mean == pytest.approx(y.mean(), abs=1e-9)
    assert window.half_range == pytest.approx((y.max() - y.min()) / 2, abs=1e-12)
    assert window.distinct == len(set(y.tolist()))
    if len(t) > 1:
        x = t - t[0] - (t - t[0]).mean()
        slope = float((x * (y - y.mean())).sum() / (x * x).sum())
        assert window.slope == pytest.approx(slope, abs=1e-6 / 60)


def test_bad_readings_are_refused() -> None:
    gate = StabilityGate(SP)
    gate.add(1.0, SP)
    with pytest.raises(ValueError, match="time has to advance"):
        gate.add(1.0, SP)
    with pytest.raises(ValueError, match="nan degC at 2"):
        gate.add(2.0, float("nan"))
    with pytest.raises(ValueError, match="set point nan"):
        StabilityGate(float("nan"))
