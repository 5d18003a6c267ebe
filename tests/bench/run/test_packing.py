"""A run made into a recording to publish, and scored by somebody who has nothing else."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bench.files import sha256_of
from bench.record.reader import read_run
from bench.record.writer import Store
from bench.run.packing import KINDS
from tests.bench.commands import Said
from tests.bench.forked import begin
from tests.bench.small_run import KEPT

PACK = "recording pack {} --out {} --licence CC-BY-4.0"


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A copy: SQLite writes beside what it reads."""
    return shutil.copytree(KEPT, tmp_path / "kept")


@pytest.fixture
def packed(tmp_path: Path, kept: Path, said: Said) -> Path:
    said(0, PACK, kept, tmp_path / "pack")
    return tmp_path / "pack"


@pytest.mark.parametrize("kind", ["emulated", "mixed", "real", "recorded"])
def test_a_run_of_each_kind_has_its_card(kind: str, kept: Path, tmp_path: Path, said: Said) -> None:
    store = Store(kept)
    store.fact("kind", kind)
    store.fact("ending", "finished")
    store.close()
    said(0, PACK, kept, tmp_path / "pack")
    assert KINDS[kind] in (tmp_path / "pack" / "README.md").read_text(encoding="utf-8")


def test_all_of_the_run_is_in_it_byte_for_byte_with_digests_budgets_and_card(
    packed: Path, kept: Path
) -> None:
    run = read_run(kept)
    for trial in run.trials:
        for name in ("left.png", "right.png", "thermal_radiometric.png"):
            given = (kept / "frames" / trial.id / name).read_bytes()
            assert (packed / "frames" / trial.id / name).read_bytes() == given
    lines = (packed / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
    sums = {name: digest for digest, name in (line.split("  ") for line in lines)}
    files = {p.relative_to(packed).as_posix() for p in packed.rglob("*") if p.is_file()}
    assert set(sums) == files - {"SHA256SUMS"}
    assert all(sha256_of(packed / name) == digest for name, digest in sums.items())
    with (packed / "budgets.csv").open(encoding="utf-8", newline="") as file:
        parts = list(csv.DictReader(file))
    with (packed / "truth.csv").open(encoding="utf-8", newline="") as file:
        ends = list(csv.DictReader(file))
    for end in ends:
        of_it = [p for p in parts if (p["frame"], p["teat"]) == (end["frame"], end["teat"])]
        whole = sum(float(part["u_mm"]) ** 2 for part in of_it) ** 0.5
        assert whole == pytest.approx(float(end["u_mm"]), rel=1e-9)
    card = (packed / "README.md").read_text(encoding="utf-8")
    assert f"{len(run.trials)} frame sets" in card
    assert "CC-BY-4.0" in card
    assert "no real camera" in card
    assert run.head
    assert run.head.wall_digest in card
    package = json.loads((packed / "datapackage.json").read_text(encoding="utf-8"))
    assert package["licenses"] == [{"name": "CC-BY-4.0"}]
    named = {one["path"]: one["hash"] for one in package["resources"]}
    assert named.items() <= {name: f"sha256:{digest}" for name, digest in sums.items()}.items()


@pytest.mark.slow
def test_it_scores_as_the_run_did(packed: Path, kept: Path, tmp_path: Path) -> None:
    run = read_run(kept)
    (detector,) = run.detectors
    out = tmp_path / "scored"
    command = ["score", packed, "--detector", detector, "--out", out]
    with begin(command, cwd=tmp_path) as another:  # which knows nothing of the run
        another.communicate()
    (scored,) = out.iterdir()
    again = read_run(scored)
    for trial, other in zip(run.trials, again.trials, strict=True):
        counts, second = trial.scores[detector].counts, other.scores[detector]
        # by the run's own truth; the detector may be a newer one, and find more
        again_of = (second.counts.visible, second.counts.hidden, second.counts.false)
        assert again_of == (counts.visible, counts.hidden, counts.false)
        assert second.counts.matched == len(other.found) >= counts.matched
        ends, found = (
            np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in rows])
            for rows in (trial.truth, other.found)
        )
        away = [float(np.linalg.norm(ends - one, axis=1).min()) for one in found]
        assert sorted(second.radial_mm) == pytest.approx(sorted(away), abs=1e-6)


@pytest.mark.parametrize("how", ["changed", "missing", "added"])
def test_what_was_altered_after_packing_is_not_scored(
    packed: Path, kept: Path, said: Said, tmp_path: Path, how: str
) -> None:
    path = packed / "truth.csv"
    if how == "changed":
        path.write_text(path.read_text(encoding="utf-8").replace(",1,", ",0,"), encoding="utf-8")
    elif how == "missing":
        path.unlink()
    else:
        path = packed / "frames" / "more"
        shutil.copytree(packed / "frames" / read_run(kept).trials[0].id, path)
    told = said(2, "score {} --out {}", packed, tmp_path / "scored").err
    assert path.name in told
    assert "SHA256SUMS" in told
    assert not (tmp_path / "scored").exists()


def test_a_folder_that_is_there_and_a_run_that_was_altered_are_refused(
    packed: Path, kept: Path, said: Said, tmp_path: Path
) -> None:
    before = sha256_of(packed / "README.md")
    assert "is there already" in said(2, PACK, kept, packed).err
    assert sha256_of(packed / "README.md") == before
    frame = kept / "frames" / read_run(kept).trials[0].id / "left.png"
    frame.write_bytes(frame.read_bytes()[:-20])
    said(2, PACK, kept, tmp_path / "other")
    assert not list(tmp_path.glob("other*"))


def test_without_a_licence_card_and_terminal_say_so(kept: Path, said: Said, tmp_path: Path) -> None:
    told = said(0, "recording pack {} --out {} --title Udders", kept, tmp_path / "pack")
    assert "no licence is stated" in told.err
    card = (tmp_path / "pack" / "README.md").read_text(encoding="utf-8")
    assert card.startswith("# Udders\n")
    assert "none stated" in card
