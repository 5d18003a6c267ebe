"""What the pages of a null world may say, kind by kind: each sentence and marked cell that accuses or
accepts, with when it is false. One that is in no row here fails the test of tests.

All are claimed to be false in at most 5 % of runs. A row without ``false`` accuses and accepts
nothing: it explains, or repeats what was seen.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

from bench.config import read_calibration
from bench.rig.loading import RIGS
from tests.bench.report.null_world import AT_THE_LIMIT_MM, LIMIT_MM, Done, Floats
from tests.bench.report.page_reader import Said, read
from tests.conftest import ROOT

False_ = Callable[[re.Match[str], Said, Done], bool]
N = r"([+-]?[\d.]+(?:e[+-]\d+)?)"  # a number


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of statement: the whole of its text, where it stands, and when it is false."""

    name: str
    text: str
    false: False_ | None = None
    table: str = ""
    column: str = ""
    row: str = ""

    def match(self, said: Said) -> re.Match[str] | None:
        there = (self.table, said.table), (self.column, said.column), (self.row, said.row)
        if all(re.search(pattern, text) for pattern, text in there):
            return re.fullmatch(self.text, said.text)
        return None


@cache
def _camera_from_world() -> Floats:
    return np.asarray(read_calibration(RIGS / "calibration.toml").world_from_right.inverse().R)


def _largest(said: Said, done: Done) -> float:
    """The exact error along the axis of a row."""
    frame, axis = said.row.split()[:2]
    errors = done.errors_mm if frame == "world" else done.errors_mm @ _camera_from_world().T
    return float(np.abs(errors[:, "xyz".index(axis)]).max())


def _met(said: Said, done: Done) -> bool:
    """The detector stands at the limit of both, and nothing else is wrong."""
    del done
    return said.row in ("error", "reliability")


def _not_met(said: Said, done: Done) -> bool:
    return said.row != "error" or float(done.distances_mm.max()) <= LIMIT_MM


def _quantile(share: float) -> float:
    """Of the distance, of a detector at the limit."""
    from scipy.special import chdtri

    return float(AT_THE_LIMIT_MM * np.sqrt(chdtri(3, 1.0 - share)))


def _rms(done: Done) -> float:
    return float(np.sqrt(np.mean(done.distances_mm**2)))


def _mean_truth(done: Done) -> float:
    return float(np.linalg.norm(done.truth_off_mm.mean(axis=0)))


def _first_truth(done: Done) -> float:
    return float(np.linalg.norm(done.truth_off_mm[0]))


def _exactly_beyond(done: Done) -> int:
    return int((done.distances_mm > LIMIT_MM).sum())


def always(*_: object) -> bool:
    """Nothing is wrong in this world."""
    return True


IN_WORDS = (ROOT / "tests/data/statements.toml").read_text(encoding="utf-8")
REQUIREMENTS = r"^Requirements, detector null"

