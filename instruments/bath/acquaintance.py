"""The look at a controller before anything is written to it: is it the family, in degC, in the order of bytes that we think?

Whoever does not fit is refused with what it seems to be. It writes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

from instruments.bath.profile import Identity, Profile
from instruments.bath.reading import BathReading, Poll
from instruments.bath.rows import Row
from instruments.bath.troubles import ILLEGAL_ADDRESS, RefusedError
from instruments.bath.wired import WiredRows
from instruments.errors import DeviceError, ProtocolError

TOLD = ("model", "version", "firmware", "cut_out")
HEXADECIMAL = ("model", "version")


def look(wired: WiredRows, profile: Profile) -> tuple[Poll, BathReading]:
    """How to poll ``wired`` from now on, and its first reading.

    Raises DeviceError when it is another family, is in another unit, or has no temperature, and ProtocolError when what
    it shows makes no sense.
    """
    _learn_order(wired, profile)
    for identity in profile.identity:
        _check(wired, identity)
    try:
        return _first_poll(wired, profile, gaps=True)
    except RefusedError as refused:
        if refused.code != ILLEGAL_ADDRESS:
            raise
        return _first_poll(wired, profile, gaps=False)


def identity_of(wired: WiredRows, url: str) -> Mapping[str, str]:
    """What the controller tells of itself."""
    told = {"family": wired.profile.family, "url": url, "order": wired.order}
    for name in TOLD:
        row = wired.profile.find(name)
        if row is not None and (row.evidence != "INFERRED" or wired.allow_inferred):
            told[name] = _told(row, wired.value(row))
    return told


def _told(row: Row, value: float) -> str:
    return f"{int(value):04X}" if row.name in HEXADECIMAL else f"{value:.10g} {row.unit}".rstrip()


def _learn_order(wired: WiredRows, profile: Profile) -> None:
    source = profile.order_from
    if source is None:
        return
    code = int(wired.value(wired.row(source.row)))
    order = profile.order_for(code)
    if order is None:
        hint = "Is this really the profile's family?"
        raise ProtocolError(wired.who, "its order of bytes is none that the profile knows", asked=source.row, seen=str(code), hint=hint)
    wired.order = order


def _check(wired: WiredRows, identity: Identity) -> None:
    row = wired.row(identity.row)
    hint = f"Is it {identity.otherwise}? " if identity.otherwise else ""
    hint += "Give the rig the profile of the controller that is there."
    try:
        value = wired.value(row)
    except RefusedError as refused:
        if refused.code != ILLEGAL_ADDRESS:
            raise
        what = f"it is no {wired.profile.family}"
        raise DeviceError(wired.who, what, asked=row.name, seen=refused.seen, hint=hint) from refused
    if not identity.fits(row, value):
        seen = f"{value:g} (hexadecimal {int(value) & 0xFFFFFFFF:04X})"
        raise DeviceError(wired.who, f"it is no {wired.profile.family}", asked=row.name, seen=seen, hint=hint)


def _first_poll(wired: WiredRows, profile: Profile, *, gaps: bool) -> tuple[Poll, BathReading]:
    poll = Poll(profile, wired.order, gaps=gaps, inferred=wired.allow_inferred, who=wired.who)
    return poll, wired.poll(poll)
