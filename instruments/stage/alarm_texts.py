"""What GRBL's error and alarm numbers mean, and what to do. Source: the firmware's lists, version
1.1; numbers from 10 on as in grblHAL's source.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Meaning:
    """What happened, and what a person should do now."""

    what: str
    do: str


_OUR_FAULT = "The line that was sent is wrong: report it with the bench's log."

ERRORS: dict[int, Meaning] = {
    1: Meaning("a G-code word has no letter", _OUR_FAULT),
    2: Meaning("a number is missing or badly written", _OUR_FAULT),
    3: Meaning(
        "the '$' command is not known",
        "Check the firmware: some builds leave commands out ($I lists the options).",
    ),
    4: Meaning("a setting can't be negative", "Send a value of zero or more."),
    5: Meaning("homing is switched off", "Fit the switches and set $22=1."),
    6: Meaning("the step pulse is too short", "Set $0 to 3 or more."),
    7: Meaning(
        "the stored settings could not be read and were set to defaults",
        "Load the stage's own settings again ($100 to $132).",
    ),
    8: Meaning(
        "the command is allowed only when the stage is idle",
        "Wait until the move has finished, or end the hold.",
    ),
    9: Meaning(
        "G-code is locked out by an alarm, or while jogging",
        "Home the stage; after an alarm recover it first.",
    ),
    10: Meaning("soft limits need homing", "Set $22=1 before $20=1."),
    11: Meaning(
        "the line is longer than the controller's line buffer", "Keep lines below 80 characters."
    ),
    12: Meaning(
        "the rate asks for more than 30000 steps a second",
        "Lower the maximum rate or the steps per mm.",
    ),
    13: Meaning("the safety door is open", "Close it."),
    14: Meaning("the build information or start-up line is too long", "Shorten it."),
    15: Meaning("the jog goes beyond the travel; it was not started", "Jog less far."),
    16: Meaning("the jog command is badly formed", _OUR_FAULT),
    17: Meaning("laser mode needs a PWM output", "Set $32=0."),
    20: Meaning(
        "the controller does not know this G-code word",
        "Check the firmware's version and its build options.",
    ),
    21: Meaning("two words of one modal group stand in a line", _OUR_FAULT),
    22: Meaning("no feed rate has been given yet", "Give a feed with the move."),
    23: Meaning("a word needs a whole number", _OUR_FAULT),
    24: Meaning("two commands of the line both need the axis words", _OUR_FAULT),
    25: Meaning("a word is repeated in the line", _OUR_FAULT),
    26: Meaning("the command needs axis words and has none", _OUR_FAULT),
    27: Meaning("the line number is out of range", _OUR_FAULT),
    28: Meaning("the command lacks a value", _OUR_FAULT),
    29: Meaning("this work coordinate system does not exist", "Use G54 to G59."),
    30: Meaning("G53 goes with G0 and G1 only", _OUR_FAULT),
    31: Meaning("axis words are left over", _OUR_FAULT),
    32: Meaning("an arc has no axis word in its plane", _OUR_FAULT),
    33: Meaning("the target of the move is invalid", "Check target and limits."),
    34: Meaning("the radius of an arc is impossible", _OUR_FAULT),
    35: Meaning("an arc has no offset in its plane", _OUR_FAULT),
    36: Meaning("words are left over", _OUR_FAULT),
    37: Meaning("the tool length offset is not set up for this axis", _OUR_FAULT),
    38: Meaning("the tool number is too large", _OUR_FAULT),
}

ALARMS: dict[int, Meaning] = {
    1: Meaning(
        "a limit switch was hit and the position is probably lost",
        "Clear the stage by hand with the power off, then recover() and home().",
    ),
    2: Meaning(
        "a target lay beyond the controller's soft limits; nothing moved there",
        "Check $130 to $132, then recover() and home().",
    ),
    3: Meaning(
        "the controller was reset while moving and the position is lost",
        "Call recover(), then home().",
    ),
    4: Meaning(
        "the probe was not in its initial state", "Check the probe, then recover() and home()."
    ),
    5: Meaning("the probe found no contact", "Check the probe, then recover() and home()."),
    6: Meaning("homing was ended by a reset", "Call recover(), then home()."),
    7: Meaning("homing was ended by the safety door", "Close the door, then recover() and home()."),
    8: Meaning(
        "a switch stayed closed after the pull-off",
        "Look for a stuck or dirty switch, or raise $27; then recover() and home().",
    ),
    9: Meaning(
        "homing found no switch",
        "Check the switches, their cables and $23, $5; then recover() and home().",
    ),
    10: Meaning(
        "the two motors of one axis found their switches too far apart",
        "Square the gantry, then recover() and home().",
    ),
}


HAL_ALARMS: dict[int, Meaning] = {
    10: Meaning(
        "the emergency stop is pressed",
        "Release it when the cause is gone, then recover() and home().",
    ),
    11: Meaning("the controller wants to be homed first", "Call recover(), then home()."),
    12: Meaning(
        "a limit switch is closed",
        "Move the stage off it by hand with the power off, then recover() and home().",
    ),
    13: Meaning(
        "the probe's protection has stopped the stage",
        "Check the probe, then recover() and home().",
    ),
    14: Meaning(
        "a spindle did not reach its speed; a stage has none",
        "Switch the spindle off in its settings, then recover() and home().",
    ),
    15: Meaning(
        "of the two motors of one axis, one did not find its switch in time",
        "Square the gantry, then recover() and home().",
    ),
    16: Meaning(
        "the controller's test of itself failed",
        "Look at its own messages, switch it off and on, then recover() and home().",
    ),
    17: Meaning(
        "a motor driver reports a fault",
        "Check the motor's driver, cable and load, then recover() and home().",
    ),
}


def error_meaning(code: int) -> Meaning:
    """The meaning of ``error:code``; a number that is not in the table is said to be unknown."""
    return ERRORS.get(code) or Meaning(
        "an error that this program does not know",
        "Look the number up in the firmware's list of errors.",
    )


def alarm_meaning(code: int, dialect: str = "Grbl") -> Meaning:
    """The meaning of ``ALARM:code`` of "Grbl" or "grblHAL"; others are unknown."""
    known = ALARMS | HAL_ALARMS if dialect == "grblHAL" else ALARMS
    return known.get(code) or Meaning(
        "an alarm that this program does not know",
        "Look the number up in the firmware's list of alarms, then recover() and home().",
    )
