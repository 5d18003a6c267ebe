"""One world behind all wires: what the bath heats the camera sees, where the stage stands the
phantom stands.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, load_rig
from bench.script.phantom import shipped_phantom
from instruments.clock import VirtualClock
from instruments.operators.operator import Arrangement
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


def test_a_cold_phantom_gives_the_detector_nothing_to_see(twin: EmulatedRig) -> None:
    thermal = twin.cameras.capture().thermal
    assert thermal is not None
    assert thermal.std() < 15, "the gain isn't opened on noise until it fills the range"
