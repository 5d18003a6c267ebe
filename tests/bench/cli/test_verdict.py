"""What a run found, at the terminal, and whether its report opens."""

from __future__ import annotations

import sys
import webbrowser
from collections import Counter
from pathlib import Path

import pytest

from bench.cli.verdict import open_report
from bench.script.model import find_script, load_script


@pytest.mark.weekly
def test_the_demo_shows_ten_members_of_each_situation() -> None:
    script = load_script(find_script("demo"))
    assert script.script.detectors == ("fused", "thesis")
    assert set(Counter(trial.situation for trial in script.planned).values()) == {10}
    assert len({trial.name for trial in script.planned}) == 60
    assert {trial.scene.seed for trial in script.planned if trial.scene} == set(range(16000, 16010))


@pytest.mark.parametrize(
    ("environment", "opens"),
    [({"DISPLAY": ":0"}, True), ({"DISPLAY": ":0", "CI": "true"}, False), ({}, False)],
)
@pytest.mark.skipif(sys.platform != "linux", reason="a display is named by the environment there")
def test_a_report_opens_only_on_a_desktop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, environment: dict[str, str], opens: bool
) -> None:
    opened: list[str] = []

    def note(uri: str) -> bool:
        opened.append(uri)
        return True

    monkeypatch.setattr(webbrowser, "open", note)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    for name in ("CI", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert open_report(tmp_path / "index.html") is opens
    assert opened == ([(tmp_path / "index.html").as_uri()] if opens else [])
