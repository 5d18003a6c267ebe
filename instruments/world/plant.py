"""The heated circuit: heater, bath, hoses, four teats, sensor and controller, lumped, in fixed time
steps.

Exchanges of heat are booked on both sides, so the balance closes. Each step has its own noise: how
often it is read changes nothing. Float switch and cut-out act in the heater's circuit; a
circulator latches an alarm for them, a controller of its own (``fit``) does not. Users hold the
world's lock.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

HEAT_CAPACITY_J_PER_L_K = 0.994 * 4179.0  # water at 33 degC; 12 L give 49.8 kJ/K


@dataclass(frozen=True, slots=True)
class PlantConstants:
    """Volumes, heats, losses and the controller's tuning."""

    volume_l: float = 12.0
    volume_min_l: float = 9.0  # the float switch; below it heater and pump are cut
    evaporation_g_per_h: float = 26.0
    heater_w: float = 1500.0
    heater_j_per_k: float = 800.0
    heater_film_w_per_k: float = 120.0
    loss_w_per_k: float = 3.0
    pump_w: float = 12.0
    flow_l_per_min: float = 6.0
    hose_l: float = 0.1  # 2 m of 8 mm bore, each way
    hose_loss_w_per_k: float = 0.33
    teat_j_per_k: float = 30.0  # 46 more where 11 mL of water stand in it
    teat_in_w_per_k: float = 1.9
    teat_out_w_per_k: float = 0.046
    sensor_lag_s: float = 6.0
    sensor_noise_k: float = 0.004
    sensor_step_k: float = 0.01
    band_k: float = 1.0
    integral_s: float = 1200.0
    derivative_s: float = 20.0
    output_max: float = 1.0
    ramp_k_per_min: float = 0.0  # 0: the set point jumps
    cut_out_c: float = 40.0  # independent of the controller, latching, set by hand
    step_s: float = 0.5  # the fastest lag is 6 s, so 1 s at most


TEATS = 4
NOISE_BLOCK = 1024
# full output for so long without so much of a rise (fact sheet, 4.1.5)
LOOP_BREAK_S, LOOP_BREAK_K = 120.0, 0.3

Alarm = Literal["", "level", "sensor", "over-temperature"]
Pump = Literal["with run", "on", "off"]


