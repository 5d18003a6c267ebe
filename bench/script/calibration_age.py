"""How old a rig's calibration is and whose cameras it is of: refused before a run, and judged after
it. An emulated rig's cameras are made from its calibration, which can't be too old or of others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import date
from typing import TYPE_CHECKING, Any

from bench.config import ConfigError
from bench.rig.loading import LoadedRig
from bench.scoring.decisions import Decision, decide_condition
from detector.calibration import Calibration, Record
from instruments.errors import LimitError

if TYPE_CHECKING:
    from bench.script.model import CalibrationRequirement, LoadedScript

CALIBRATION_FACT = "calibration record"
AGAIN = "Calibrate again (teatbench calibrate cameras, thermal, world, merge; help calibration)"


def refuse_old_calibration(rig: LoadedRig, script: LoadedScript, today: date) -> None:
    """Raises ConfigError for a calibration too old for the script, of unknown age, or missing."""
    most = script.script.calibration.max_age_days
    if most is None or rig.rig.all_emulated:
        return
    fact = calibration_fact(rig.calibration, today, emulated=False)
    allowed = f"{script.path} allows {most:g} days ([calibration] max_age_days)"
    unknown = f"has no [record] that says when it was made; {allowed}. {AGAIN}."
    if why := unknown if fact["age_days"] is None else _doubt(fact, most, allowed):
        raise ConfigError.plain(f"{rig.calibration_path} {why}")


def not_fresh(rig: LoadedRig, script: LoadedScript, today: date) -> Iterator[str]:
    """Of each requirement that the rig's calibration will not meet: why."""
    fact = calibration_fact(rig.calibration, today, emulated=rig.rig.all_emulated)
    for rule in script.script.requirements:
        if rule.kind == "calibration_fresh" and not fact["emulated"]:
            allowed = f"{script.path} requires {rule.max_age_days:g} days ({rule.name})"
            if why := _doubt(fact, rule.max_age_days, allowed):
                yield f"{rig.calibration_path} {why}"


def _doubt(fact: Mapping[str, Any], most: float, allowed: str) -> str:
    """Why the calibration of ``fact`` is not fresh; "" where it is, or its age is not known."""
    made, age = fact["made"], fact["age_days"]
    if age is not None and age > most:
        return f"was made on {made}, {age} days ago; {allowed}. {AGAIN}."
    if age is not None and age < -1:  # a day's grace: it may be tomorrow already where it was made
        return f"was made on {made}, which is still to come: is this machine's clock right?"
    return ""


def refuse_other_cameras(record: Record | None, identity: Mapping[str, str]) -> None:
    """Raises LimitError for a camera that isn't the one on record, which may have all of its
    ``identity`` or a part, as its serial number.
    """
    for camera, recorded in (record.cameras if record else {}).items():
        seen = identity.get(camera)
        if seen is not None and recorded.strip().lower() not in seen.lower():
            raise LimitError(
                "cameras",
                f"the calibration was made for the {camera} camera {recorded!r}, but the one that"
                f" answers is {seen!r}",
                hint=f"Are cables or cameras changed? Put them back, or: {AGAIN}.",
            )


def calibration_fact(calibration: Calibration, today: date, *, emulated: bool) -> dict[str, Any]:
    """What a run keeps of its calibration's record. ``age_days`` is None where it is not known."""
    record = calibration.record
    return {
        **{key: getattr(record, key, None) for key in ("made", "by", "with_what")},
        "cameras": dict(record.cameras) if record else {},
        "age_days": (today - date.fromisoformat(record.made)).days if record else None,
        "emulated": emulated,
        "states_uncertainty": calibration.covariance is not None,
    }


def decide_calibration(rule: CalibrationRequirement, facts: Mapping[str, Any]) -> Decision:
    """Was the calibration fresh? Not measured where its age isn't known."""
    fact = facts.get(CALIBRATION_FACT)
    said = f"calibration at most {rule.max_age_days:g} days old on the day of the run"
    if fact is not None and fact["emulated"]:
        said = f"{said} (emulated cameras are made from it)"
        return decide_condition(rule.name, said, held=1, of=1)
    if fact is None or fact["age_days"] is None:
        unknown = "Not checked: the calibration has no [record] that says when it was made."
        return replace(decide_condition(rule.name, said, held=0, of=0), sentence=unknown)
    why = _doubt(fact, rule.max_age_days, f"{rule.max_age_days:g} days are allowed")
    decision = decide_condition(rule.name, said, held=int(not why), of=1)
    return replace(decision, sentence=f"The calibration {why}") if why else decision
