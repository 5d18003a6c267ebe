"""`console` and `run --console` at the terminal."""

from __future__ import annotations

import shutil
import signal
import socket
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import read_run
from tests.bench.commands import Said
from tests.bench.console import served
from tests.bench.forked import begin
from tests.bench.operated_runs import files, folder_with_runs
from tests.bench.small_run import KEPT, SCRIPT
from tests.waiting import PATIENCE_S


def test_without_its_libraries_it_says_what_to_install(
    said: Said, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert "pip install 'teatbench[console]'" in said(2, "console --runs {}", tmp_path).err


def test_an_address_that_is_not_to_be_had_is_named(said: Said, tmp_path: Path) -> None:
    err = said(2, "console --runs {} --no-open --listen 203.0.113.7", tmp_path).err
    assert "can't listen on '203.0.113.7'" in err


@pytest.mark.parametrize(
    "address",
    [
        *("", "0.0.0.0", "0", "0x0", "0.0", "00.0.0.0", "::", "::0", "0:0::0", "::ffff:0.0.0.0"),
        *("255.255.255.255", "0xffffffff", "224.0.0.1", "ff02::1"),
    ],
)
def test_what_is_no_single_address_of_the_machine_is_refused_however_it_is_spelled(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["console", "--runs", str(tmp_path), "--no-open", "--listen", address]) == 2
    out, err = capsys.readouterr()
    said = ("is every address of this machine", "is no machine's own", "can't listen")
    assert any(words in err for words in said)
    assert "http" not in out


def test_the_folder_is_checked_before_an_address_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert main(["console", "--runs", str(tmp_path / "file"), "--no-open"]) == 2
    out, err = capsys.readouterr()
    assert "can't be used" in err
    assert not out


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal to a child")
def test_half_a_request_is_shed_and_pages_that_are_open_leave_no_traceback(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    shutil.copytree(KEPT, runs / "kept")
    with (tmp_path / "err.txt").open("wb") as err:
        process = begin(["console", "--runs", runs, "--no-open"], cwd=tmp_path, stderr=err.fileno())
        assert process.stdout is not None
        one = served.Served(process, process.stdout.readline().split()[1])
        with ExitStack() as open_ones:
            halves = [
                open_ones.enter_context(socket.create_connection(("127.0.0.1", one.port)))
                for _ in range(3)
            ]
            halves[1].sendall(b"GET / HTTP/1.1\r\nHost: 127")
            halves[2].sendall(
                f"POST /api/lease HTTP/1.1\r\nHost: 127.0.0.1:{one.port}\r\n"
                f"Authorization: Bearer {one.token}\r\nContent-Type: application/json\r\n"
                "Content-Length: 100\r\n\r\n{".encode()
            )
            for half in halves:
                half.settimeout(served.SOON_S)
            assert halves[0].recv(1) == b""
            assert halves[1].recv(1) == b""
            assert b"422" in halves[2].recv(100)
            head = f"GET /api/runs/kept/stream HTTP/1.1\r\nHost: 127.0.0.1:{one.port}\r\n"
            for page in range(20):
                follower = open_ones.enter_context(
                    socket.create_connection(("127.0.0.1", one.port))
                )
                follower.settimeout(served.SOON_S)
                asked = f"Authorization: Bearer {one.token}\r\nX-Client: {page}\r\n\r\n"
                follower.sendall((head + asked).encode())
                assert b"200" in follower.recv(100)
            assert one.ask("/runs").body["pages"] == 20
            process.send_signal(signal.SIGINT)
            process.wait(served.SOON_S)
        assert "A run under way goes on without it" in process.stdout.read()
        process.stdout.close()
    assert "Traceback" not in (tmp_path / "err.txt").read_text(encoding="utf-8")


@pytest.mark.weekly
def test_a_run_of_a_rig_in_virtual_time_takes_its_real_time_beside_a_console(
    tmp_path: Path,
) -> None:
    said, _ = begin([*files(tmp_path, script=SCRIPT), "--console"]).communicate(timeout=PATIENCE_S)
    assert "console http://127.0.0.1:" in said
    (run,) = folder_with_runs(tmp_path)
    assert read_run(run).facts["asked"]["realtime"] is True
    assert not (run / "console").exists()  # gone at the run's end


@pytest.mark.slow
def test_started_from_the_page_a_run_outlives_its_console(tmp_path: Path) -> None:
    files(tmp_path, script=SCRIPT)
    one = served.serve(tmp_path / "runs", tmp_path)
    try:
        found = one.ask("/choices").body
        assert found["rigs"][-2:] == ["emulated-depth", "rig.toml"]
        assert found["paced"] == found["rigs"], "a user's emulated rig has a speed as ours have"
        wrong = one.ask("/start", {"rig": "../rig.toml", "script": "script.toml"})
        assert (wrong.status, "there is no rig" in wrong.body["error"]) == (422, True)
        chosen = {"rig": "rig.toml", "script": "script.toml", "detectors": []}
        far = SCRIPT.replace("x_mm = 12.0", "x_mm = 900.0")
        (tmp_path / "far.toml").write_text(far, encoding="utf-8")
        dry = one.ask("/dry-run", {**chosen, "script": "far.toml"}).body
        assert dry["exit_code"] == 2, dry
        findings = {(found["trial"], found["kind"]) for found in dry["found"]["findings"]}
        assert ("place", "view") in findings
        assert {trial for trial, _ in findings} == {"place"}
        name = one.ask("/start", chosen).body["run"]
    finally:
        served.end(one)
    run = tmp_path / "runs" / name
    served.eventually(lambda: (run / "report" / "run.json").is_file())
    assert read_run(run).ending == "finished"
