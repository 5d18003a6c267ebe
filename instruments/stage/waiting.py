"""Waiting for the stage: until it has arrived, until it stands, and what is left when it doesn't stop.

Asks for a report five times a second, as the firmware's documents want it. It may not know targets or homing; what it finds
wrong it raises.
"""

from __future__ import annotations

from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LinkError
from instruments.stage.dialogue import ANSWER_S, Dialogue
from instruments.stage.protocol import Status

POLL_S = 0.2  # the firmware asks for no more than 5 queries a second
STOP_S = 10.0  # braking takes a second at most; more means that the stage doesn't obey
MOVING = frozenset({"Run", "Jog", "Home"})
_STILL = frozenset({"Idle", "Alarm", "Sleep", "Check", "Hold:0", "Door:0", "Door:1"})  # states, or states with a substate


def is_still(status: Status) -> bool:
    """Whether a report says that nothing moves."""
    return status.state in _STILL or status.name in _STILL


def until_over(talk: Dialogue, clock: Clock, deadline_s: float, allowed_s: float) -> Status:
    """The report of an idle stage, once all that was planned has been done. Raises DeviceError for a stage that is held or locked
    instead, or when the deadline comes first (``allowed_s`` is for its message)."""
    while (status := talk.status()).state in MOVING:
        if clock.now() > deadline_s:
            hint = "Is a feed override set, or does an axis stick?"
            raise DeviceError(talk.who, "the move takes too long", seen=status.name, seconds=allowed_s, hint=hint)
        talk.wait(POLL_S)
    if status.state != "Idle":
        hint = "Call resume() and finish_move()." if status.state == "Hold" else "See the controller's panel; then recover()."
        raise DeviceError(talk.who, "the move was interrupted", seen=status.name, hint=hint)
    # Idle may be reported before the move has begun: only the dwell behind it shows that it is over.
    talk.command("G4P0", max(ANSWER_S, deadline_s - clock.now()))
    status = talk.status()
    if status.state != "Idle":
        raise DeviceError(talk.who, "not idle after the move", seen=status.name, hint="Was the stage held at its own panel?")
    return status


def until_still(talk: Dialogue, clock: Clock) -> Status:
    """The first report of a stage that brakes and stands. Raises DeviceError when it doesn't obey."""
    deadline = clock.now() + STOP_S
    while not is_still(status := talk.status()):
        if clock.now() > deadline:
            raise DeviceError(talk.who, "the stage does not stop", seen=status.name, seconds=STOP_S, hint="Cut its power.")
        talk.wait(POLL_S)
    return status


def stop_hard(talk: Dialogue, error: InstrumentError) -> None:
    """What is left when braking gave ``error``: nothing where the steps are cut already, else a reset. Raises LinkError."""
    if talk.alarm is not None:
        return
    try:
        talk.restart()
    except InstrumentError as worse:
        raise LinkError(talk.who, f"can't be stopped: {worse.what}", hint="Cut its power.") from error
