"""Scripts whose gate is as wide as a script may have it."""

from __future__ import annotations

import re

RELAY = 'allow_inferred = true\npump_url = "emulator:"\npump_profile = "modbus-relay"'
WIDEST = """[bath]
set_point_c = 33.0
window_s = 2.0
leave_k = 1.0
mean_k = 1.0
half_range_k = 1.0
slope_k_per_min = 1000000.0
teat_slope_k_per_min = 1000000.0
teat_level_k = 1.5
timeout_s = 1500.0
"""


def wide(text: str) -> str:
    """The script ``text`` with the widest gate and band, and the quickest detector."""
    text = re.sub(r"\[bath\]\n(?:[^\[\n].*\n|\n)*", WIDEST + "\n", text, count=1)
    text = re.sub(r"band_k = .*", "band_k = 1.0", text)
    return re.sub(r"detectors = .*", 'detectors = ["thesis"]', text)