KINDS = (
    # what is decided
    Kind("requirement met", "✓ met", lambda m, s, d: _met(s, d), REQUIREMENTS, "Verdict"),
    Kind(
        "requirement not met", "✕ not met", lambda m, s, d: _not_met(s, d), REQUIREMENTS, "Verdict"
    ),
    Kind(
        "blamed on the detector",
        N,
        lambda m, s, d: float(m[1]) > _exactly_beyond(d),
        r"^Whose it is",
        "^detector$",
        "further off",
    ),
    Kind("blamed on calibration", N, lambda m, s, d: float(m[1]) > 0, r"^Whose it is", "^calib"),
    Kind(
        "cameras not checked", r"Cameras not checked: .* \(0 of \d+ visible ends measured in .*\)\."
    ),
    # what is known of the errors
    Kind(
        "bias",
        rf"Is there a bias\? Hotelling's T² = {N}, p = {N}\.",
        lambda m, s, d: float(m[2].rstrip(".")) < 0.05,
    ),
    Kind(
        "bias, in words",
        r".*mm.*; (a bias is shown|no bias is shown)\.",
        lambda m, s, d: m[1] == "a bias is shown",
    ),
    Kind(
        "bias of a teat",
        rf"p = {N}",
        lambda m, s, d: float(m[1]) < 0.05,
        "Ellipsoids of the error",
        "is there a bias",
    ),
    Kind(
        "the mean error's part that is the truth's",
        rf"{N} mm, of which the truth may be {N} mm \(95 %; u along an axis of what all its ends"
        r" share: .*\).*\.",
        lambda m, s, d: _mean_truth(d) > float(m[2]),
    ),
    Kind(
        "squared error outside of chance",
        rf"Stated covariances, with the truth's: mean e' C⁻¹ e / 3 is {N} over \d+ ends, where 1 is as"
        rf" stated and chance leaves {N} to {N}(?: \(95 %, two-sided, with what the truths share\))?; above, the"
        r" detector claims to be surer than it is; below, it is too modest\.",
        lambda m, s, d: not float(m[2]) <= float(m[1]) <= float(m[3]),
    ),
    Kind("trend", r"(?:No trend is shown|Trend shown: .*)\.", lambda m, s, d: m[0][0] == "T"),
    Kind("trend, in the table", "trend shown", None, "Trends of the error", "trend"),
    Kind(
        "accepted along an axis",
        "accepted",
        lambda m, s, d: _largest(s, d) > LIMIT_MM,
        "^Errors along each axis",
    ),
    Kind(
        "refused along an axis",
        "refused",
        lambda m, s, d: _largest(s, d) <= LIMIT_MM,
        "^Errors along each axis",
    ),
    Kind("undecided along an axis", "between", None, "^Errors along each axis"),
    Kind(
        "tolerance limit",
        N,
        lambda m, s, d: float(m[1]) < _quantile(0.95 if s.row.startswith("95") else 0.99),
        "^Tolerance limits",
        "any distribution",
    ),
    Kind(
        "rms without the truth's noise",
        rf"The truth's noise alone would show {N} mm rms, at most {N} mm \(95 %, one-sided\), much of it common to"
        rf" all ends: without it the rms is {N} to {N} mm \(95 %, two-sided\)\.",
        lambda m, s, d: not float(m[3]) - 0.005 <= _rms(d) <= float(m[4]) + 0.005,
    ),
    Kind(
        "rms without the truth's noise",
        r"The truth's noise alone .*: without it the rms is at most ([\d.]+) mm \(97\.5 %, one-sided\): it may be all"
        r" that was seen\.",
        lambda m, s, d: _rms(d) > float(m[1]) + 0.005,
    ),
    # what is known of the truth
    Kind(
        "the truth is known to",
        rf"\d+ poses? (?:(?:was|were) tried:|without a failure) .* The truth is known to (?:± )?{N} mm(?: in 95 %)?\.",
        lambda m, s, d: _first_truth(d) > float(m[1]),
    ),
    Kind(
        "the truth is known to",
        rf"Every decision's guard band is that of .*: u = {N} mm along an axis; in space, an end is"
        rf" known to {N} mm in 95 %\.",
        lambda m, s, d: _first_truth(d) > float(m[2]),
    ),
    Kind("the arm's stated u", "too small", always, "^The arm's stated uncertainty"),
    Kind("the arm's stated u holds", "not refuted", None, "^The arm's stated uncertainty"),
    Kind("the arm's stated u", r".*no error is accepted by this guard band\.", always),
    Kind(
        "the arm's stated u",
        r".*(divots of the dated verification|lengths of the dated verification|check touches of"
        r" the run) differ as those of an arm of u = .*",
        always,
    ),
    Kind("the stage's axes", r"The stage's axes are worse than the rig file states.*", always),
    Kind("the registration's touches", r"The touches scatter more than their budget.*", always),
    Kind("a diagnostic of the stage", "yes", None, "^The stage's axes", "significant"),
    Kind("carry", "lost", always, "^Check touches", "carry"),
    Kind("carry", "held", None, "^Check touches", "carry"),
    # the same once more in words, what is seen, what explains: counted above
    *(Kind(kind, text) for kind, texts in tomllib.loads(IN_WORDS).items() for text in texts),
)


def unknown(page: str) -> list[Said]:
    """What may accuse or accept, and is in no row."""
    return [
        said for said in read(page) if said.judges and not any(kind.match(said) for kind in KINDS)
    ]


def counted(done: Done) -> dict[str, bool]:
    """By kind, of those that can be false: whether one of this page is."""
    found: dict[str, bool] = {}
    for said in read(done.page):
        for kind in KINDS:
            if kind.false is not None and (match := kind.match(said)) is not None:
                wrong = kind.false(match, said, done)
                name = f"{kind.name}: {said.row}" if kind.table == REQUIREMENTS else kind.name
                found[name] = found.get(name, False) or wrong
    return found


def rates(pages: Iterable[dict[str, bool]]) -> dict[str, tuple[int, int]]:
    """By kind: runs in which one was false, of the runs that said one."""
    found: dict[str, tuple[int, int]] = {}
    for page in pages:
        for name, wrong in page.items():
            false, said = found.get(name, (0, 0))
            found[name] = (false + wrong, said + 1)
    return found
