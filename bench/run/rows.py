"""What is written down of a run: the facts that hold for all of it (versions, machine, calibration,
items under test, the arm), and each trial as rows of the store's tables.

What depends on real time goes into columns that begin with ``wall``, so that all others repeat with
the seed.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.files import Picture
from bench.record.schema import Row
from bench.record.writer import Store
from bench.results.answers import LEFT_OUT, Answer, one_line
from bench.results.stated_arm import STATED_FACT, VERIFICATION_FACT, stated_fact
from bench.rig.arm_files import as_dict
from bench.rig.loading import LoadedRig
from bench.run.notify import without_secrets
from bench.truth.joint import FRAME_FACT
from bench.version import __version__, versions
from detector.protocol import Detector
from instruments.clock import wall_time
from textfiles.text import one_command


def detection_tables(trial_id: str, answers: Sequence[Answer]) -> tuple[list[Row], list[Row]]:
    """The rows of the tables ``detections`` and ``found`` for all answers on one frame set."""
    rows = [detection_rows(trial_id, answer) for answer in answers]
    return [head for head, _ in rows], [end for _, ends in rows for end in ends]


def detection_rows(trial: str, answer: Answer) -> tuple[Row, list[Row]]:
    """The row of ``detections``, and those of ``found``, for one answer."""
    detection = answer.detection
    whose = {"trial": trial, "detector": answer.detector}
    trace = {
        stage.name: {
            # points and figures as they are; masks are files of their own
            key: value.tolist()
            if value.size <= 400
            else {"shape": value.shape, "type": f"{value.dtype}"}
            for key, value in stage.data.items()
        }
        for stage in detection.trace
    }
    head = {
        **whose,
        "hidden": detection.hidden,
        "reason": detection.reason,
        "outcome": answer.outcome.value,
        "cold": int(answer.cold),
        "trace": json.dumps(trace),
        "wall_seconds": answer.seconds,
        "wall_start_up_s": answer.start_up_s,
        "wall_stderr": answer.stderr or None,
        "wall_cpu_s": answer.cpu_s,
        "wall_load": answer.load,
    }
    return head, [
        {
            **whose,
            "number": number,
            **dict(zip(("x_mm", "y_mm", "z_mm"), map(float, teat.world_mm), strict=True)),
            "covariance_mm2": _json(teat.covariance_mm2),
            "left_px": _json(teat.left_px),
            "right_px": _json(teat.right_px),
        }
        for number, teat in enumerate(detection.teats, 1)
    ]


def stage_pictures(answers: Sequence[Answer]) -> dict[str, Picture]:
    """The masks (h, w) of the detectors' stages as 8-bit pictures, by ``detector-stage``."""
    return {
        f"{answer.detector}-{stage.name.replace(' ', '-')}": np.uint8(255) * mask
        for answer in answers
        for stage in answer.detection.trace
        for mask in stage.data.values()
        if mask.dtype == np.bool_ and mask.ndim == 2
    }


def _json(value: Any) -> str | None:
    return None if value is None else json.dumps(np.asarray(value).tolist())


def write_arm_facts(store: Store, rig: LoadedRig) -> None:
    """What the rig states of its arm, its table frame and verification, into the store."""
    store.fact(STATED_FACT, stated_fact(rig.rig.arm))
    if (frame := rig.frame) is not None:
        fact = {
            "file": rig.rig.arm.frame,
            "made": frame.made.isoformat(),
            "serial_number": frame.serial_number,
            "residual_mm": frame.residual_mm,
            "residuals_mm": frame.residuals_mm,
            "om": frame.world_from_arm.om.tolist(),
            "T": frame.world_from_arm.T.tolist(),
        }
        store.fact(FRAME_FACT, fact)
    if rig.verification is not None:
        store.fact(VERIFICATION_FACT, as_dict(rig.verification))


def write_facts(
    store: Store, facts: Mapping[str, Any], detectors: Sequence[Detector], calibration: Path
) -> None:
    """Facts of the whole run into its store; of each item under test its configuration."""
    program = Path(next(iter(sys.argv), ""))
    ours = program.stem == "teatbench" or program.match("bench/cli/__main__.py")
    everything = {
        **facts,
        "detectors": [detector.name for detector in detectors],
        "items": {detector.name: _item(detector) for detector in detectors},
        "calibration_sha256": hashlib.sha256(calibration.read_bytes()).hexdigest(),
        "versions": {
            "teatbench": __version__,
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
            **versions(),
        },
        "commit": commit(Path(__file__).resolve().parents[2] / ".git"),
        "command": one_command(
            ["teatbench" if ours else str(program), *without_secrets(sys.argv[1:])]
        ),
        "wall_started": wall_time().isoformat(timespec="seconds"),
    }
    with store.step():
        for key, value in everything.items():
            store.fact(key, value)


def _item(detector: Detector) -> dict[str, str]:
    parameters = json.dumps(dict(detector.parameters), sort_keys=True, default=str)
    digest = hashlib.sha256(f"{detector.name} {detector.version} {parameters}".encode()).hexdigest()
    trained_on = getattr(detector, "trained_on", {})
    item = {
        "name": detector.name,
        "version": detector.version,
        "computed by": getattr(detector, "computed_by", ""),
        "device": one_line(getattr(detector, "device", "")),
        "trained on": one_line(json.dumps(trained_on)) if trained_on else "",
        "configuration SHA-256": digest,
        "configuration": parameters,
        LEFT_OUT: getattr(detector, "covariance_leaves_out", ""),
    }
    return {key: value for key, value in item.items() if value}


def commit(git: Path) -> str | None:
    """The commit of the bench's own working copy; None where it runs from no copy."""
    try:
        head = (git / "HEAD").read_text(encoding="ascii").strip()
        if not head.startswith("ref: "):
            return head
        name = head.removeprefix("ref: ")
        if (git / name).is_file():
            return (git / name).read_text(encoding="ascii").strip()
        packed = (git / "packed-refs").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    return next((line.split()[0] for line in packed if line.endswith(f" {name}")), None)