class Plant:
    """The circuit at one moment, from ``start_c``, in a room at ``ambient_c``. Faults and settings
    are attributes; ``loop_broken``: the controller's conclusion of an output without effect.
    """

    def __init__(
        self,
        seed: int,
        *,
        ambient_c: float = 20.0,
        start_c: float = 20.0,
        constants: PlantConstants | None = None,
    ) -> None:
        self.constants = k = constants or PlantConstants()
        self.ambient_c = ambient_c
        self.set_point_c = start_c
        self.running = False
        self.pump: Pump = "with run"
        self.stuck_heater = self.dead_heater = self.stopped_pump = self.broken_sensor = (
            self.frozen_sensor
        ) = False
        self.alarm: Alarm = ""
        self.loop_broken = False
        self.manual_output: float | None = None
        self.ramp_k_per_min = k.ramp_k_per_min
        self.level_l = k.volume_l
        self.bath_c = self.heater_c = self._sensor_c = self.pv_c = start_c
        self.output = 0.0
        self.output_max = k.output_max
        self._steps = 0
        self._teats = [start_c] * TEATS
        self._noise_source = np.random.default_rng(seed)
        self._noise: list[float] = []
        self._integral = self._slope = 0.0
        self._working_c = start_c
        self._latching = True
        self._cut_out = False
        self._full_s, self._full_from_c = 0.0, start_c
        self._supply = deque([start_c])
        self._return = deque([start_c])
        self.set_flow(k.flow_l_per_min)
        self._sensor_follows = 1.0 - math.exp(-k.step_s / k.sensor_lag_s)
        self._slope_follows = (
            1.0 - math.exp(-k.step_s * 8.0 / k.derivative_s) if k.derivative_s else 0.0
        )

    @property
    def t_s(self) -> float:
        """How far the plant has been moved on."""
        return self._steps * self.constants.step_s

    @property
    def teat_c(self) -> NDArray[np.float64]:
        """The teats' metal, (4,)."""
        return np.array(self._teats)

    @property
    def power_percent(self) -> float:
        """The controller's output, 0..100 %; a stuck or dead heater does not show in it."""
        return self.output * 100.0

    @property
    def pump_on(self) -> bool:
        """Whether the water goes round."""
        wanted = self.running if self.pump == "with run" else self.pump == "on"
        return wanted and not (self.stopped_pump or self.level_low or self.alarm == "level")

    @property
    def level_low(self) -> bool:
        """Whether the float switch is open; heater and pump are cut by it."""
        return self.level_l < self.constants.volume_min_l

    @property
    def heat_w(self) -> float:
        """What the heater takes from the mains at this moment."""
        if self.dead_heater or self.level_low or self._cut_out:
            return 0.0
        return self.constants.heater_w * (1.0 if self.stuck_heater else self.output)

    @property
    def controlled_c(self) -> float:
        """The set point that the controller works to at this moment, after the ramp."""
        return self._working_c

    def fit(self, *, circulator: bool) -> None:
        """A circulator, or a controller without a pump, which then stands until it is switched."""
        self.pump = "with run" if circulator else "off"
        self._latching = circulator

    @property
    def rate_k_per_min(self) -> float:
        """How fast the measured value changes, as the controller's filter sees it."""
        return self._slope * 60.0

    def run(self, set_point_c: float) -> None:
        """Controller on, and its pump; integral from zero, ramp from the present temperature."""
        self.set_point_c = set_point_c
        if not self.running:
            self.running = True
            self._integral = self._slope = 0.0
            self._working_c = self.pv_c if self.ramp_k_per_min else set_point_c

    def standby(self) -> None:
        """Controller off, and the pump where it turns with it."""
        self.running = False
        self.output = 0.0

    def be_at(self, temp_c: float) -> None:
        """Have all water be at ``temp_c``, and the teats as they would be long after."""
        k = self.constants
        self.bath_c = self.heater_c = self._sensor_c = self.pv_c = temp_c
        for hose in (self._supply, self._return):
            hose.extend([temp_c] * len(hose))
        share = k.teat_in_w_per_k / (k.teat_in_w_per_k + k.teat_out_w_per_k)
        self._teats = [self.ambient_c + share * (temp_c - self.ambient_c)] * TEATS

    def acknowledge(self) -> None:
        """Clear alarm and cut-out; both return with the next step if their cause remains."""
        self.alarm = ""
        self._cut_out = False

    def fill(self, volume_l: float) -> None:
        """Water of the bath's own temperature, up to ``volume_l``; less lets some out."""
        self.level_l = volume_l

    def set_flow(self, flow_l_per_min: float) -> None:
        """The pump's flow, more than 0. What is in the hoses keeps its mean temperature."""
        k = self.constants
        self.flow_l_per_min = flow_l_per_min
        self._flow_w_per_k = flow_l_per_min / 60.0 * HEAT_CAPACITY_J_PER_L_K
        self._hose_keeps = math.exp(-k.hose_loss_w_per_k / self._flow_w_per_k)
        self._teat_takes = (
            self._flow_w_per_k
            / TEATS
            * (1.0 - math.exp(-k.teat_in_w_per_k * TEATS / self._flow_w_per_k))
        )
        transit = max(1, round(k.hose_l / flow_l_per_min * 60.0 / k.step_s))
        self._supply = deque([sum(self._supply) / len(self._supply)] * transit, transit)
        self._return = deque([sum(self._return) / len(self._return)] * transit, transit)

    def advance_to(self, t_s: float) -> None:
        """Make up whole steps until the next one would pass ``t_s``; nothing for the past."""
        for _ in range(math.floor(t_s / self.constants.step_s + 1e-9) - self._steps):
            self._step()

    def _step(self) -> None:
        k, dt = self.constants, self.constants.step_s
        self._watch()
        stopped = self.alarm if self._latching else self.broken_sensor
        self.output = self._control() if self.running and not stopped else 0.0
        self._watch_loop()
        film_w = k.heater_film_w_per_k * (self.heater_c - self.bath_c)
        into_bath_w = film_w - k.loss_w_per_k * (self.bath_c - self.ambient_c)
        if self.pump_on:
            into_bath_w += k.pump_w - self._flow_w_per_k * (self.bath_c - self._circulate())
        else:
            share = k.teat_out_w_per_k * dt / k.teat_j_per_k
            self._teats = [teat_c - share * (teat_c - self.ambient_c) for teat_c in self._teats]
        self.heater_c += (self.heat_w - film_w) * dt / k.heater_j_per_k
        self.bath_c += into_bath_w * dt / (self.level_l * HEAT_CAPACITY_J_PER_L_K)
        self.level_l = max(0.5, self.level_l - k.evaporation_g_per_h / 994.0 / 3600.0 * dt)
        self._measure()
        self._steps += 1

    def _watch(self) -> None:
        self._cut_out = self._cut_out or self.bath_c >= self.constants.cut_out_c
        if self.alarm and self._latching:
            return
        if self.broken_sensor:
            self.alarm = "sensor"
        elif self.level_low:
            self.alarm = "level"
        else:
            self.alarm = "over-temperature" if self._cut_out else ""

    def _watch_loop(self) -> None:
        full = self.output >= 0.9 * self.output_max > 0.0
        self._full_s = self._full_s + self.constants.step_s if full else 0.0
        if not full or self._full_s >= LOOP_BREAK_S:
            self.loop_broken = full and self.pv_c - self._full_from_c < LOOP_BREAK_K
            self._full_s, self._full_from_c = 0.0, self.pv_c

    def _control(self) -> float:
        """Output 0..1: parallel PID with the derivative on the measured value."""
        k, dt = self.constants, self.constants.step_s
        most, away = self.ramp_k_per_min / 60.0 * dt, self.set_point_c - self._working_c
        ramped = 0.0 < most < abs(away)
        self._working_c = (
            self._working_c + math.copysign(most, away) if ramped else self.set_point_c
        )
        if self.manual_output is not None:
            return min(max(self.manual_output, 0.0), self.output_max)
        error = self._working_c - self.pv_c
        wanted = error / k.band_k + self._integral - k.derivative_s / k.band_k * self._slope
        output = min(max(wanted, 0.0), self.output_max)
        if abs(error) < k.band_k and output == wanted and k.integral_s:
            self._integral += error * dt / (k.band_k * k.integral_s)
        return output

    def _circulate(self) -> float:
        """One step of water through hoses and four teats side by side; the return, degC."""
        k, dt, room = self.constants, self.constants.step_s, self.ambient_c
        supply_c = self._supply[0]
        self._supply.append(room + (self.bath_c - room) * self._hose_keeps)
        given_w = 0.0
        for i, teat_c in enumerate(self._teats):
            taken_w = self._teat_takes * (supply_c - teat_c)
            given_w += taken_w
            self._teats[i] = (
                teat_c + (taken_w - k.teat_out_w_per_k * (teat_c - room)) * dt / k.teat_j_per_k
            )
        back_c = self._return[0]
        left_c = supply_c - given_w / self._flow_w_per_k
        self._return.append(room + (left_c - room) * self._hose_keeps)
        return back_c

    def _measure(self) -> None:
        k = self.constants
        if not self._noise:
            self._noise = (
                self._noise_source.standard_normal(NOISE_BLOCK) * k.sensor_noise_k
            ).tolist()
        self._sensor_c += self._sensor_follows * (self.bath_c - self._sensor_c)
        before, seen_c = self.pv_c, self._sensor_c + self._noise.pop()
        if self.frozen_sensor:
            self._slope = 0.0
            return
        self.pv_c = round(seen_c / k.sensor_step_k) * k.sensor_step_k if k.sensor_step_k else seen_c
        self._slope += self._slope_follows * ((self.pv_c - before) / k.step_s - self._slope)
