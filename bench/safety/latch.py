"""What keeps a run from starting: an interlock's latch, and a cut-out that was not tested.

The latch is a file beside the rig file, until a person acknowledges it. It belongs to the bath, not
to a run: another output folder, another script or a restart of the computer doesn't get round it.
An emulated rig has none, for its bath is a new one in each run.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path
from typing import Any

from bench.config import ConfigError, located
from bench.files import write_synced
from bench.rig.loading import AnyRig, LoadedRig, any_rig
from bench.safety.interlocks import InterlockTrip, rule_named
from instruments.bath.reading import BathReading
from instruments.clock import wall_time
from instruments.errors import DeviceError
from textfiles.text import in_command, named

ENDING = ".tripped.json"
STAYS_HOT = ("hold", "unknown")  # kinds of comms_loss


class LatchedError(DeviceError):
    """An interlock has tripped on this rig and was not acknowledged."""


@dataclass(frozen=True, slots=True)
class Latch:
    """What tripped, as the file says."""

    path: Path
    content: Mapping[str, Any]

    @property
    def rule(self) -> str:
        """The rule's name."""
        return str(self.content.get("rule", "unknown"))

    def __str__(self) -> str:
        return (
            f"interlock {self.rule} at {self.content.get('wall_time', 'an unknown time')}:"
            f" {self.content.get('why', 'no reason can be read')}"
        )


def latch_path(rig: LoadedRig) -> Path | None:
    """Where the rig's latch is; None for an emulated rig."""
    return None if rig.rig.simulated else latch_beside(rig.path)


def latch_beside(rig: Path) -> Path:
    """Where the latch of the rig file ``rig`` is."""
    return rig.with_name(rig.stem + ENDING)


def set_latch(path: Path, trip: Exception, run: str) -> None:
    """Keep ``trip`` of the run in folder ``run``. The first one stays. Raises OSError."""
    if path.exists():
        return
    content: dict[str, object] = (
        trip.as_dict()
        if isinstance(trip, InterlockTrip)
        else {"rule": "mistake of the bench", "why": named(trip)}
    )
    content |= {"wall_time": wall_time().isoformat(timespec="seconds"), "run": run}
    write_synced(path, json.dumps(content, indent=1).encode())


def read_latch(path: Path | None) -> Latch | None:
    """The latch at ``path``, None where there is none. A file that can't be read latches too."""
    if path is None or not path.exists():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        content = {"why": f"the file can't be read ({error})"}
    return Latch(path, content if isinstance(content, dict) else {})


def latched(rig: AnyRig) -> Latch | None:
    """The trip that stopped a rig, and waits to be acknowledged."""
    return read_latch(latch_path(any_rig(rig)))


def refuse_latched(rig: LoadedRig) -> None:
    """Raises LatchedError where a trip of this rig has not been acknowledged."""
    latch = read_latch(latch_path(rig))
    if latch is not None:
        then = str(latch.content.get("then", ""))
        hint = f"{then} Then: teatbench bath acknowledge {in_command(rig.path)}".strip()
        raise LatchedError("rig", f"not started: {latch}", hint=hint)


def refuse_untested_cut_out(rig: LoadedRig, today: date) -> None:
    """Raises ConfigError where the bath may stay hot and its cut-out was not tested."""
    loss, tested = rig.profile.comms_loss, rig.rig.bath.cut_out_tested
    why = ""
    if not tested and loss in STAYS_HOT:
        why = (
            "missing: nothing is heated before the bath's independent cut-out was tested, because"
            f' the bath may stay hot when the computer dies (its profile says comms_loss = "{loss}"'
            "). Test it as 'teatbench help safety' says, then write the day:"
            f' cut_out_tested = "{today.isoformat()}"'
        )
    # it may be tomorrow already elsewhere
    elif tested and date.fromisoformat(tested) > today + timedelta(days=1):
        why = "this day is still to come: is this machine's clock right?"
    if why and not rig.rig.bath_emulated:
        raise located(rig.path, rig.text, [(("bath", "cut_out_tested"), why, False)])


def refuse_unknown_unit(rig: LoadedRig, today: date) -> None:
    """Raises ConfigError where nothing states the unit of the bath's numbers, and no person has."""
    if rig.profile.number_unit.known or rig.rig.bath.unit_confirmed or rig.rig.bath_emulated:
        return
    why = (
        f"missing: nothing tells whether the numbers of a {rig.profile.family} are degC, so nothing"
        " is heated before a person has compared them with its display: 'teatbench bath read'"
        f' shows them. Where both agree, write the day: unit_confirmed = "{today.isoformat()}"'
    )
    raise located(rig.path, rig.text, [(("bath", "unit_confirmed"), why, False)])


def unconfirmed(rig: LoadedRig, today: date) -> Iterator[str]:
    """What a person has to look at before a run heats this bath, in the words that refuse one."""
    for refuse in (refuse_untested_cut_out, refuse_unknown_unit):
        try:
            refuse(rig, today)
        except ConfigError as error:
            yield from (fault.message for fault in error.faults)


def acknowledge(rig: LoadedRig, latch: Latch, reading: BathReading) -> None:
    """Remove the latch. Raises LatchedError while the rule's reset condition does not hold."""
    with suppress(KeyError):
        rule = rule_named(latch.rule)
        if not_yet := rule.not_yet(reading, rig.rig.limits):
            asked, hint = f"acknowledge {latch.rule}", f"It resets with: {rule.resets}."
            raise LatchedError("rig", f"not yet: {not_yet}", asked=asked, hint=hint)
    latch.path.unlink()
