"""A run made into a recording to publish: frames byte for byte, calibration, truth with its
budgets, a data card for people, a description for programs, and the SHA-256 of every file.

``datapackage.json`` is a Data Package (https://datapackage.org, version 1); ``SHA256SUMS`` is what
``sha256sum --check`` reads.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import ConfigError
from bench.files import sha256_of, write_synced
from bench.record.reader import RunRecord, read_run
from bench.record.recording import Recording, RecordingError, RecordingWriter
from bench.run.recordings import Recorder
from reports.sanitize import csv_text
from textfiles.whole import new_folders, take_place

SUMS, CARD, DESCRIPTION, BUDGETS = "SHA256SUMS", "README.md", "datapackage.json", "budgets.csv"
NO_LICENCE = "none stated: ask whoever made it before you use or pass it on"
FIELDS = {
    "frame": "folder under frames/",
    "situation": "kind of scene",
    "teat": "name of the teat",
    "x_mm": "world frame, mm",
    "y_mm": "world frame, mm",
    "z_mm": "world frame, mm",
    "visible": "1 where every camera sees the end, else 0",
    "u_mm": "standard uncertainty along one axis, mm",
    "component": "what contributes to that uncertainty",
    "source": "where its figure comes from",
}
NUMBERS = ("x_mm", "y_mm", "z_mm", "u_mm")
KINDS = {
    "emulated": "Rendered by the emulators of teatbench: no real camera, arm or animal was there."
    " Good for developing and comparing; figures made on it say nothing of a real cow.",
    "mixed": "Some of the instruments were emulators of teatbench: its figures are no measurement.",
    "real": "Measured with the instruments named below.",
    "recorded": "The pictures come from another recording, whose licence and card hold for them.",
}
DEPTH_FILES = """\
| `frames/<frame>/depth.png` | 16-bit, tenths of a millimetre along its axis, 0: not measured |
| `frames/<frame>/depth_amplitude.png` | 16-bit, the strength of its signal |
"""


def pack_run(run: Path, out: Path, title: str = "", licence: str = "") -> Path:
    """Write ``run`` as a self-describing recording in the new folder ``out``, whole or not at all;
    ``licence`` is an SPDX identifier. Raises ConfigError, RecordingError, OSError.
    """
    if out.exists():
        raise ConfigError.plain(f"`out` {out}: is there already. Name a new folder.")
    record = read_run(run)
    making = out.with_name(f"{out.name}.part")
    shutil.rmtree(making, ignore_errors=True)
    with new_folders(out.parent), ExitStack() as at_end:
        at_end.callback(shutil.rmtree, making, ignore_errors=True)
        writer = RecordingWriter(making)
        for trial in record.trials:
            writer.copy(trial.id, run / "frames" / trial.id)
        # finds the frames there, and adds calibration and the truth that holds
        Recorder(making, Recording(run).calibration_path, _refuse, record)
        recording = Recording(making)
        if not recording.truth:
            raise ConfigError.plain(
                f"{run}: no trial has a truth that holds, so there is nothing to score against."
            )
        budgets = list(_budgets(record, recording))
        header = ("frame", "teat", "component", "u_mm", "source")
        write_synced(making / BUDGETS, csv_text([header, *budgets]).encode("utf-8"))
        title = title or f"{record.facts.get('title') or run.name}, {record.facts.get('rig', '')}"
        card = _card(record, recording, title, licence, budgets)
        write_synced(making / CARD, card.encode("utf-8"))
        digest = record.head.wall_digest if record.head else None
        package: dict[str, Any] = {
            "profile": "data-package",
            "name": "".join(c if c.isalnum() else "-" for c in record.folder.name.lower()),
            "title": title,
            "created": record.facts.get("wall_started"),
            "licenses": [{"name": licence}] if licence else [],
            "emulated": record.facts.get("kind") in ("emulated", "mixed"),
            "sources": [{"title": record.folder.name, "wall_digest": digest}],
            "resources": [_resource(making, name) for name in _files(making)],
        }
        described = json.dumps(package, indent=1, ensure_ascii=False) + "\n"
        write_synced(making / DESCRIPTION, described.encode("utf-8"))
        sums = "".join(f"{sha256_of(making / name)}  {name}\n" for name in _files(making))
        write_synced(making / SUMS, sums.encode("utf-8"))
        take_place(making, out)
    return out


def check_pack(folder: Path) -> int:
    """The number of packed files; 0 for no pack. Raises RecordingError for one that was changed."""
    path = folder / SUMS
    if not path.is_file():
        return 0
    lines = path.read_text(encoding="utf-8").splitlines()
    pairs = [line.partition("  ") for line in lines]
    sums = {name: digest for digest, _, name in pairs if name}
    for name, digest in sums.items():
        if not (folder / name).is_file() or sha256_of(folder / name) != digest:
            raise RecordingError(
                f"{folder / name}: is not as it was packed ({SUMS}). Get it again; or delete"
                f" {path}, if it was changed on purpose."
            )
    if more := sorted(set(_files(folder)) - {*sums, SUMS}):
        raise RecordingError(
            f"{folder / more[0]}: was added after the folder was packed ({SUMS}). Remove it; or"
            f" delete {path}, if it was added on purpose."
        )
    return len(sums)


def _refuse(text: str) -> None:
    raise ConfigError.plain(text)


def _files(folder: Path) -> list[str]:
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )


def _budgets(record: RunRecord, recording: Recording) -> Iterator[tuple[object, ...]]:
    for trial in record.trials:
        for row in trial.truth if trial.id in recording.truth else ():
            for part in json.loads(row["budget"])["components"] if row["budget"] else ():
                yield trial.id, row["teat"], part["name"], part["u_mm"], part["source"]


def _card(
    record: RunRecord,
    recording: Recording,
    title: str,
    licence: str,
    budgets: Sequence[Sequence[object]],
) -> str:
    facts, head = record.facts, record.head
    rows = [row for frame in recording.truth.values() for row in frame]
    u_mm = [row.u_mm for row in rows if row.u_mm is not None]
    stated = f"median {np.median(u_mm):.2f} mm, at most {max(u_mm):.2f} mm" if u_mm else "not known"
    kinds = Counter(frame[0].situation for frame in recording.truth.values())
    open_frames = sorted(set(recording.frames) - set(recording.truth))
    left_out = [
        *(f"- {row['trial']}: skipped, {row['reason']}" for row in record.skipped),
        *(f"- {trial.id}: no truth, {trial.invalid}" for trial in record.trials if trial.invalid),
        *(f"- {name}: its truth was not confirmed" for name in open_frames),
    ]
    names = sorted({str(name) for _, _, name, _, _ in budgets})
    parts = [
        f"- {name}: {max(float(str(u)) for _, _, other, u, _ in budgets if other == name):.3f} mm"
        f" at most; {next(source for _, _, other, _, source in budgets if other == name)}"
        for name in names
    ]
    cameras = (facts.get("identities") or {}).get("cameras") or {}
    deep = any(row["camera"] == "depth" for trial in record.trials for row in trial.frames)
    card = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    return card.format(
        depth=" of these; a depth camera was there too" if deep else "",
        depth_files=DEPTH_FILES if deep else "",
        title=title,
        kind=KINDS[str(facts.get("kind", "recorded"))],
        frames=len(recording.frames),
        teats=len(rows),
        visible=sum(row.visible for row in rows),
        kinds="\n".join(f"| {name} | {count} |" for name, count in sorted(kinds.items())),
        stated=stated,
        parts="\n".join(parts or ["- none stated"]),
        run=record.folder.name,
        facts=defaultdict(lambda: "not known", facts),
        cameras="".join(f"- {name} camera: {who}\n" for name, who in cameras.items()),
        versions=", ".join(f"{key} {value}" for key, value in facts["versions"].items()),
        digest=head.wall_digest if head else "not known",
        left_out="\n".join(left_out or ["nothing"]),
        licence=licence or NO_LICENCE,
    )


def _resource(folder: Path, name: str) -> Mapping[str, Any]:
    path = folder / name
    known: dict[str, Any] = {
        "name": "".join(c if c.isalnum() else "-" for c in name.lower()),
        "path": name,
        "bytes": path.stat().st_size,
        "hash": f"sha256:{sha256_of(path)}",
    }
    if path.suffix == ".csv":
        columns = path.read_text(encoding="utf-8").splitlines()[0].split(",")
        kinds = {name: "number" if name in NUMBERS else "string" for name in columns}
        fields = [
            {"name": name, "type": kind, "description": FIELDS[name]}
            for name, kind in kinds.items()
        ]
        known |= {"profile": "tabular-data-resource", "schema": {"fields": fields}}
    return known
