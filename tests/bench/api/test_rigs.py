"""A rig from Python, as docs/api.md has it; wrong steps."""

import numpy as np
import pytest

import bench
from instruments.errors import LimitError


def test_an_end_needs_a_place_and_a_number_and_safe_ends_the_watch() -> None:
    with bench.open_rig("emulated") as rig:
        rig.home()
        rig.set_up(bench.member("ideal", 3))
        with pytest.raises(LimitError, match=r"where the plate stands.*Call move\(\)"):
            rig.touch(1)
        rig.heat(33.0, wait=False)
        rig.wait(10.0)
        rig.safe(keep_arm=True)
        rig.wait(5.0)
        rig.move(3.0)
        for teat in (-1, 0, 5):
            with pytest.raises(LimitError, match=f"no teat {teat}: the phantom has 4, from 1"):
                rig.touch(teat)
        (end,), exact = rig.touch(4), rig.truth()[3]
        assert np.linalg.norm(np.subtract(end.xyz_mm, exact.xyz_mm)) < 2.0
