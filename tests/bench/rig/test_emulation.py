"""One world behind all wires: what the bath heats the camera sees, where the stage stands the
phantom stands.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import numpy as np
import pytest

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, load_rig
from bench.script.phantom import shipped_phantom
from instruments.bath.driver import Bath
from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.operators.operator import Arrangement, Release, Touch
from tests.bench.operated_runs import shipped_rig

pytestmark = pytest.mark.slow

IDEAL = Arrangement("ideal", shipped_phantom("table-5-1"), (), "")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> LoadedRig:
    return load_rig(shipped_rig(tmp_path_factory.mktemp("rig")))


@pytest.fixture
def twin(rig: LoadedRig) -> Iterator[EmulatedRig]:
    with EmulatedRig(rig, VirtualClock(), seed=5) as emulated:
        emulated.operator.ask(IDEAL)
        yield emulated


def test_a_closed_rig_leaves_no_pictures_to_the_garbage_collector(rig: LoadedRig) -> None:
    """A rig lies in reference cycles once it is closed; some hundred runs of a test process would
    hold a hundred renderers.
    """
    gc.disable()
    try:
        with EmulatedRig(rig, VirtualClock(), seed=5) as emulated:
            emulated.operator.ask(IDEAL)
            emulated.cameras.capture()
            held = weakref.ref(emulated.world.renderer)
            eyes = weakref.ref(emulated.world.renderer.thermal)
        del emulated
        assert (held(), eyes()) == (None, None)
    finally:
        gc.enable()


def span_k(twin: EmulatedRig) -> float:
    """How much warmer the warmest part of the thermal picture is than its middle."""
    kelvin = twin.cameras.capture().thermal_k
    assert kelvin is not None
    return float(np.percentile(kelvin, 99) - np.median(kelvin))


def test_the_thermal_camera_follows_the_plant(rig: LoadedRig, twin: EmulatedRig) -> None:
    clock = twin.world.clock
    cold = span_k(twin)
    bath = Bath(twin.urls["bath"], rig.profile, clock)
    bath.start(33.0)
    clock.sleep(1800.0)
    assert bath.read().temp_c == pytest.approx(33.0, abs=0.1)
    warm = span_k(twin)
    bath.standby()
    bath.close()
    clock.sleep(48 * 3600.0)
    after = span_k(twin)
    assert cold < 0.5, "a phantom at room temperature shows nothing but noise"
    assert warm > 8.0
    assert after < 1.0


def test_a_cold_phantom_gives_the_detector_nothing_to_see(twin: EmulatedRig) -> None:
    thermal = twin.cameras.capture().thermal
    assert thermal is not None
    assert thermal.std() < 15, "the gain isn't opened on noise until it fills the range"


def test_the_arm_reads_where_the_hand_holds_it(rig: LoadedRig, twin: EmulatedRig) -> None:
    clock = twin.world.clock
    arm = MicroScribe(Link(twin.urls["arm"], clock, who="arm"), clock)
    arm.sign_on()
    arm.confirm_homed()
    for teat, end in enumerate(twin.world.ends_mm(), 1):
        twin.operator.ask(Touch(teat, 4))
        assert np.linalg.norm(arm.read(8).tip_mm - end) < 1.2
    twin.operator.ask(Release())
    arm.close()


def test_two_captures_differ_by_noise_and_two_worlds_of_one_seed_by_nothing(
    rig: LoadedRig, twin: EmulatedRig
) -> None:
    first, second = twin.cameras.capture(), twin.cameras.capture()
    assert (first.left != second.left).any()
    with EmulatedRig(rig, VirtualClock(), seed=5) as other:
        other.operator.ask(IDEAL)
        again = other.cameras.capture()
    for camera in ("left", "right", "thermal", "thermal_ck"):
        assert np.array_equal(getattr(first, camera), getattr(again, camera))
