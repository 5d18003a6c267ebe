"""What the heated circuit is made of: volumes, heats, losses and how its controller is tuned. Values only.

Water-bath fact sheet, section 5; a figure that is inferred there is inferred here.
"""

from __future__ import annotations

from dataclasses import dataclass

HEAT_CAPACITY_J_PER_L_K = 0.994 * 4179.0  # water at 33 degC; 12 L give 49.8 kJ/K


@dataclass(frozen=True, slots=True)
class PlantConstants:
    """What the circuit is made of and how its controller is tuned. Defaults: fact sheet, section 5."""

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
    step_s: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.step_s <= 1.0:
            raise ValueError(f"step_s = {self.step_s}: the fastest lag is 6 s, so a step of 0 < step_s <= 1 s is needed")
