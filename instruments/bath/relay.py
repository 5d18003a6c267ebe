"""A pump that a relay switches: another Modbus device than the controller, on the controller's line
or on one of its own.

Where the controller's family has no pump this is the pump, or there is none; nothing here is ever
taken from the controller. On the controller's line it shares its link, for a line has one owner.
That the relay is on does not say that water moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from instruments.bath.errors import BrokenError
from instruments.bath.profile import Profile, RelayProfile
from instruments.bath.register_access import WiredRows, line_to, wire_to
from instruments.bath.transactions import Transactions
from instruments.clock import Clock
from instruments.errors import LimitError
from instruments.tap import Tap

PUMP = "pump"

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PumpAt:
    """Where a pump's relay is and what it is. ``tap`` sees the bytes of its link, where that is its
    own.
    """

    url: str
    profile: RelayProfile
    tap: Tap | None = None


class Relay:
    """The relay of ``pump``, on the link ``wire`` of the controller where that leads to the same
    line. Raises LinkError.
    """

    def __init__(
        self, pump: PumpAt, wire: Transactions, clock: Clock, *, allow_inferred: bool = False
    ) -> None:
        who = f"pump at {pump.url}"
        line = line_to(pump.url, pump.profile, who)
        self.shares = line.url == wire.place
        self._wire = (
            wire if self.shares else wire_to(line, pump.profile, clock, who=who, tap=pump.tap)
        )
        self._rows = WiredRows(
            pump.profile,
            self._wire,
            line.unit_id or 1,
            clock,
            who=who,
            allow_inferred=allow_inferred,
        )

    def get(self) -> float:
        """The code of what the relay is set to."""
        return self._mended(lambda: self._rows.value(self._rows.row(PUMP)))

    def set(self, value: float | str) -> None:
        """Switch it, and see that it stands."""
        row = self._rows.row(PUMP)
        wanted = self._rows.allowed(row, value)
        self._mended(lambda: self._rows.set(row, wanted))

    def is_off(self, value: float | str) -> bool:
        """Whether to set it to ``value`` switches the pump off."""
        return value in ("off", self._rows.row(PUMP).values["off"])

    def close(self) -> None:
        """Close the link where it is its own; the relay stays as it is."""
        if not self.shares:
            self._wire.close()

    def _mended(self, work: Callable[[], T]) -> T:
        """``work``, on a link of its own once more when that breaks; a shared one is mended by the
        controller's driver.
        """
        if self.shares:
            return work()
        if not self._wire.connected:
            self._wire.connect()
        try:
            return work()
        except BrokenError:
            self._wire.connect()
            return work()


def with_pump(profile: Profile, pump: RelayProfile) -> Profile:
    """``profile`` with the pump's row, which is for the relay alone. Raises LimitError where the
    family turns a pump itself.
    """
    if profile.capabilities.pump != "none":
        hint = "Leave pump_url and pump_profile out of the rig file."
        raise LimitError(
            profile.family,
            f"its pump ({profile.capabilities.pump}) is the family's own, and no relay switches it",
            hint=hint,
        )
    capabilities = profile.capabilities.model_copy(update={"pump": "own"})
    row = pump.row(PUMP).model_copy(update={"poll": False})
    return profile.model_copy(update={"capabilities": capabilities, "rows": (*profile.rows, row)})
