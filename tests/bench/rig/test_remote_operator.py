"""The emulated operator of another process, over a socket: nothing is lost on the way, and nothing
ends it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import find_rig, load_rig
from bench.script.phantom import shipped_phantom
from instruments.clock import RealClock
from instruments.errors import DeviceError, InstrumentError, LinkError
from instruments.link import Link
from instruments.listener import Listener
from instruments.operators.emulated import EmulatedOperator
from instruments.operators.operator import (
    Arrangement,
    BoardPose,
    BoardTouch,
    CheckPoint,
    Homing,
    OperatorAbort,
    OperatorEnough,
    OperatorSkip,
    Release,
    Touch,
)
from instruments.operators.remote import OperatorPort, RemoteOperator
from instruments.world.boards import Pattern
from instruments.world.situations import SITUATIONS, situation

pytestmark = pytest.mark.slow

CHECK_POINT_MM = (-190.0, 120.0, 15.0)


@pytest.fixture
def twin() -> Iterator[EmulatedRig]:
    with closing(RealClock()) as clock, EmulatedRig(load_rig(find_rig(None)), clock, 1) as rig:
        yield rig


@pytest.fixture
def port(twin: EmulatedRig) -> Iterator[Listener]:
    with closing(listening(twin.operator, twin)) as listener:
        yield listener


def listening(operator: EmulatedOperator, twin: EmulatedRig) -> Listener:
    lock = threading.RLock()
    return Listener(OperatorPort(operator), twin.world.clock, lock=lock, name="operator")


def test_every_situation_arrives_as_it_was_sent(twin: EmulatedRig, port: Listener) -> None:
    with closing(RealClock()) as clock, closing(RemoteOperator(port.url, clock)) as operator:
        for name in SITUATIONS:
            sent = situation(name, 3)
            objects = ({"kind": "cold_teat"},)
            asked = Arrangement(name, sent.phantom, objects, "Set it up.", scene=sent)
            placed = operator.ask(asked)
            assert twin.world._phantom == sent.phantom
            assert twin.world._situation == sent
            assert len(twin.world._objects) == 1
            seen = twin.world.renderer.visible_ends(twin.world.scene())
            assert placed.visible == tuple(bool(row.all()) for row in np.asarray(seen))


def test_the_hand_and_the_boards_do_as_they_are_asked(twin: EmulatedRig, port: Listener) -> None:
    with closing(RealClock()) as clock, closing(RemoteOperator(port.url, clock)) as operator:
        operator.ask(Arrangement("ideal", shipped_phantom("table-5-1"), (), ""))
        operator.ask(Touch(2, 4, number=1, numbers=3, again="That was teat 1."))
        target = twin.world.arm_target()
        assert target is not None
        np.testing.assert_allclose(target[0], twin.world.ends_mm()[1], atol=1.0)
        operator.ask(CheckPoint(2, 5))
        target = twin.world.arm_target()
        assert target is not None
        np.testing.assert_allclose(target[0], CHECK_POINT_MM)
        operator.ask(Release())
        assert twin.world.arm_target() is None
        board = BoardPose(Pattern(), "Hold it.", 1, fixed=True)
        operator.ask(board)
        assert twin.world._board is not None
        operator.ask(BoardTouch(3, "Touch corner 3."))
        assert twin.world.arm_target() is not None
        operator.ask(Homing("On the peg."))
        assert twin.world.arm_target() is None
        for number in range(1, 25):
            operator.ask(BoardPose(Pattern(), "Hold it.", number))
        with pytest.raises(OperatorEnough, match="shown the board 24 times"):
            operator.ask(BoardPose(Pattern(), "Hold it.", 25))


NOT_UNDERSTOOD = (
    b"",
    b"\xff",
    b"[1]",
    b"{}",
    b'{"do": "close", "with": {}}',
    b'{"do": "__init__", "with": {}}',
    b'{"do": "touch", "with": {"teat": 99, "of": 4}}',
    b'{"do": "touch", "with": {"teat": "all"}}',
    b'{"do": "touch_check_point", "with": {"touch": 1, "of": 0}}',
    b'{"do": "set_up", "with": {"situation": 1}}',
)


def test_what_is_not_understood_is_refused_and_ends_nothing(port: Listener) -> None:
    with closing(RealClock()) as clock:
        for line in NOT_UNDERSTOOD:
            with closing(Link(port.url, clock, who="anybody")) as link:
                link.write(line[:3])
                link.write(line[3:] + b"\n")
                assert link.read_until(b"\n", 60.0).startswith(b'{"refused":'), line
            with closing(RemoteOperator(port.url, clock)) as operator:
                operator.ask(Homing("On the peg."))


def test_a_refusal_and_a_lost_operator_are_faults(twin: EmulatedRig) -> None:
    port = listening(EmulatedOperator(twin.world, hand_error_mm=0.1), twin)
    with closing(RealClock()) as clock, closing(RemoteOperator(port.url, clock)) as operator:
        with pytest.raises(DeviceError, match="has no check point"):
            operator.ask(CheckPoint(1, 5))
        port.close()
        with pytest.raises(LinkError, match="operator at socket"):
            operator.ask(Release())
        with pytest.raises(LinkError, match="nothing takes the connection"):
            RemoteOperator(port.url, clock)


def test_what_the_arm_does_not_reach_is_skipped_or_aborted_as_by_hands_of_this_process(
    twin: EmulatedRig, port: Listener
) -> None:
    twin.operator.way = lambda _, axis: None
    with closing(RealClock()) as clock, closing(RemoteOperator(port.url, clock)) as operator:
        with pytest.raises(OperatorSkip) as skip:
            operator.ask(Touch(2, 4))
        assert skip.value.reason.startswith("the arm doesn't reach the end of teat 2 at [")
        with pytest.raises(OperatorAbort, match="doesn't reach the check point at"):
            operator.ask(CheckPoint(1, 5))
        operator.ask(Release())


def test_interlocks_end_the_wait_and_its_answer_is_not_taken_for_the_next_ones(
    twin: EmulatedRig,
) -> None:
    slow = EmulatedOperator(twin.world, hand_error_mm=0.1, prompt_s=1.0)
    asked: list[str] = []

    def check() -> None:
        asked.append("check")
        if len(asked) > 2:
            raise InstrumentError("bath", "too warm")

    with (
        closing(listening(slow, twin)) as port,
        closing(RealClock()) as clock,
        closing(RemoteOperator(port.url, clock)) as operator,
    ):
        with pytest.raises(InstrumentError, match="too warm"):
            operator.ask(Homing("On the peg."), check)
        placed = operator.ask(Arrangement("ideal", shipped_phantom("table-5-1"), (), ""))
        assert len(placed.visible) == 4
