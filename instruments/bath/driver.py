"""The bath's driver: a controller of any family with a profile, polled and commanded through plain calls that block.

Nothing is written before the controller has been looked at: order of bytes, unit, a plausible temperature. Every
write is checked against the profile, spaced, done only on change, and read back. Standby alone is always tried. It
is no safety function: when the PC dies, most controllers hold their last set point.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import Literal, TypeVar

from instruments.bath.profile import Profile
from instruments.bath.reading import BathReading, Poll
from instruments.bath.registers import Order
from instruments.bath.rows import Row, Table
from instruments.bath.transactions import ILLEGAL_ADDRESS, BrokenError, RefusedError, Transactions, address
from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError

SAFE_TRIES = 3

T = TypeVar("T")


class Bath:
    """The controller at ``tcp://host[:502][?unit=1]``, connected and identified. May be shared by threads.

    ``identify=False`` puts the look at the controller off to the first call but ``safe``: for whoever cleans up.
    Calls raise LinkError (no answer, in at most 2 s; or the link stayed down), ProtocolError (nonsense),
    DeviceError (refused, or in the wrong state), LimitError (we did not send it). A broken link is mended, and the
    controller looked at anew, within the next call. ``allow_inferred`` lets rows be written whose evidence is
    INFERRED.
    """

    def __init__(self, url: str, profile: Profile, clock: Clock, *, allow_inferred: bool = False, identify: bool = True) -> None:
        self.url = url
        self.profile = profile
        self.who = f"bath at {url}"
        self._clock = clock
        self._allow_inferred = allow_inferred
        self._lock = threading.RLock()
        self._order: Order = profile.order
        self._poll = Poll(profile, self._order, gaps=True, who=self.who)
        self._set_at = -math.inf
        self._identity: dict[str, str] = {}
        host, port, unit_id = address(url, profile.unit_id, self.who)
        if "tcp" not in profile.transports:
            raise LinkError(self.who, f"{profile.family} does not speak Modbus TCP", hint=f"It has: {', '.join(profile.transports)}.")
        self._wire = Transactions(host, port, unit_id, clock, who=self.who)
        self._met = self._started = False
        if identify:
            self._meet()

    @property
    def identity(self) -> Mapping[str, str]:
        """Who answered: family, url, order of bytes, firmware and cut-out temperature where the family tells."""
        return dict(self._identity)

    @property
    def pump(self) -> Literal["none", "with run", "own"]:
        """Whether the family has a pump; ``with run``: it turns while started. Never assumed from the controller."""
        return self.profile.capabilities.pump

    def read(self) -> BathReading:
        """One poll. Raises DeviceError when the controller gives no temperature, ProtocolError when it can't be one."""
        return self._do(self._read)

    def get(self, name: str) -> float:
        """The value of any row of the profile. Raises KeyError for a name that the profile lacks."""
        row = self.profile.row(name)
        return self._do(lambda: self._get(row))

    def set(self, name: str, value: float | str) -> None:
        """Write a row (a number, or one of its labels) where it is another, and see that it stands."""
        row = self.profile.row(name)
        wanted = self._allowed(row, value)
        self._do(lambda: self._set(row, wanted))

    def set_point(self, set_point_c: float) -> None:
        """Change the set point, running or not."""
        self.set("set_point", set_point_c)

    def start(self, set_point_c: float) -> None:
        """Heat to ``set_point_c``: no alarm (level among them), then the set point, then run (fact sheet, 4.1.6).

        With ``pump == "with run"`` the controller starts the pump by itself; any other pump is the caller's to start
        before, and to prove.
        """
        wanted = self._allowed(self.profile.row("set_point"), set_point_c)
        with self._lock:
            reading = self.read()
            if reading.alarm:
                text = self.profile.alarm_text(reading.alarm)
                raise DeviceError(self.who, f"not started: {text}", hint="Clear its cause and the alarm at the controller.")
            for name, label in self.profile.before_start.items():
                self.set(name, label)
            self._do(lambda: self._set(self.profile.row("set_point"), wanted))
            self.set("run", "started")
            self._started = True

    def standby(self) -> None:
        """Heater off, and the pump with it where it turns with run."""
        self._started = False
        self.set("run", "standby")

    def safe(self) -> None:
        """Standby whatever happened before, sent even if it seems to stand by already; tried 3 times.

        Raises the last error when the controller can't be reached or does not obey: then it must be switched off
        by hand.
        """
        with self._lock:
            self._started = False
            run = self.profile.row("run")
            standby = run.encode(run.values["standby"], self._order)
            for tries_left in reversed(range(SAFE_TRIES)):
                if not self._wire.connected:
                    self._met = False
                    self._wire.connect()
                try:
                    self._send(run, standby)  # whoever it is: a wrong unit or an alarm must not keep the heater on
                except InstrumentError:
                    self._wire.close()
                    if not tries_left:
                        raise
                else:
                    return

    def close(self) -> None:
        """Close the link, leaving the controller as it is; once more is no error."""
        with self._lock:
            self._wire.close()

    def _do(self, work: Callable[[], T]) -> T:
        """``work`` on a link that is up; once more over a new link when it breaks."""
        with self._lock:
            if not (self._met and self._wire.connected):
                self._meet()
            try:
                return work()
            except BrokenError:
                self._meet()
                return work()

    def _meet(self) -> None:
        """Connect, and look at who answers before anything is written; the link is closed on whoever does not fit."""
        self._met = False
        if not self._wire.connected:
            self._wire.connect()
        try:
            self._look()
        except BaseException:
            self._wire.close()
            raise
        self._met = True

    def _look(self) -> None:
        self._learn_order()
        unit = self.profile.find("unit")
        if unit is not None and (code := self._get(unit)) != unit.values.get("c"):
            hint = "Set the controller to degrees Celsius."
            raise DeviceError(self.who, "it does not speak degC", asked="its unit", seen=unit.label(code), hint=hint)
        self._poll = Poll(self.profile, self._order, gaps=True, who=self.who)
        try:
            self._read()
        except RefusedError as refused:
            if refused.code != ILLEGAL_ADDRESS:
                raise
            self._poll = Poll(self.profile, self._order, gaps=False, who=self.who)
            self._read()
        self._identity = self._identify()
        run = self.profile.row("run")
        if self._started and self._get(run) != run.values["started"]:
            self._started = False
            raise DeviceError(self.who, "it has stopped by itself: a power cut?", asked="run", seen="standby", hint="Start it anew.")

    def _learn_order(self) -> None:
        source = self.profile.order_from
        if source is None:
            return
        code = int(self._get(self.profile.row(source.row)))
        order = self.profile.order_for(code)
        if order is None:
            hint = "Is this really the profile's family?"
            raise ProtocolError(self.who, "its order of bytes is none that the profile knows", asked=source.row, seen=str(code), hint=hint)
        self._order = order

    def _identify(self) -> dict[str, str]:
        identity = {"family": self.profile.family, "url": self.url, "order": self._order}
        for name in ("firmware", "cut_out"):
            row = self.profile.find(name)
            if row is not None:
                identity[name] = f"{self._get(row):.10g} {row.unit}".rstrip()
        return identity

    def _read(self) -> BathReading:
        answers = [self._fetch(block.table, block.address, block.count) for block in self._poll.blocks]
        return self._poll.reading(self._clock.now(), answers)

    def _get(self, row: Row) -> float:
        return row.decode(self._fetch(row.table, row.address, row.words), self._order)

    def _fetch(self, table: Table, address: int, count: int) -> list[int]:
        if table not in ("holding", "input"):
            raise LimitError(self.who, f"the driver can't read the table {table}")
        return self._wire.read("holding" if table == "holding" else "input", address, count)

    def _allowed(self, row: Row, value: float | str) -> float:
        """The number to write. Raises LimitError when the profile does not allow it."""
        if isinstance(value, str):
            if value not in row.values:
                raise LimitError(self.who, f"{row.name} has no value '{value}'", hint=f"There are: {', '.join(row.values) or 'none'}.")
            value = row.values[value]
        refusal = row.refusal(value)
        if refusal:
            raise LimitError(self.who, f"not written: {refusal}", asked=f"{row.name} = {value:g}")
        if row.evidence == "INFERRED" and not self._allow_inferred:
            hint = "Check it on the controller, then allow inferred rows in the rig file."
            raise LimitError(self.who, f"not written: the profile only infers where {row.name} is", hint=hint)
        return value

    def _set(self, row: Row, value: float) -> None:
        wanted = row.encode(value, self._order)
        if self._words(row) != wanted:
            self._send(row, wanted)

    def _send(self, row: Row, wanted: tuple[int, ...]) -> None:
        """Write ``wanted`` when the last write is long enough ago, and see that it stands."""
        self._clock.sleep(self._set_at + row.spacing_s - self._clock.now())
        single = row.words == 1 and self.profile.write_single == "write single"
        try:
            self._wire.write(row.address, wanted, single=single)
        finally:
            self._set_at = self._clock.now()
        stands = self._words(row)
        if stands != wanted:
            asked, seen = (f"{row.name} = {row.label(row.decode(words, self._order))}" for words in (wanted, stands))
            raise DeviceError(self.who, "it confirmed a write and did not do it", asked=asked, seen=seen, hint=self._remote_hint())

    def _words(self, row: Row) -> tuple[int, ...]:
        return tuple(self._fetch(row.table, row.address, row.words))

    def _remote_hint(self) -> str:
        remote = self.profile.find("remote")
        if remote is None:
            return "Switch it at the controller."
        return f"Its remote control is '{remote.label(self._get(remote))}': set it to Modbus at the controller, or switch it by hand."
