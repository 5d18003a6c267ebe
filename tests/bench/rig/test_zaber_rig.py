"""A rig with a Zaber stage: by its plug-in's URL, and as rig files had it before."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bench.config import ConfigError
from bench.rig.model import StageTable
from bench.rig.practice import served_text
from instruments.world.phantom import PlatePose
from tests.bench.rig.test_emulated_stage import homed, rig_with
from tests.instruments.bath.peers import needed

needed("zaber_motion", "zaber-motion")

PLACES = "reference_mm = [150.0, 137.5]\nreference_a_deg = 90.0\n"
FORMER = """dialect = "zaber"
axes = "XYA"
microsteps = [20000.0, 20000.0, 500.0]
zaber_axes = ["1 1", "2 1", "4 1"]
"""


@pytest.mark.slow
@pytest.mark.parametrize("stage", [FORMER, FORMER.partition("microsteps")[0]])
def test_the_plate_stands_as_its_devices_say(tmp_path: Path, stage: str) -> None:
    rig = rig_with(tmp_path, stage + PLACES)
    assert rig.rig.stage is not None
    with homed(rig) as (twin, driver):
        assert driver.identity.dialect == "zaber"
        driver.move_to(**rig.rig.stage.machine(PlatePose()))
        reference = twin.world.phantom()
        wanted = PlatePose(20.0, -10.0, 0.0, math.radians(30))
        driver.move_to(**rig.rig.stage.machine(wanted))
        assert np.allclose(twin.world.ends_mm(), reference.moved(wanted).ends_mm, atol=0.01)


def test_the_former_table_is_that_url(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, FORMER + PLACES).rig
    assert rig.stage
    assert (
        rig.stage.url
        == "emulator:zaber?devices=1.1,2.1,4.1&microsteps=20000.0,20000.0,500.0&axes=XYA"
    )
    table = {"url": "COM5", "dialect": "zaber", "zaber_axes": ["1 1", "2 1"], "baud": 9600}
    with pytest.raises(ValueError, match="a Zaber stage XY needs 2 devices and 2 microsteps"):
        StageTable.model_validate(table)
    known = StageTable.model_validate(table | {"microsteps": [20997.4, 20997.4]})
    keys = "devices=1.1,2.1&microsteps=20997.4,20997.4&axes=XY&url=COM5&baud=9600"
    assert known.url == f"plugin:zaber?{keys}"
    with pytest.raises(ConfigError, match="axes"):
        rig_with(tmp_path, FORMER.replace("XYA", "XZ"))


def test_a_rig_file_of_served_emulators_names_the_driver_with_its_keys(tmp_path: Path) -> None:
    """It had the port alone, at which another driver was opened."""
    rig = rig_with(tmp_path, FORMER + PLACES)
    ports = dict.fromkeys(("arm", "bath", "stage", "operator", "left", "right", "thermal"), "at")
    text = served_text(rig, ports | {"stage": "socket://127.0.0.1:7004"}, "")
    keys = "devices=1.1,2.1,4.1&microsteps=20000.0,20000.0,500.0&axes=XYA"
    assert f'url = "plugin:zaber?{keys}&url=socket://127.0.0.1:7004"' in text
