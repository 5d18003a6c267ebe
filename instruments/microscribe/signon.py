"""Sign-on, step by step: find the arm at whatever rate, begin a session, read who it is.

Order and timing are those of ../shared/instruments/microscribe.md. IMMC never goes out without C5 before it, since in a
session that somebody left alive its letters are commands; BEGIN only once, after the echo. It may not know what a session
is for.
"""

from __future__ import annotations

from collections.abc import Sequence

from instruments.errors import LinkError, ProtocolError
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe import strangers
from instruments.microscribe.configuration import Identity
from instruments.microscribe.conversation import ON_HINT, Conversation
from instruments.microscribe.portrait import Portrait
from instruments.microscribe.protocol import Code, Event
from instruments.microscribe.refusals import InterfaceBoxError, NoMicroScribeError, SilentArmError, UnknownFormatError, UnstableUnitError

SIGN_ON_S = 3.0
OTHER_RATE_S = 0.5  # an arm in a session at another rate ends it at the first C5 that it understands
PAUSE_S = 0.015
READINGS = 3  # of what the arm says of itself; two have to agree
_KNOCK = bytes([Code.END]) + wire.SYNC
_KEPT = 256


def find(talk: Conversation, rates: Sequence[int], patience_s: float) -> int:
    """Knock until the arm echoes; gives back the rate that worked. The first of ``rates`` gets ``patience_s``, the others less.

    Raises SilentArmError when nothing answers, NoMicroScribeError when something else does, LinkError when the link is
    broken. The link is at the first rate again then.
    """
    start, seen, tried = talk.clock.now(), b"", []
    for baud in rates:
        if not _speak_at(talk, baud):
            continue
        tried.append(baud)
        found, noise = _knock(talk, patience_s if baud == rates[0] else OTHER_RATE_S)
        if found:
            return baud
        seen = (seen + noise)[-_KEPT:]
        if strangers.known(noise):
            break
    _speak_at(talk, rates[0])
    raise _nobody(talk, seen, tried, talk.clock.now() - start)


def _speak_at(talk: Conversation, baud: int) -> bool:
    """Whether the port can do that rate; few can do 14400 and 28800."""
    if talk.link.baud == baud:
        return True
    try:
        talk.link.set_baud(baud)
    except LinkError:
        return False
    return True


def _knock(talk: Conversation, patience_s: float) -> tuple[bool, bytes]:
    """Whether the echo came, and all else that came but the end of an old session.

    The end goes out once by itself first: were it lost before the first IMMC, the letters would be commands.
    """
    deadline = talk.clock.now() + patience_s
    talk.send(bytes([Code.END]), Event.END)
    seen = talk.link.read_until(bytes([Code.END]), PAUSE_S)
    while talk.clock.now() < deadline:
        talk.send(_KNOCK, Event.END)
        seen = (seen + talk.link.read_until(wire.SYNC, PAUSE_S))[-_KEPT:]
        if wire.SYNC in seen:
            talk.untidy = True
            talk.tidy()  # surplus echoes; and nothing from before the session counts as from within it
            talk.state = wire.next_state(talk.state, Event.SYNC)
            return True, b""
    return False, seen.strip(bytes([Code.END]))


def _nobody(talk: Conversation, seen: bytes, tried: Sequence[int], seconds: float) -> LinkError | ProtocolError:
    at = f" at {' or '.join(map(str, tried))} baud" if len(tried) > 1 else ""
    if seen:
        what = f"something answers, but not as a MicroScribe{at}"
        return NoMicroScribeError(talk.who, what, asked=_KNOCK, seen=seen[-64:], seconds=seconds, hint=strangers.what_to_try(seen))
    return SilentArmError(talk.who, f"nothing answers the sign-on{at}", asked=_KNOCK, seen=b"", seconds=seconds, hint=ON_HINT)


def begin(talk: Conversation) -> None:
    """Begin the session. Raises InterfaceBoxError, NoMicroScribeError, SilentArmError, or LinkError when the link is broken."""
    talk.send(wire.BEGIN, Event.BEGIN)
    answer = talk.link.read_until(b"\0", SIGN_ON_S)
    if answer.rstrip(b"\0").endswith(wire.PRODUCT_ID):
        return
    if not answer:
        what = "the arm echoed, then fell silent"
        raise SilentArmError(talk.who, what, asked=wire.BEGIN, seen=b"", seconds=SIGN_ON_S, hint=ON_HINT)
    if wire.INTERFACE_BOX in answer:
        what = "this is an Immersion Interface Box, not an arm: its encoder bits mean something else"
        raise InterfaceBoxError(talk.who, what, asked=wire.BEGIN, seen=answer, hint="Connect the MicroScribe's own port")
    what = "the answer is not that of a MicroScribe"
    raise NoMicroScribeError(talk.who, what, asked=wire.BEGIN, seen=answer, hint=strangers.what_to_try(answer))


def read_portrait(talk: Conversation) -> Portrait:
    """Who the arm is, in the maker's order of asking, again and again until two readings agree: replies have no checksum.

    Raises UnknownFormatError, ParameterLengthError, UnstableUnitError, ProtocolError for damage, SilentArmError, LinkError.
    """
    seen: list[Portrait] = []
    last: ProtocolError | None = None
    for _ in range(READINGS):
        try:
            portrait = _read_once(talk)
        except ProtocolError as error:
            last = error
            continue
        if portrait in seen:
            return portrait
        seen.append(portrait)
    what = f"what the arm says of itself came differently each of {READINGS} times"
    raise last or UnstableUnitError(talk.who, what, asked="names, maxima, parameters", hint="Check cable and plugs, then sign on again")


def _read_once(talk: Conversation) -> Portrait:
    identity = Identity(*(_name(talk, code) for code in conf.NAMES))
    maxima = talk.ask(bytes([Code.MAXIMA]), conf.decode_maxima, timeout_s=SIGN_ON_S)
    if identity.format != conf.FORMAT:
        what = f"its parameters are in a format that is not understood: {identity.format!r}, not {conf.FORMAT!r}"
        raise UnknownFormatError(talk.who, what, hint="Positions of this arm can't be computed; use another arm")
    parameters = talk.ask(bytes([Code.PARAMETERS]), conf.decode_parameters, timeout_s=SIGN_ON_S)
    beta = talk.ask(bytes([Code.EXTENDED]), conf.decode_extended, timeout_s=SIGN_ON_S) if identity.has_beta else 0
    return Portrait(identity, maxima, parameters, beta)


def _name(talk: Conversation, code: Code) -> str:
    return talk.ask(bytes([code]), lambda reply: conf.decode_name(code, reply), timeout_s=SIGN_ON_S)
