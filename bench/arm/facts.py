"""What a run writes down about its arm: where it stands on the table, and how it was verified, as the rig's files say."""

from __future__ import annotations

from bench.arm.decision import VERIFICATION_FACT
from bench.arm.verification import as_dict
from bench.rig import LoadedRig
from bench.store import Store

FRAME_FACT = "arm frame"


def write_arm_facts(store: Store, rig: LoadedRig) -> None:
    """The rig's table frame and verification, where it names them, into the run's store."""
    if rig.frame is not None:
        frame = rig.frame
        figures = {"residual_mm": frame.residual_mm, "residuals_mm": frame.residuals_mm}
        where = {"om": frame.world_from_arm.om.tolist(), "T": frame.world_from_arm.T.tolist()}
        head = {"file": rig.rig.arm.frame, "made": frame.made.isoformat(), "serial_number": frame.serial_number}
        store.fact(FRAME_FACT, {**head, **figures, **where})
    if rig.verification is not None:
        store.fact(VERIFICATION_FACT, as_dict(rig.verification))
