"""The rig of small cameras, loaded once."""

from __future__ import annotations

import pytest

from bench.rig.loading import LoadedRig, load_rig
from tests.bench.campaign.small_campaign import write_small_rig


@pytest.fixture(scope="session")
def small_rig(tmp_path_factory: pytest.TempPathFactory) -> LoadedRig:
    return load_rig(write_small_rig(tmp_path_factory.mktemp("rig")))
