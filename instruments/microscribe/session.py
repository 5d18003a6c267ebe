"""How a session is opened: find the arm, begin, and read who it is until two readings agree.

IMMC only goes out behind C5, since its letters are commands in a session that was left open; BEGIN
goes out once, after the echo.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import partial

from instruments.errors import InstrumentError, LinkError, ProtocolError
from instruments.microscribe import configuration as conf
from instruments.microscribe import errors
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import DeviceInfo, Identity
from instruments.microscribe.connection import ON_HINT, PAUSE_S, ArmConnection
from instruments.microscribe.errors import NoMicroScribeError, SilentArmError, UnusableArmError
from instruments.microscribe.protocol import Code, Event

SIGN_ON_S = 3.0
# an arm in a session at another rate ends it at the first C5 that it understands
OTHER_RATE_S = 0.5
READINGS = 3  # of what the arm says of itself; two have to agree
_END = bytes([Code.END])
_KNOCK = _END + wire.SYNC
_KEPT = 256


def open_session(
    arm: ArmConnection, rates: Sequence[int], patience_s: float
) -> tuple[DeviceInfo, int]:
    """Find the arm at one of ``rates``, begin, and read who it is; also gives the rate. The first
    rate gets ``patience_s``. A session that was begun is ended when that fails.

    Raises SilentArmError, NoMicroScribeError for another device, UnusableArmError, ProtocolError
    for damage or data that never came alike twice, LinkError.
    """
    arm.lose()
    baud = _find(arm, rates, patience_s)
    try:
        _begin(arm)
        return _read_device_info(arm), baud
    except InstrumentError:
        # the first error tells more than a second one about the same link
        with contextlib.suppress(LinkError):
            arm.end()
        raise


def _find(arm: ArmConnection, rates: Sequence[int], patience_s: float) -> int:
    """Send IMMC until the arm echoes it; the rate that worked, else the link is at the first."""
    start, seen, tried = arm.clock.now(), b"", []
    for baud in rates:
        if not _set_rate(arm, baud):
            continue
        tried.append(baud)
        found, noise = _knock(arm, patience_s if baud == rates[0] else OTHER_RATE_S)
        if found:
            return baud
        seen = (seen + noise)[-_KEPT:]
        if errors.known(noise):
            break
    _set_rate(arm, rates[0])
    at = f" at {' or '.join(map(str, tried))} baud" if len(tried) > 1 else ""
    kind: type[InstrumentError] = SilentArmError
    what, hint = f"nothing answers the sign-on{at}", ON_HINT
    if seen:
        kind, hint = NoMicroScribeError, errors.what_to_try(seen)
        what = f"something answers, but not as a MicroScribe{at}"
    seconds = arm.clock.now() - start
    raise kind(arm.who, what, asked=_KNOCK, seen=seen[-64:], seconds=seconds, hint=hint)


def _set_rate(arm: ArmConnection, baud: int) -> bool:
    """Whether the port can do that rate; few can do 14400 and 28800."""
    with contextlib.suppress(LinkError):
        if arm.link.baud != baud:
            arm.link.set_baud(baud)
    return arm.link.baud == baud


def _knock(arm: ArmConnection, patience_s: float) -> tuple[bool, bytes]:
    """Whether the echo came, and all else that came but the end of an old session. The end is sent
    alone first: were it lost before the first IMMC, the letters would be commands.
    """
    deadline = arm.clock.now() + patience_s
    arm.send(_END, Event.END)
    seen = arm.link.read_until(_END, PAUSE_S)
    while arm.clock.now() < deadline:
        arm.send(_KNOCK, Event.END)
        seen = (seen + arm.link.read_until(wire.SYNC, PAUSE_S))[-_KEPT:]
        if wire.SYNC in seen:
            arm.untidy = True
            # surplus echoes; and nothing from before the session counts as from within it
            arm.tidy()
            arm.state = wire.next_state(arm.state, Event.SYNC)
            return True, b""
    return False, seen.strip(_END)


def _begin(arm: ArmConnection) -> None:
    arm.send(wire.BEGIN, Event.BEGIN)
    seconds = max(SIGN_ON_S, arm.answer_s)
    answer = arm.link.read_until(b"\0", seconds)
    if answer.rstrip(b"\0").endswith(wire.PRODUCT_ID):
        return
    kind: type[InstrumentError] = NoMicroScribeError
    what, hint = "the answer is not that of a MicroScribe", errors.what_to_try(answer)
    if not answer:
        kind, what, hint = SilentArmError, "the arm echoed, then fell silent", ON_HINT
    elif wire.INTERFACE_BOX in answer:
        kind, hint = UnusableArmError, "Connect the MicroScribe's own port"
        what = (
            "this is an Immersion Interface Box, not an arm: its encoder bits mean something else"
        )
    waited_s = None if answer else seconds
    raise kind(arm.who, what, asked=wire.BEGIN, seen=answer, seconds=waited_s, hint=hint)


def _read_device_info(arm: ArmConnection) -> DeviceInfo:
    """The arm's data in the maker's order, read until two readings agree."""
    seen: list[DeviceInfo] = []
    last: ProtocolError | None = None
    for _ in range(READINGS):
        try:
            info = _read_once(arm)
        except ProtocolError as error:
            last = error
            continue
        if info in seen:
            return info
        seen.append(info)
    what = f"what the arm says of itself came differently each of {READINGS} times"
    asked, hint = "names, maxima, parameters", "Check cable and plugs, then sign on again"
    raise last or ProtocolError(arm.who, what, asked=asked, hint=hint)


def _read_once(arm: ArmConnection) -> DeviceInfo:
    names = Identity(
        *(
            arm.ask(code, partial(conf.decode_name, code), timeout_s=SIGN_ON_S)
            for code in conf.NAMES
        )
    )
    maxima = arm.ask(Code.MAXIMA, conf.decode_maxima, timeout_s=SIGN_ON_S)
    if names.format != conf.FORMAT:
        what = (
            f"its parameters are in a format that is not understood: {names.format!r}, not"
            f" {conf.FORMAT!r}"
        )
        hint = "Positions of this arm can't be computed; use another arm"
        raise UnusableArmError(arm.who, what, hint=hint)
    parameters = arm.ask(Code.PARAMETERS, conf.decode_parameters, timeout_s=SIGN_ON_S)
    beta = 0
    if names.has_beta:
        beta = arm.ask(Code.EXTENDED, conf.decode_extended, timeout_s=SIGN_ON_S)
    return DeviceInfo(names, maxima, parameters, beta)
