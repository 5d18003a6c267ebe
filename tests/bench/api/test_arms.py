"""A measuring arm from Python, with a person of the program's own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

import bench
from bench.calibrate.simulated_arm import PLACED
from bench.rig.arm_files import load_verification
from instruments.operators.operator import DONE

PORT = "emulator:"


@dataclass
class Willing:
    """Does whatever it is asked for, and remembers it."""

    asked: list[str] = field(default_factory=list)

    def ask(self, request: Any, check: object = None) -> Any:
        self.asked.append(request.text)
        return DONE


@pytest.mark.slow
def test_an_arm_is_placed_read_and_verified(tmp_path: Path) -> None:
    person, frame, verified = Willing(), tmp_path / "frame.toml", tmp_path / "verified.toml"
    found = bench.touch_frame(PORT, [None, (100.0, 100.0, 0.0)], operator=person)
    assert [*found.residuals_mm] == ["check 1", "check 2"]
    bench.write_arm_file(found, frame)
    seen = bench.read_arm(PORT, frame=frame, homed=True)
    assert seen.world_mm == pytest.approx(PLACED.apply(seen.tip_mm), abs=1.5)
    plan, warned = bench.VerificationPlan(distances=1, touches=5), list[str]()
    arm = bench.verify_arm(PORT, plan, homed=True, operator=person, warn=warned.append)
    assert (arm.verdict, arm.broken) == (bench.Verdict.INCONCLUSIVE, ())
    assert arm.gaps == ("no calibrated length was measured",)
    assert "`length_mm`" in warned[0]
    bench.write_arm_file(arm, verified)
    assert load_verification(verified).location_mm == arm.verification.location_mm
    asked = "\n".join(person.asked)
    for said in ("Was the stylus", "table's origin", "Check point 2"):
        assert said in asked


@pytest.mark.parametrize(
    "wrong", [{"distances": 4}, {"touches": 1}, {"length_mm": 0.0}, {"length_u_mm": -1.0}]
)
def test_a_plan_that_cannot_be_done_is_refused_by_name(wrong: dict[str, Any]) -> None:
    with pytest.raises(bench.ConfigError, match=rf"^{next(iter(wrong))} is "):
        bench.VerificationPlan(**wrong)
