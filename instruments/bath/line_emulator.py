"""Emulated circulators that speak lines of ASCII, over a plant.

A dialect is written from the maker's manual and not from the profile that the driver uses, so that
the two can't be wrong together. Only a family without a dialect here, a lab's own, is emulated by
its own profile, for a rehearsal: that proves nothing about its commands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar, Literal

from instruments.bath.checksums import checked, summed
from instruments.bath.emulator import LOW_LEVEL, PLANT_FAULTS, RESET, SETTING_FAULTS, Emulator
from instruments.bath.line_dialects import DIALECTS, Dialect
from instruments.bath.profile import WATCHDOG, LineProfile
from instruments.bath.rows import LineRow
from instruments.clock import Clock
from instruments.listener import Connection
from instruments.world.plant import Plant

WIRE_FAULTS = ("silence", "late answer", "garbage", "cut answer", "doubled answer")
SETTINGS = {name: at for name, at in SETTING_FAULTS.items() if name != "word order"}
LINE_FAULTS = (*WIRE_FAULTS, RESET, *SETTINGS, *PLANT_FAULTS, LOW_LEVEL)
RESET_S = 5.0
LONGEST = 256  # bytes of a command, then they are dropped

Damage = Callable[[bytes], bytes]
DAMAGES: Mapping[str, Damage] = {
    "garbage": lambda line: b"\xff" + line,
    "cut answer": lambda line: line[: len(line) // 2],
    "doubled answer": lambda line: line * 2,
}


class LineEmulator(Emulator):
    """Serves ``plant`` as a circulator of ``profile``'s family that speaks lines of ASCII."""

    whose_faults: ClassVar[str] = " of a bath that speaks lines of ASCII"
    known_faults: ClassVar[tuple[str, ...]] = LINE_FAULTS
    settings: ClassVar[Mapping[str, str]] = SETTINGS
    framing: Literal["line"]
    panel: Dialect

    def __init__(self, plant: Plant, profile: LineProfile, clock: Clock) -> None:
        super().__init__(plant, clock, dialect_of(profile)(plant), RESET_S)
        self.framing = "line"
        self.profile = profile
        self._buffers: dict[Connection, bytes] = {}
        self._heard_s = 0.0
        self._looks = False  # whether a look at the watchdog is planned
        plant.fit(circulator=profile.capabilities.pump == "with run")

    def connect(self, connection: Connection) -> None:
        super().connect(connection)
        self._buffers[connection] = b""

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        self._buffers.pop(connection, None)

    def receive(self, connection: Connection, data: bytes) -> None:
        """Answer every command that ``data`` completes."""
        *commands, rest = (self._buffers.get(connection, b"") + data).split(self.panel.end)
        self._buffers[connection] = rest[-LONGEST:]
        for command in commands:
            if self.is_silent:
                continue
            self._heard_s = self._clock.now()
            self.plant.advance_to(self._heard_s)
            how = self.profile.checksum, self.profile.checksum_skip
            said = checked(command.decode("ascii", errors="replace").strip("\r\n"), *how)
            answer = None if said is None else self.panel.answer(said)
            if answer is not None:
                line = summed(answer, *how).encode("ascii") + self.panel.reply_end
                for name, damage in DAMAGES.items():
                    line = damage(line) if name in self._faults else line
                self.send(connection, line)
            self._watch(connection)

    def _watch(self, connection: Connection) -> None:
        """Look again when the panel's watchdog will have run out, if no command comes."""
        if self._looks or not self.panel.watchdog_s:
            return
        self._looks = True

        def look() -> None:
            self._looks = False
            now_s, seconds = self._clock.now(), self.panel.watchdog_s
            if seconds and now_s >= self._heard_s + seconds:
                self.plant.advance_to(now_s)
                self.panel.miss_host()
            else:
                self._watch(connection)

        due_s = self._heard_s + self.panel.watchdog_s - self._clock.now()
        connection.after(max(0.0, due_s), look, when_gone=True)


