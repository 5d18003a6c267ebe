"""Emulated circulators that speak lines of ASCII, over a plant.

A dialect is written from the maker's manual and not from the profile that the driver uses, so that
the two can't be wrong together. A family without a dialect has no emulator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar, Literal

from instruments.bath.checksums import checked, summed
from instruments.bath.emulator import LOW_LEVEL, PLANT_FAULTS, RESET, SETTING_FAULTS, Emulator
from instruments.bath.line_dialects import DIALECTS, Dialect
from instruments.bath.profile import LineProfile
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
    """Serves ``plant`` as a circulator of ``profile``'s family that speaks lines of ASCII. Raises
    ValueError for a family without a dialect.
    """

    whose_faults: ClassVar[str] = " of a bath that speaks lines of ASCII"
    known_faults: ClassVar[tuple[str, ...]] = LINE_FAULTS
    settings: ClassVar[Mapping[str, str]] = SETTINGS
    framing: Literal["line"]
    panel: Dialect

    def __init__(self, plant: Plant, profile: LineProfile, clock: Clock) -> None:
        dialect = dialect_of(profile)
        if dialect is None:
            known = ", ".join(DIALECTS)
            raise ValueError(f"no emulator answers as a {profile.family}; there are {known}")
        super().__init__(plant, clock, dialect(plant), RESET_S)
        self.framing = "line"
        self.profile = profile
        self._buffers: dict[Connection, bytes] = {}
        self._received_s = 0.0
        self._watchdog_planned = False
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
            self._received_s = self._clock.now()
            self.plant.advance_to(self._received_s)
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
        """Plan the end of the panel's watchdog, for the case that no command comes before."""
        if self._watchdog_planned or not self.panel.watchdog_s:
            return
        self._watchdog_planned = True

        def check() -> None:
            self._watchdog_planned = False
            now_s, seconds = self._clock.now(), self.panel.watchdog_s
            if seconds and now_s >= self._received_s + seconds:
                self.plant.advance_to(now_s)
                self.panel.time_out()
            else:
                self._watch(connection)

        due_s = self._received_s + self.panel.watchdog_s - self._clock.now()
        connection.after(max(0.0, due_s), check, when_gone=True)


def dialect_of(profile: LineProfile) -> type[Dialect] | None:
    """How the profile's family answers, where a dialect says so."""
    name = profile.family.lower()
    return next((dialect for begins, dialect in DIALECTS.items() if name.startswith(begins)), None)
