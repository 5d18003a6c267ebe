"""What a serial port is set to beside its rate. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal


@dataclass(frozen=True, slots=True)
class PortSettings:
    """``dtr``, ``rts``: the lines while the port is open; None: as the system sets them. With
    ``rs485`` RTS is up while bytes go out.
    """

    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    bytesize: Literal[7, 8] = 8
    handshake: Literal["none", "rtscts", "xonxoff"] = "none"
    dtr: bool | None = None
    rts: bool | None = None
    rs485: bool = False

    @property
    def character_bits(self) -> int:
        """Start, data, parity, stop."""
        return 1 + self.bytesize + (self.parity != "N") + self.stopbits


LINES = {"on": True, "off": False}


def with_lines(url: str, settings: PortSettings) -> tuple[str, PortSettings]:
    """The port, and ``settings`` with the ``?dtr=off&rts=off`` of ``url``. Raises ValueError."""
    place, asked, query = url.partition("?")
    lines: dict[str, bool] = {}
    for pair in query.split("&") if asked else ():
        key, _, word = pair.partition("=")
        if key not in ("dtr", "rts") or word not in LINES or key in lines:
            what = f'"{pair}" is no setting of this port'
            raise ValueError(f'{what}; write "?dtr=off&rts=off", each on or off, and once')
        lines[key] = LINES[word]
    return place, replace(settings, **lines)  # type: ignore[arg-type]
