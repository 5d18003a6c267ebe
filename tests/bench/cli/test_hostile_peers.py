"""A peer that is no instrument, at every link: each command ends in time, says who answered how,
takes little memory and sends nothing that moves or heats.
"""

from __future__ import annotations

import re
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
from pymodbus.client import ModbusTcpClient

from bench.cli.main import main
from instruments.clock import RealClock
from instruments.errors import InstrumentError
from instruments.link import MOST_BYTES, Link
from instruments.operators.operator import Homing
from instruments.operators.remote import RemoteOperator
from instruments.stage.connection import Dialogue
from tests.bench.hostile_peers import CELLS, hostile, rig_text, sound_bath
from tests.examples import few

pytestmark = pytest.mark.slow

if sys.platform == "win32":
    pytest.skip("forks benches", allow_module_level=True)

# zaber-motion keeps what comes without an end of a line for as long as it waits: 1.4 GB over a
# loopback, 20 kB at a serial port (docs/rig.md)
MAKERS = {
    ("stage, Zaber", "endless data"): pytest.mark.xfail(reason="the maker's library has no bound")
}
ENDLESS = ("endless data", "endless lines")
QUICK = ("endless data", "endless lines", "closing at once", "echo", "zeros", "exceptions")


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("link", "kind"),
    [pytest.param(*cell, id=", ".join(cell), marks=MAKERS.get(cell, ())) for cell in CELLS],
)
def test_every_command_ends_well(link: str, kind: str, recording: Path) -> None:
    from tests.bench.hostile_peers import outcomes

    wrong = {one.name: (one.faults, one.said) for one in outcomes(link, kind, recording)}
    assert not {name: found for name, found in wrong.items() if found[0]}


COMMANDS = {
    "arm read --port socket://{} --homed": (*ENDLESS, "closing at once", "echo"),
    "bath read --port tcp://{} --profile julabo-presto": QUICK,
    "bath read --port rtu+tcp://{} --profile omega-cn7": QUICK,
    "bath read --port tcp://{} --profile julabo-ascii": (*ENDLESS, "zeros", "exceptions"),
    "bath learn --port tcp://{} --profile julabo-magio": QUICK,
    "bath standby --port rtu+tcp://{} --profile watlow-pm-map1": ("endless data", "zeros"),
    "stage status --port socket://{} --dialect grbl": (*ENDLESS, "closing at once"),
    "stage status --port socket://{} --dialect marlin": ENDLESS,
}


@pytest.mark.parametrize(
    ("command", "kind"),
    few([(command, kind) for command, kinds in COMMANDS.items() for kind in kinds], 2),
)
def test_a_command_ends_in_time_and_says_why(
    command: str, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with hostile(kind) as peer:
        start_s = time.monotonic()
        code = main(command.format(f"127.0.0.1:{peer.port}").split())
        took_s = time.monotonic() - start_s
        sent = b"".join(peer.received)
    said = capsys.readouterr()
    assert code == 3, said
    assert f"127.0.0.1:{peer.port}" in said.out + said.err
    assert took_s < 65.0
    assert b"$H" not in sent
    assert b"G28" not in sent
    if kind == "endless data" and "bath learn" not in command:
        assert "without pause" in said.err or "got" in said.err or "link" in said.err


@pytest.mark.parametrize("kind", ENDLESS)
def test_no_wait_of_a_link_is_longer_than_its_deadline(kind: str) -> None:
    with closing(RealClock()) as clock, hostile(kind) as peer:
        for wait in (
            lambda link: link.read_until(b"\xfe\xff\xfe", 0.5),
            lambda link: link.read(MOST_BYTES * 10, 0.5),
            lambda link: link.drain(0.1),
            lambda link: Dialogue(link, clock).wait(0.5),
            lambda link: Dialogue(link, clock).status(),
            lambda link: Dialogue(link, clock).restart(),
        ):
            with closing(Link(f"socket://127.0.0.1:{peer.port}", clock, who="it")) as link:
                start_s = time.monotonic()
                try:  # on a slow machine a wait may be over before so much has come
                    wait(link)
                except InstrumentError as error:
                    assert "it at socket://" in str(error)  # noqa: PT017 - or nothing is raised
                assert time.monotonic() - start_s < 30.0


@pytest.mark.parametrize("kind", [*ENDLESS, "closing at once", "echo", "exceptions"])
def test_an_operator_that_is_none_is_named(kind: str) -> None:
    with closing(RealClock()) as clock, hostile(kind) as peer:
        url = f"socket://127.0.0.1:{peer.port}"
        with (
            closing(RemoteOperator(url, clock)) as operator,
            pytest.raises(InstrumentError, match="operator at socket"),
        ):
            operator.ask(Homing("Put it on its peg."))


def test_the_server_of_hostile_peers_is_what_it_says() -> None:
    """A foreign Modbus client reads zeros and exceptions from it."""
    with hostile("zeros") as peer:
        client = ModbusTcpClient("127.0.0.1", port=peer.port)
        assert client.read_holding_registers(0, count=4).registers == [0, 0, 0, 0]
        client.close()  # type: ignore[no-untyped-call]
    with hostile("exceptions") as peer:
        client = ModbusTcpClient("127.0.0.1", port=peer.port)
        assert client.read_holding_registers(0, count=4).isError()
        client.close()  # type: ignore[no-untyped-call]


def test_a_rig_of_typed_points_is_checked(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An arm without a wire has no counts to show."""
    with sound_bath("julabo-presto") as (_, bath):
        rig = tmp_path / "rig.toml"
        rig.write_text(rig_text("bath, lines", "127.0.0.1:1", bath, recording), encoding="utf-8")
        text = re.sub(
            r'\[bath\]\nurl = ".*"\nprofile = ".*"',
            f'[bath]\nurl = "{bath}"\nprofile = "julabo-presto"',
            rig.read_text(encoding="utf-8"),
        )
        rig.write_text(text, encoding="utf-8")
        assert main(["check", str(rig)]) == 0
    assert "source: typed" in capsys.readouterr().out
