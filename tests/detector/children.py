"""Detectors in processes of their own, of every manner, as short programs in Python."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from detector.external import ExternalDetector, Limits

HEAD = """\
import json, os, subprocess, sys, time
def say(thing):
    print(json.dumps(thing), flush=True)
"""
GOOD = (
    HEAD
    + """
say({"ready": True})
for line in sys.stdin:
    asked = json.loads(line)
    say({"frame": asked["frame"], "teats": [{"world_mm": [1, 2, 3]}], "hidden": 1})
"""
)


def answering(what: str, ready: str = 'say({"ready": True})') -> str:
    """A child that does ``what`` for each question, with ``asked`` the question."""
    body = "\n".join(f"    {line}" for line in what.splitlines())
    return f"{HEAD}\n{ready}\nfor line in sys.stdin:\n    asked = json.loads(line)\n{body}\n"


def child(folder: Path, program: str, **limits: float | None) -> ExternalDetector:
    """A detector that runs ``program``."""
    path = folder / "program.py"
    path.write_text(program, encoding="utf-8")
    return ExternalDetector("mine", [sys.executable, str(path)], time.perf_counter, limits=Limits(**limits))  # type: ignore[arg-type]
