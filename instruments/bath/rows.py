"""Which access a device needs: by what its profile speaks."""

from __future__ import annotations

from instruments.bath.access import Access
from instruments.bath.line_access import LineAccess
from instruments.bath.profile import Device, LineProfile, Profile, RegisterProfile, RelayProfile
from instruments.bath.register_access import RegisterAccess
from instruments.clock import Clock
from instruments.tap import Tap

Rows = Access[Device]
Relay = RegisterAccess


def open_rows(
    url: str, profile: Profile, clock: Clock, *, who: str, allow_inferred: bool, tap: Tap | None
) -> Rows:
    """The rows of a controller at ``url``; the link is not opened yet. Raises LinkError."""
    match profile:
        case LineProfile():
            return LineAccess(url, profile, clock, who=who, allow_inferred=allow_inferred, tap=tap)
        case RegisterProfile():
            return RegisterAccess(
                url, profile, clock, who=who, allow_inferred=allow_inferred, tap=tap
            )
    raise TypeError(f"{profile.family} has rows of no known kind")


def open_relay(
    url: str,
    profile: RelayProfile,
    clock: Clock,
    *,
    who: str,
    allow_inferred: bool,
    tap: Tap | None,
    beside: Rows,
) -> RegisterAccess:
    """The rows of a pump's relay: on the link of the controller ``beside`` where that is the
    same line and Modbus too. Raises LinkError.
    """
    return RegisterAccess(
        url,
        profile,
        clock,
        who=who,
        allow_inferred=allow_inferred,
        tap=tap,
        shared=beside.wire if isinstance(beside, RegisterAccess) else None,
    )