def dialect_of(profile: LineProfile) -> Callable[[Plant], Dialect]:
    """How the profile's family answers; a family without a dialect answers by its own profile."""
    name = profile.family.lower()
    known = (dialect for begins, dialect in DIALECTS.items() if name.startswith(begins))
    found = next(known, None)
    return found or (lambda plant: ByProfile(plant, profile))


class ByProfile(Dialect):
    """A family without a dialect of its own: it answers as its profile says."""

    def __init__(self, plant: Plant, profile: LineProfile) -> None:
        super().__init__(plant)
        self._profile = profile
        self._memory: dict[str, float] = {}
        self.end = profile.end.encode("ascii")
        self.reply_end = profile.reply_end.encode("ascii")

    def answer(self, command: str) -> str | None:
        # a run that is read off the set point answers after that
        rows = sorted(self._profile.rows, key=lambda row: row.above is not None)
        for row in rows:
            if row.ask and row.ask.lower() == command.lower():
                return self._said(row)
        for row in rows:
            value = _told(row, command)
            if value is not None:
                self._take(row, value)
                confirm = self._profile.confirm if row.confirm is None else row.confirm
                return confirm or None
        refusal = next(iter(self._profile.refusals), None)
        return refusal and refusal.replace("<number>", "1").replace("<text>", "no such command")

    def _said(self, row: LineRow) -> str:
        value = self._value(row)
        for label, forms in row.shows.items():
            if row.codes[label] == value:
                return forms[0].replace("<text>", "OK").replace("<number>", f"{value:g}")
        raw = value / row.scale
        fields = {
            "<number>": f"{raw:.0f}" if row.alarm else row.digits(raw),
            "<hex>": f"{round(raw) & 0xFFFF:04X}",
            "<bits>": f"{int(value):08b}"[::-1],
            "<bytes>": " ".join(map(str, int(value).to_bytes(5, "little"))),
            "<word>": self._profile.family.replace(" ", "_"),
            "<text>": self._profile.family,
        }
        said = row.reply
        for field, text in fields.items():
            said = said.replace(field, text)
        return said

    def _value(self, row: LineRow) -> float:
        plant = self.plant
        alarm = next((a.code for a in self._profile.alarms if a.cause == plant.alarm), None)
        known: dict[str, float] = {
            "temperature": self.temperature_c(),
            "set_point": plant.set_point_c,
            "external": float(plant.teat_c.mean()),
            "safety": plant.bath_c,
            "cut_out": plant.constants.cut_out_c,
            "power": plant.power_percent,
            WATCHDOG: self.watchdog_s,
        }
        if row.name in known:
            return self.shown(known[row.name]) if row.unit == "degC" else known[row.name]
        if row.alarm:
            quiet = 0 if row.alarm == "bits" or not row.quiet else row.quiet[0]
            return quiet if alarm is None else alarm
        labels = {
            "run": "started" if plant.running else "standby",
            "remote": "manual" if self.manual_mode else "remote",
            "unit": "f" if self.fahrenheit else "c",
        }
        label = labels.get(row.name, "")
        if label in row.values:
            return row.values[label]
        first = next(iter(row.values.values()), row.range[0] if row.range else 0.0)
        return self._memory.get(row.name, first)

    def _take(self, row: LineRow, value: float) -> None:
        if row.name == "run":
            self.run(on=value == row.values["started"])
        elif row.name == "set_point":
            self.plant.set_point_c = self.meant_c(value)
            run = self._profile.row("run")
            if run.above is not None:  # it controls always: a set point is its standby
                self.run(on=value > run.above)
        elif row.name == WATCHDOG:
            self.watchdog_s = value
        else:
            self._memory[row.name] = value


def _told(row: LineRow, command: str) -> float | None:
    """The value that ``command`` writes to ``row``; None where it is none of its commands."""
    if not isinstance(row.tell, str):
        words = {command.lower(): label for label, command in row.tell.items()}
        label = words.get(command.lower())
        return None if label is None else float(row.values[label])
    if not row.tell:
        return None
    written = row.model_copy(update={"reply": row.tell, "shows": {}, "absent": ()})
    return written.decode(command) if written.understands(command) else None
