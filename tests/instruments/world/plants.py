"""Plants to begin with, and how long something takes in them."""

from __future__ import annotations

from collections.abc import Callable

from instruments.world.plant import Plant, PlantConstants

NO_CUT_OUT = PlantConstants(cut_out_c=1000.0)


def settled(seed: int = 1, constants: PlantConstants = NO_CUT_OUT) -> Plant:
    """Held at 33 degC for an hour."""
    plant = Plant(seed, start_c=33.0, constants=constants)
    plant.run(33.0)
    plant.advance_to(3600.0)
    return plant


def seconds_until(plant: Plant, done: Callable[[Plant], bool], at_most_s: float = 3600.0) -> float:
    start = plant.t_s
    while not done(plant):
        plant.advance_to(plant.t_s + plant.constants.step_s)
        assert plant.t_s - start < at_most_s
    return plant.t_s - start
