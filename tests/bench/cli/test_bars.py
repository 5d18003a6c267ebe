"""What takes longer than two seconds shows a bar: on standard error, only where both streams are
terminals, and never in what the command writes.
"""

from pathlib import Path

import pytest

from bench.cli.main import main


def recorded(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """What `scene record` of one scene writes to standard output, and to standard error."""
    asked = ["--situation", "overlapping", "--seeds", "1", "--out", str(folder)]
    assert main(["scene", "record", *asked]) == 0
    said = capsys.readouterr()
    return said.out, said.err


@pytest.mark.slow
def test_a_terminal_has_a_bar_that_counts_and_a_pipe_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    piped, nothing = recorded(tmp_path / "a", capsys)
    assert (piped.splitlines()[0], nothing) == ("overlapping-0000", "")
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    written, shown = recorded(tmp_path / "b", capsys)
    assert written.splitlines()[0] == "overlapping-0000"
    assert "rendering the scenes" in shown
    assert "1/1" in shown
    assert main(["runs", str(tmp_path)]) == 0
    assert "reading the runs" in capsys.readouterr().err
