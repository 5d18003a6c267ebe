"""Arms by file: the one that ships says what was recorded, any other emulates as well, and a wrong
file says all that is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from instruments.clock import VirtualClock
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.unit import SHIPPED, UnitError, load_unit, shipped_unit
from tests.instruments.microscribe.rigs import UNIT, UP, Hand, Host, Rig

# Made up: six encoders of other resolutions, longer links, and no "Beta".
SIX = """
[names]
product = "MicroScribeX6"
product_id = "MSCR"
model = "LX"
serial_number = "60001"
comment = "Standard"
format = "Format DH0.5"
version = "HCI 2.1"

[maxima]
button_mask = 1
timer = 0x3FFF
analogs = [0, 0, 0, 0, 0, 0, 0, 0]
analog_low_bits = 0
encoders = [0x3FFF, 0x3FFF, 0x3FFF, 0x1FFF, 0x1FFF, 0x0FFF]

[parameters]
alpha = [0, 16384, 0, 16384, -16384, -16384]
a = [0, 1200, 13000, 600, -400, 400]
d = [9000, -900, 0, 11000, 300, -5500]

[peg]
counts = [0, 6238, 13736, 8196, 6386, 100]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_ships() -> None:
    assert [path.stem for path in SHIPPED.glob("*.toml")] == ["40937"]
    assert shipped_unit("40937") == UNIT
    with pytest.raises(FileNotFoundError, match="under the serial number 1; there is 40937"):
        shipped_unit("1")
    with pytest.raises(
        FileNotFoundError, match="no arm ships under the serial number 1; there is 40937"
    ):
        shipped_unit("1")


def test_an_arm_of_six_encoders(tmp_path: Path) -> None:
    host = Host(unit=load_unit(written(tmp_path, SIX)))
    host.session()
    assert host.ask("CB") == "CB 36 30 30 30 31 00"
    assert host.ask("C6").endswith("3F FF 3F FF 3F FF 1F FF 1F FF 0F FF")
    assert host.ask("D3") == "", "without Beta"
    assert host.counts() == (0, 6238, 13736, 8196, 6386, 100)
    host.arm.buttons = 3
    assert host.ask("00") == "80 01", "one pedal"
    host.close()


def test_a_driver_reads_that_arm_where_the_hand_holds_it(
    tmp_path: Path, make: Callable[..., Rig]
) -> None:
    rig = make(load_unit(written(tmp_path, SIX)), accuracy_mm=0.0)
    driver = rig.signed_on()
    for point in ((-200.0, 260.0, 150.0), (300.0, 100.0, 200.0)):
        rig.hand.point = np.array(point)
        reading = driver.read(16)
        assert np.linalg.norm(reading.tip_mm - point) < 0.2
        assert reading.axis @ UP > 0.9995


def test_all_faults_of_a_file_at_once(tmp_path: Path) -> None:
    text = SIX
    for old, new in {
        '"60001"': '"6000é"',
        "button_mask = 1": "button_mask = 200",
        "0x1FFF, 0x0FFF]": "0x1FFF, 0x4000]",
        "d = [9000, -900, 0, 11000, 300, -5500]": "dd = 1",
        "6386, 100]": "6386]",
    }.items():
        assert old in text
        text = text.replace(old, new)
    with pytest.raises(UnitError) as caught:
        load_unit(written(tmp_path, text))
    assert [keys for keys, _ in caught.value.located] == [
        ("names", "serial_number"), ("maxima", "button_mask"), ("maxima", "encoders", 5),
        ("parameters", "d"), ("parameters", "dd"), ("peg", "counts"),
    ]  # fmt: skip
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "arm.toml"))
    for part in (
        "names.serial_number: '6000é' is no name for an arm: ASCII",
        "maxima.button_mask: input should be less than or equal to 127 (found 200)",
        "parameters.d: field required;",
        "parameters.dd: unknown key (found 1)",
    ):
        assert part in message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[names]", "[names", "not TOML: "),
        ("d = [9000", "beta = 3\nd = [9000", 'beta has no meaning without "Beta" in names.comment'),
        (
            "[0x3FFF, 0x3FFF, 0x3FFF, 0x1FFF, 0x1FFF, 0x0FFF]",
            "[0x3FFF, 0x3FFF, 0, 0, 0, 0]",
            "can't be moved in three dimensions",
        ),
        ("counts = [0,", "counts = [16384,", "peg.counts.0: input should be less than 16384"),
        ("counts = [0,", 'counts = ["a",', "peg.counts.0: input should be a valid integer"),
        ("counts = [0,", 'counts = ["0",', "peg.counts.0: input should be a valid integer"),
    ],
)
def test_a_file_that_describes_no_arm(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SIX
    with pytest.raises(UnitError, match=r"arm\.toml: ") as caught:
        load_unit(written(tmp_path, SIX.replace(old, new)))
    assert message in str(caught.value)


def test_an_arm_below_its_table_cannot_be_emulated(tmp_path: Path) -> None:
    text = SIX.replace("d = [9000", "d = [-32768")
    with pytest.raises(ValueError, match="never comes above the table"):
        ArmEmulator(Hand(VirtualClock()), VirtualClock(), unit=load_unit(written(tmp_path, text)))
