"""What a controller family calls its registers: one TOML file a family, read and checked here.

A row is known to the driver and the emulator by its name (``temperature``, ``set_point``, ``run`` ...); a family
that lacks a row lacks the thing. What a code means is a label in the row, so the driver writes ``started`` and
never a number. Pure: it may not know a clock, a socket or a Modbus library.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from instruments.bath.registers import Order
from instruments.bath.rows import Evidence, Row, Strict
from instruments.bath.wiring import FaultsError, ProfileError, RelayProfile, Wiring, load, row_faults

__all__ = [
    "AlarmCode",
    "Capabilities",
    "Identity",
    "OrderFrom",
    "Profile",
    "ProfileError",
    "RelayProfile",
    "load_profile",
    "load_relay",
    "profile_names",
    "relay_names",
]

AlarmCause = Literal["level", "sensor", "over-temperature", "other"]
CommsLoss = Literal["hold", "stop", "safe_setpoint", "unknown"]
SHIPPED = Path(__file__).with_name("profiles")
RELAYS = SHIPPED / "relays"
NEEDED = ("temperature", "set_point", "run")


class Capabilities(Strict):
    """What the family can do. ``pump = "with run"``: it turns while the controller is started, and not alone."""

    pump: Literal["none", "with run", "own"] = "none"
    level: Literal["none", "alarm"] = "none"
    external_sensor: bool = False
    safety_sensor: bool = False


class OrderFrom(Strict):
    """The row that tells the order of bytes, and which code means which; it has an order of its own."""

    row: str
    codes: dict[str, Order]


class AlarmCode(Strict):
    """What a code in a row that tells alarms means; in a word of bits the code is the bit's weight."""

    code: int
    cause: AlarmCause
    text: str
    evidence: Evidence


class Identity(Strict):
    """What ``row`` shows when this is the family: ``equals`` after ``mask``, or anything that ``differs``, or else a known code."""

    row: str
    mask: Annotated[int, Field(ge=1, le=0xFFFFFFFF)] = 0xFFFFFFFF
    equals: int | None = None
    differs: int | None = None
    otherwise: str = ""  # what it is when it is another

    def fits(self, row: Row, value: float) -> bool:
        """Whether a controller that shows ``value`` there may be of the family."""
        if self.equals is not None:
            return int(value) & self.mask == self.equals
        if self.differs is not None:
            return int(value) & self.mask != self.differs
        return row.is_known(value)


class Profile(Wiring):
    """One family of temperature controllers."""

    order_from: OrderFrom | None = None
    comms_loss: CommsLoss
    comms_loss_evidence: Evidence
    plausible_c: tuple[float, float] = (-5.0, 60.0)
    capabilities: Capabilities = Capabilities()
    identity: tuple[Identity, ...] = ()
    before_start: dict[str, str] = Field(default_factory=dict)  # row -> label to be seen before heating, written where it is another
    alarms: tuple[AlarmCode, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> Profile:
        faults = list(_faults(self))
        if faults:
            raise FaultsError(faults)
        return self

    def order_for(self, code: int) -> Order | None:
        """The order that a code of the ``order_from`` row means, or None for a code that means nothing."""
        return self.order_from.codes.get(str(code)) if self.order_from else self.order

    def alarm_text(self, code: int) -> str:
        """What an alarm (``BathReading.alarm``) means, with a word of doubt where that is inferred."""
        known = [alarm for alarm in self.alarms if alarm.code == code]
        if not known and any(row.alarm == "bits" for row in self.rows):
            known = [alarm for alarm in self.alarms if alarm.code & code]
        if not known:
            return f"alarm {code}, see the controller's manual"
        doubt = " (meaning inferred)" if any(alarm.evidence == "INFERRED" for alarm in known) else ""
        return f"alarm {code}, {' and '.join(alarm.text for alarm in known)}{doubt}"


def _faults(profile: Profile) -> Iterator[tuple[str, str]]:
    yield from row_faults(profile)
    names = [row.name for row in profile.rows]
    yield from (("rows", f"the row '{name}' is missing") for name in NEEDED if name not in names)
    yield from _reference_faults(profile)
    for name in {"run", "set_point"} & set(names):
        if profile.row(name).access != "rw":
            yield f"rows.{names.index(name)}.access", f"{name}: the bench has to read and write it, so access must be 'rw'"
    for name in {"unit", profile.order_from.row if profile.order_from else "unit"} & set(names):
        if not profile.row(name).poll:
            yield f"rows.{names.index(name)}", f"{name}: it may be changed at the panel, so it has to be polled"
    pump = profile.find("pump")
    if profile.capabilities.pump == "own" and (pump is None or pump.access != "rw" or not {"on", "off"} <= set(pump.values)):
        yield "capabilities.pump", "an own pump needs a row 'pump' with access 'rw' and the labels 'on' and 'off'"
    run = profile.find("run")
    if run is not None and not {"standby", "started"} <= set(run.values):
        yield f"rows.{names.index('run')}.values", "run: the labels 'standby' and 'started' are needed"


def _reference_faults(profile: Profile) -> Iterator[tuple[str, str]]:
    if profile.order_from and getattr(profile.find(profile.order_from.row), "order", None) is None:
        yield "order_from.row", f"there is no row '{profile.order_from.row}' with an order of its own"
    for at, identity in enumerate(profile.identity):
        if profile.find(identity.row) is None:
            yield f"identity.{at}.row", f"there is no row '{identity.row}'"
    for name, label in profile.before_start.items():
        setting = profile.find(name)
        if setting is None or label not in setting.values or setting.access != "rw":
            yield f"before_start.{name}", f"there is no row '{name}' that may be written with the value '{label}'"


def load_profile(name_or_path: str | Path) -> Profile:
    """A shipped profile by its name (``julabo-presto``), or any profile by its path. Raises ProfileError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = SHIPPED / f"{name_or_path}.toml"
    return load(path, Profile, hint=f"; shipped profiles: {', '.join(profile_names())}")


def load_relay(name_or_path: str | Path) -> RelayProfile:
    """A shipped profile of a pump's relay by its name (``modbus-relay``), or any by its path. Raises ProfileError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = RELAYS / f"{name_or_path}.toml"
    return load(path, RelayProfile, hint=f"; shipped profiles of relays: {', '.join(relay_names())}")


def profile_names() -> list[str]:
    """The names of the shipped profiles."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def relay_names() -> list[str]:
    """The names of the shipped profiles of a pump's relay."""
    return sorted(path.stem for path in RELAYS.glob("*.toml"))
