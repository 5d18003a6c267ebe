"""A chunk of a campaign: scenes drawn, detected and scored without writing a frame.

The rows depend on the scene, the seed, the cameras, the calibration and the detectors alone, not on
which scenes came before, on which process or machine, or how busy that was. So an answer within
a process is never too late here, its time is only measured; a program as detector has limits of its
own (docs/detectors.md).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from bench.campaign.perturbations import Applied
from bench.record.recording import FIELDS, TruthRow
from bench.results.answers import LIMIT_MM, Answer, examine, score_answer
from bench.rig.scenes import DrawnScene, draw, renderer_of, warm
from bench.scoring.scene import SceneScore
from detector.calibration import Calibration, ParameterCovariance
from detector.protocol import Detector, Outcome, Teat
from instruments.camera.frame import FrameSet
from instruments.clock import processor_s, stopwatch_s
from instruments.world.draws import Parameter
from instruments.world.scene import Renderer
from instruments.world.setups import Situation
from instruments.world.situations import member as member_of

ASIDE = "set aside"  # no failure of the detector: the bench could not do the scene
DIGEST_BYTES = 8  # of SHA-256: a million scenes have the same one with a chance of 3e-8
# an answer is sure and wrong where it is farther than both of these from a true end
WRONG_MM, WRONG_SD = 3.0, 4.0
FALSE_SD_MM = 1.0  # a false answer is sure where it states no more
CHI2_95_OF_3 = 7.815  # 95 % of true statements have a NEES below
EXACT = ParameterCovariance((), np.zeros((0, 0)))
SHARES = 255  # a parameter's share of its range is kept in so many steps


@dataclass(frozen=True, slots=True, order=True)
class SceneId:
    """A member of a family."""

    family: str
    member: int

    @property
    def name(self) -> str:
        """As `scene record` calls its frame."""
        return f"{self.family}-{self.member:04d}"


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What is the same for all scenes; made once a process. ``exact``: the cameras are drawn by the
    calibration, which states no uncertainty, so detectors get it as exact.
    """

    renderer: Renderer
    calibration: Calibration
    detectors: Sequence[Detector]
    seed: int
    limit_mm: float = LIMIT_MM
    perturbations: Sequence[Applied] = ()
    exact: bool = False


@dataclass(frozen=True, slots=True)
class SceneRow:
    """One scene and detector, in counts of teat ends (docs/campaigns.md). ``failure`` is the
    gravest: `ASIDE`, an outcome without an answer, false, missed, error, or empty.
    """

    family: str
    member: int
    detector: str
    visible: int
    hidden: int
    found: int
    missed: int
    false_teats: int
    hidden_claimed: int | None
    max_mm: float | None
    mean_mm: float | None
    failure: str
    frames: str
    sure_wrong: int = 0
    stated: int = 0
    inside: int = 0
    nees: float | None = None
    parameters: str = ""
    shares: Sequence[int] = ()


@dataclass(frozen=True, slots=True)
class TeatRow:
    """One teat of a scene, or a false finding (``teat`` 0): found, missed, false, hidden, or hidden
    found. Errors are found - truth; nees is e' C^-1 e, 3 on average where C is true.
    """

    family: str
    member: int
    detector: str
    teat: int
    status: str
    x_mm: float | None = None
    y_mm: float | None = None
    z_mm: float | None = None
    sd_x_mm: float | None = None
    sd_y_mm: float | None = None
    sd_z_mm: float | None = None
    nees: float | None = None


@dataclass(frozen=True, slots=True)
class CallTime:
    """What of a detection differs from run to run: seconds, real and of the processor (None for a
    detector elsewhere), and the words of one without an answer.
    """

    seconds: float
    cpu_s: float | None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class ChunkRows:
    """The rows of some scenes; ``taken`` belongs to ``scenes``. Times include drawing."""

    scenes: tuple[SceneRow, ...] = ()
    teats: tuple[TeatRow, ...] = ()
    taken: tuple[CallTime, ...] = ()
    cpu_s: float = 0.0
    seconds: float = 0.0

    def __add__(self, other: ChunkRows) -> ChunkRows:
        names = [field.name for field in fields(self)]
        return ChunkRows(*(getattr(self, name) + getattr(other, name) for name in names))


def run_scene(bench: Bench, scene: SceneId) -> ChunkRows:
    """The rows of one scene. Raises ValueError."""
    started_s, used_before_s = stopwatch_s(), processor_s()
    found, parameters = member_of(scene.family, scene.member)
    drawn, stated = draw_scene(bench, scene, found)
    digest, shares = digest_of_frames(drawn.frames), [_share(one) for one in parameters.values()]
    rows: list[SceneRow] = []
    teats: list[TeatRow] = []
    taken: list[CallTime] = []
    for detector in bench.detectors:
        answer = examine(detector, drawn.frames, stated, timeout_s=math.inf)
        score = score_answer(answer, drawn.truth, limit_mm=bench.limit_mm, time_limit_s=math.inf)
        ends = list(_teat_rows(scene, answer, score, drawn))
        counts, distances = score.counts, score.radial_mm
        nees = [one.nees for one in ends if one.status == "found" and one.nees is not None]
        rows.append(
            SceneRow(
                scene.family,
                scene.member,
                answer.detector,
                counts.visible,
                counts.hidden,
                counts.matched,
                counts.missed,
                counts.false,
                score.hidden_claimed,
                _stored(max(distances)) if distances else None,
                _stored(math.fsum(distances) / len(distances)) if distances else None,
                _failure(answer, score),
                digest,
                sum(map(_sure_wrong, ends)),
                len(nees),
                sum(one < CHI2_95_OF_3 for one in nees),
                _stored(math.fsum(nees) / len(nees)) if nees else None,
                ",".join(parameters),
                shares,
            )
        )
        teats += ends
        reason = None if answer.outcome is Outcome.ANSWERED else answer.detection.reason
        taken.append(CallTime(answer.seconds, answer.cpu_s, reason))
    used_s, passed_s = processor_s() - used_before_s, stopwatch_s() - started_s
    return ChunkRows(tuple(rows), tuple(teats), tuple(taken), used_s, passed_s)


