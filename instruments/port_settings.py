"""What a serial port is set to beside its rate. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class PortSettings:
    """``dtr`` and ``rts``: the lines while the port is open; None leaves them to the system, which
    raises both. With ``rs485`` RTS is up while bytes go out, and down while we listen.
    """

    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    bytesize: Literal[7, 8] = 8
    handshake: Literal["none", "rtscts", "xonxoff"] = "none"
    dtr: bool | None = None
    rts: bool | None = None
    rs485: bool = False
