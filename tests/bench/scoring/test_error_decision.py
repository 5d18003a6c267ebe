"""The decision on the error: its three outcomes, how many poses it asks for, and how often it accepts what it must not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.stats import ncx2

from bench.scoring.decisions import Verdict
from bench.scoring.error_decision import decide_error, worst_per_pose
from bench.scoring.points import Floats
from bench.scoring.tolerance import worst_false_acceptance
from instruments.microscribe.kinematics import JOINTS, RANGES_RAD
from instruments.microscribe.mechanics import KinematicError
from instruments.microscribe.unit import MICROSCRIBE_3DX
from tests.bench.scoring.truths import Truths

MET, NOT_MET, INCONCLUSIVE, NOT_MEASURED = Verdict.MET, Verdict.NOT_MET, Verdict.INCONCLUSIVE, Verdict.NOT_MEASURED