def draw_scene(bench: Bench, scene: SceneId, found: Situation) -> tuple[DrawnScene, Calibration]:
    """The frames of a scene, perturbed, with its truth; and the calibration that detectors get.
    Raises ValueError for one that can't be drawn before these cameras.
    """
    seeds = (bench.seed, scene.member, *scene.family.encode())
    rig = bench.calibration
    for perturbation in bench.perturbations:
        rig = perturbation.rig(rig, seeds)
    stated, renderer = rig, bench.renderer
    if rig is not bench.calibration:
        renderer = renderer_of(rig, bench.renderer, bench.seed)
    for perturbation in bench.perturbations:
        stated = perturbation.stated(stated)
    own = [bench.seed, scene.member]
    drawn = draw(renderer, scene.family, warm(found), own, bench.perturbations, seeds)
    if bench.exact and stated is rig:
        stated = replace(stated, covariance=EXACT)
    return drawn, stated


def set_aside(scene: SceneId, detectors: Iterable[str], why: str) -> ChunkRows:
    """The rows of a scene that the bench could not do: no detector's failure."""
    nothing = (0, 0, 0, 0, 0, None, None, None, ASIDE, "")
    rows = tuple(SceneRow(scene.family, scene.member, name, *nothing) for name in detectors)
    return ChunkRows(rows, (), tuple(CallTime(0.0, None, why) for _ in rows))


def digest_of_frames(frames: FrameSet) -> str:
    """The start of the SHA-256 of all pictures' pixels, in hex."""
    whole = hashlib.sha256()
    for picture in (getattr(frames, field) for field in FIELDS):
        if picture is not None:
            whole.update(picture.tobytes())
    return whole.hexdigest()[: 2 * DIGEST_BYTES]


def _sure_wrong(end: TeatRow) -> bool:
    """Whether a detector is far off by its own account of how sure it is."""
    if end.status == "false":
        sd = (end.sd_x_mm, end.sd_y_mm, end.sd_z_mm)
        return None not in sd and max(one for one in sd if one is not None) < FALSE_SD_MM
    if end.nees is None or end.x_mm is None or end.y_mm is None or end.z_mm is None:
        return False
    return end.nees > WRONG_SD**2 and math.hypot(end.x_mm, end.y_mm, end.z_mm) > WRONG_MM


def _share(parameter: Parameter) -> int:
    width = parameter.high - parameter.low
    return round(SHARES * (parameter.value - parameter.low) / width) if width else 0


def _failure(answer: Answer, score: SceneScore) -> str:
    if answer.outcome is not Outcome.ANSWERED:
        return str(answer.outcome.value)
    if score.counts.false:
        return "false"
    if score.counts.missed:
        return "missed"
    return "" if score.success else "error"


def _teat_rows(
    scene: SceneId, answer: Answer, score: SceneScore, drawn: DrawnScene
) -> Iterable[TeatRow]:
    match, teats = score.match, answer.detection.teats
    answered = {j: ("found", teats[i]) for i, j in match.pairs}
    answered |= {j: ("hidden found", teats[i]) for i, j in match.hidden_pairs}
    for j, truth in enumerate(drawn.truth):
        key = (scene.family, scene.member, answer.detector, j + 1)
        if j in answered:
            status, teat = answered[j]
            yield TeatRow(*key, status, *_figures(teat, truth))
        else:
            yield TeatRow(*key, "missed" if truth.visible else "hidden")
    for i in match.false:
        key = (scene.family, scene.member, answer.detector, 0)
        yield TeatRow(*key, "false", None, None, None, *_sd(teats[i]))


def _figures(teat: Teat, truth: TruthRow) -> tuple[float | None, ...]:
    """Error and sd along the three axes, and NEES."""
    error = np.asarray(teat.world_mm) - np.asarray(truth.xyz_mm)
    stored = map(_stored, error.tolist())
    if teat.covariance_mm2 is None:
        return tuple(stored)
    nees = float(error @ np.linalg.solve(teat.covariance_mm2, error))
    return (*stored, *_sd(teat), _stored(nees))


def _sd(teat: Teat) -> tuple[float | None, ...]:
    """Along the three axes, as stated."""
    if teat.covariance_mm2 is None:
        return (None, None, None)
    return tuple(_stored(value) for value in np.sqrt(np.diagonal(teat.covariance_mm2)).tolist())


def _stored(value: float) -> float:
    """As a shard holds it: 32 bits, 7 digits."""
    return float(np.float32(value))
