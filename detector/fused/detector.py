"""The bench's own detector: thermal nominates, optics localise, stereo decides. Every stage's
result is kept; an unusable frame set gives no teats and a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import reduce
from operator import add
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.fused import depth_search, refine, witness
from detector.fused.covariances import (
    end_covariances,
    stated,
    unaliased,
    variance_terms,
    world_covariances,
)
from detector.fused.decide import Decision, Fits, decide, means
from detector.fused.evidence import Evidence, warmth_across, weigh
from detector.fused.learned import learned
from detector.fused.left_out import left_out, outside, unsure_ends
from detector.fused.parameters import Parameters
from detector.fused.refits import doubts, shapes, unsure, whole_ends
from detector.fused.sharpness import Sharpness, blur_covariances, sharpness, too_blurred
from detector.fused.thermal import (
    ROOM_PX,
    Nominations,
    TeatTemplate,
    bars,
    levels,
    nominate,
    strengths,
    unexplained,
)
from detector.geometry import Array, Camera
from detector.history import predicted
from detector.outline import pictures
from detector.outline.fine import Fitted
from detector.outline.fit import CameraView, upright
from detector.outline.model import COUNT, apexes, axes
from detector.outline.offsets import thermal_offsets_far
from detector.outline.prior import (
    OutOfDomainError,
    Prior,
    depths_seen_mm,
    eyes_mm,
    right_from_teats,
    thermal_camera,
    world_from_teats,
)
from detector.outline.views import optical_views, thermal_view
from detector.protocol import Context, Detection, Frames, Stage, Teat

_SAME_MM, _CHI2_99 = 15.0, 11.345  # two answers on one end; 99 % of three degrees of freedom
_BESIDE_PX = np.array([-1.0, 0.0, 1.0])  # disparities about an expected end
_OPTICAL_BLUR_PX, _THERMAL_BLUR_PX = 1.5, 0.8  # as much as a start may be off
_MAYBE_END, _SOME_END = 4.0, 0.6  # odds below what is given, thermal score, of what has a sentence
LEARNED = learned()
_ROOM_ABOVE_MM = 110.0  # how far above a bar's visible part its end may be
# glibc keeps freed memory up to twice the largest block that was freed. Without this one the kernel
# clears some 2 000 pages anew for each frame set, a tenth of its time.
np.empty(1 << 24, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class FusedDetector:
    """Classical vision; what is learned are the weights of its decision and of its covariances."""

    settings: Parameters = field(default_factory=Parameters)
    name: str = "fused"  # in the registry
    version: str = "31"  # counted up when an answer on any frame set changes

    covariance_leaves_out: ClassVar[str] = (
        "what the ends of one frame have in common (each end has its own covariance); where the"
        " calibration states no uncertainty, all of its errors but 0.35 px of disparity; the"
        " thermal camera's pose; cameras that moved or warmed up since the calibration; motion"
        " between the frames of a set; an end taken for another's or for what is none; ends whose"
        " shape is further from half an ellipsoid than the parameters say"
    )

    def refuses(self, calibration: Calibration) -> str | None:
        """Why teats can't be found with this rig, whatever its pictures show, or None."""
        try:
            depths_seen_mm(calibration, self.settings.prior)
        except OutOfDomainError as why:
            return str(why)
        return None

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The settings by name."""
        return asdict(self.settings)

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends in the world frame with covariances, and the trace of every stage reached."""
        trace: list[Stage] = []
        try:
            return _detect(frames, calibration, self.settings, trace)
        except (pictures.UnusableError, OutOfDomainError) as why:
            return Detection((), 0, str(why), tuple(trace))

    def detect_with(self, frames: Frames, calibration: Calibration, context: Context) -> Detection:
        """As `detect`; where the cow's history expects ends that it doesn't give, these are where
        fits begin once more, and what is still unseen is predicted. Cameras that are known to be
        off widen the covariances.
        """
        answer = self.detect(frames, calibration)
        if expected := predicted(context, answer.teats):
            world = np.array([teat.world_mm for teat in expected.values()])
            ends = world_from_teats(calibration).inverse().apply(world)
            starts = upright(ends, calibration, _BESIDE_PX, self.settings.prior).reshape(-1, COUNT)
            with suppress(pictures.UnusableError):
                again = _detect(frames, calibration, self.settings, [], starts)
                if _as_expected(again, answer, expected):
                    answer, expected = again, predicted(context, again.teats)
            answer = replace(answer, predicted=tuple(expected.values()))
        if context.cameras:
            answer = witness.with_cameras_off(answer, context.cameras, calibration)
        return answer


def _as_expected(more: Detection, less: Detection, expected: Mapping[int, Teat]) -> bool:
    """Whether ``more`` has all ends of ``less`` and others that lie where some are expected."""
    old = np.array([teat.world_mm for teat in less.teats])
    new = [t for t in more.teats if np.linalg.norm(old - t.world_mm, axis=1).min() > _SAME_MM]

    def there(teat: Teat) -> bool:
        off = [(teat.world_mm - one.world_mm, _stated(one)) for one in expected.values()]
        return any(d @ np.linalg.solve(c + _stated(teat), d) < _CHI2_99 for d, c in off)

    return bool(new) and len(more.teats) == len(old) + len(new) and all(map(there, new))


def _stated(teat: Teat) -> Array:
    return np.zeros((3, 3)) if teat.covariance_mm2 is None else teat.covariance_mm2


@dataclass(frozen=True, slots=True, eq=False)
class _Thermal:
    """The thermal picture in sensor pixels, the delivered picture's lens, cold and warm levels."""

    view: CameraView
    lens: Camera
    px_a_sensor_px: float
    levels: Array  # (2,)
    depths_mm: tuple[float, float]
    sought: TeatTemplate

    @classmethod
    def of(cls, frames: Frames, calibration: Calibration, prior: Prior) -> _Thermal:
        """Raises UnusableError, OutOfDomainError."""
        depths_mm = depths_seen_mm(calibration, prior)
        view, camera = thermal_view(frames, calibration), calibration.thermal
        lens, _ = thermal_camera(calibration)
        size = camera.image_size[0] / camera.sensor_size[0]
        sought = TeatTemplate.of(view.camera, view.camera_from_teats, depths_mm, prior)
        return cls(view, lens, size, levels(view.field), depths_mm, sought)

    def px(self, points_mm: Array) -> Array:
        """Where the delivered picture shows points (k, 3) of the fits' frame."""
        return self.lens.project(self.view.camera_from_teats.apply(points_mm))


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """Fitted teats, what the pictures show of them, and what was decided of each."""

    fitted: Fitted
    evidence: Evidence
    decision: Decision

    @property
    def each(self) -> tuple[Array, Evidence, Decision]:
        """Teats (m, 8), and the rest."""
        return self.fitted.teats, self.evidence, self.decision


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """The pictures about the starts of fits, and the thermal picture's nominations."""

    views: tuple[CameraView, ...]
    thermal: _Thermal
    ends: Nominations
    calibration: Calibration
    p: Parameters

    def judged(self, fitted: Fitted, known: _Judged | None = None) -> _Judged:
        """Fits, and some that are judged already."""
        thermal, prior = self.thermal, self.p.prior
        view, size = thermal.view, thermal.px_a_sensor_px
        warmth = warmth_across(fitted.teats, view.field, thermal.lens, view.camera_from_teats, size)
        sds = end_covariances(fitted, self.p)
        evidence = weigh(fitted, sds, warmth, thermal.levels, self.views, prior)
        if known:
            fitted, evidence = known.fitted + fitted, known.evidence + evidence
        eyes = eyes_mm(self.calibration)
        return _Judged(fitted, evidence, decide(fitted.teats, evidence, LEARNED, prior, eyes))

    def unexplained(self, teats: Array, least: float) -> Array:
        """The ends (k, 2) sensor px of the thermal picture that are of none of teats (m, 8)."""
        thermal, tips = self.thermal, apexes(teats)
        feet_px, tips_px = (
            thermal.view.camera.project(thermal.view.camera_from_teats.apply(points))
            for points in (tips + 60.0 * axes(teats), tips)
        )
        field, sought = thermal.view.field, thermal.sought
        return unexplained(field, thermal.levels, self.ends, feet_px, tips_px, sought, least)


def _detect(
    frames: Frames,
    calibration: Calibration,
    p: Parameters,
    trace: list[Stage],
    more: Array | None = None,
) -> Detection:
    """``more`` teats (m, 8): where fits begin beside what the pictures suggest."""
    left = pictures.optical(frames.left, calibration.left.image_size, "left")
    right = pictures.optical(frames.right, calibration.right.image_size, "right")
    thermal = _Thermal.of(frames, calibration, p.prior)
    teats, scene = _start(thermal, left, right, calibration, p, trace, more)
    judged = _fit(teats, scene)
    # every fitted teat with evidence and objection, empty if accepted
    decision, evidence = judged.decision, judged.evidence
    shown = {"teats": judged.fitted.teats}
    shown |= {name: getattr(evidence, name) for name in Evidence.__slots__}
    shown["right_from_teats"] = right_from_teats(calibration).R
    shown["odds"] = decision.odds
    shown["reasons"] = np.array([reason or "" for reason in decision.reasons], dtype=np.str_)
    which = decision.accepted or np.flatnonzero(decision.by_witness).tolist()
    far_px = _far_px(judged, thermal.view)
    some, size = judged.fitted.take(which), thermal.px_a_sensor_px
    cameras = witness.agreement(some, far_px, calibration, p, size)
    shown["cameras_px"] = np.array([cameras.rows_px, *cameras.thermal_px])
    trace.append(Stage("decisions", shown))
    if wrong := witness.disagreement(cameras, judged.fitted, calibration):
        raise pictures.UnusableError(wrong)
    fitted = judged.fitted.take(decision.accepted)
    edges = sharpness(fitted, scene.views[:2])
    if wrong := too_blurred(edges):
        raise pictures.UnusableError(wrong)
    answers, said = (
        _answers(judged, cameras, edges, scene, trace)
        if decision.accepted
        else ((), ["nothing warm has the outline of a teat in both optical pictures"])
    )
    # what of the given lies outside of what teats are, and what isn't given
    given = Fits(fitted.teats, evidence.take(decision.accepted), p.prior)
    doubtful = decision.odds > LEARNED.least - _MAYBE_END
    thermal_px = thermal.px(apexes(judged.fitted.teats))
    warm_px = (scene.unexplained(fitted.teats, _SOME_END) + 0.5) * size - 0.5
    said += outside(given)
    said += left_out(
        judged.fitted.teats, decision, doubtful, thermal_px, warm_px, size, calibration
    )
    hidden = len(scene.unexplained(fitted.teats, LEARNED.limits["thermal end, counted"]))
    return Detection(answers, hidden, "; ".join(said) or None, tuple(trace))


def _far_px(judged: _Judged, view: CameraView) -> Array:
    """How far (k, 2) the thermal outlines of ends that both optical pictures show whole are off,
    sensor px, if near most of them there is none; not-a-number where there is none at all.
    """
    whole = whole_ends(*judged.each)
    if 2 * np.isfinite(judged.evidence.thermal_px[whole]).all(axis=1).sum() > len(whole):
        return np.zeros((0, 2))
    return thermal_offsets_far(judged.fitted.teats[whole], view)


def _fit(teats: Array, scene: _Scene) -> _Judged:
    """Fit and judge; again without what a neighbour may have bridged, where ends may be too high or
    low, or not of the usual shape, without lines of other things, and from beside what is unsure.
    """
    views, p, limits = scene.views, scene.p, LEARNED.limits
    judged = _from_starts(teats, scene)
    bridging, shifted = doubts(*judged.each, limits, p)
    more = [
        again(judged.fitted.teats[rows], views, p)
        for rows, again in ((bridging, refine.one_sided), (shifted, refine.along_sides))
        if rows
    ]
    if more:
        judged = scene.judged(reduce(add, more), judged)
    if unlike := shapes(*judged.each, limits, p):
        usual = np.delete(np.arange(len(judged.fitted.teats)), unlike)
        again = refine.shaped_again(judged.fitted.take(unlike), views, p)
        rest = replace(
            judged, fitted=judged.fitted.take(usual), evidence=judged.evidence.take(usual)
        )
        judged = scene.judged(again, rest)
    # what goes on beyond the end is no side of a teat, but a rod's or a leg's line
    lines = judged.evidence.lines_mm > limits["side goes on, mm"]
    if rows := [i for i in judged.decision.accepted if lines[i].any()]:
        again = refine.without_lines(judged.fitted.take(rows), lines[rows], views, p.prior)
        judged = scene.judged(again, judged)
    if rows := unsure(*judged.each, limits, p):
        beside = refine.from_beside(judged.fitted.take(rows), views, p, scene.calibration)
        judged = scene.judged(beside, judged)
    return judged


def _from_starts(teats: Array, scene: _Scene) -> _Judged:
    """What the first of starts ``teats`` (m, 8) lead to; and the rest, unless that is an udder of
    teats beyond doubt and explains all that is warm.
    """
    judged, p, counted = None, scene.p, LEARNED.limits["thermal end, counted"]
    for some in (teats[: p.first_starts], teats[p.first_starts :]):
        fitted = refine.refine(some, scene.views, p, judged.fitted if judged else None)
        if fitted is None:
            continue
        judged = scene.judged(fitted, judged)
        accepted = judged.decision.accepted
        beyond = (
            judged.decision.odds[accepted] > LEARNED.least + LEARNED.limits["odds beyond doubt"]
        )
        given = judged.fitted.teats[accepted]
        if (
            len(accepted) == p.prior.udder
            and beyond.all()
            and not len(scene.unexplained(given, counted))
        ):
            break
    if judged is None:
        why = "the optical pictures show no outline where the thermal one is warm"
        raise pictures.UnusableError(why)
    return judged


def _start(
    thermal: _Thermal,
    left: NDArray[Any],
    right: NDArray[Any],
    calibration: Calibration,
    p: Parameters,
    trace: list[Stage],
    more: Array | None,
) -> tuple[Array, _Scene]:
    warm = thermal.view.field
    gradients = strengths(warm, border=ROOM_PX)
    ends = nominate(gradients, p.most_nominations, thermal.sought)
    clear = LEARNED.limits["thermal end, clear"]
    upright = bars(warm, gradients, thermal.levels, ends, p.most_bars, thermal.sought, clear)
    shown = {
        f"{what}_{name.removeprefix('centre_')}": getattr(found, name)
        for what, found in (("end", ends), ("bar", upright))
        for name in ("centre_px", "radius_px", "score")
    }
    trace.append(Stage("thermal", {"warmth": warm, **shown}))
    if len(ends) + len(upright) == 0:
        raise pictures.UnusableError("the thermal picture shows nothing like a teat")
    depth_mm, down = depth_search.depths_mm(calibration, thermal.depths_mm), thermal.sought.down
    from_thermal = thermal.view.camera_from_teats.inverse()
    of_ends, of_bars = (
        depth_search.hypotheses(
            n, thermal.lens, thermal.px_a_sensor_px, from_thermal, depth_mm, down
        )
        for n in (ends, upright)
    )
    above = of_bars - [0, _ROOM_ABOVE_MM, 0, 0, 0, 0, 0, 0]
    guesses = np.concatenate(
        [teats[depth_search.of_teats(teats, p)] for teats in (of_ends, above, of_bars)]
    )
    views = optical_views(left, right, calibration, guesses, noise=1.0)
    maps = tuple(depth_search.Map.of(view, _OPTICAL_BLUR_PX) for view in views)
    coarse = depth_search.Map.of(thermal.view, _THERMAL_BLUR_PX)
    by_end = depth_search.sweep_ends(of_ends, ends.score, maps, p)
    by_sides = depth_search.sweep_bars(of_bars, upright.score, maps, coarse, p)
    teats = depth_search.best_starts(by_end, by_sides, maps, p)
    teats = teats if more is None else np.concatenate([more, teats])
    trace.append(Stage("starts", {"teats": teats}))
    near = optical_views(left, right, calibration, teats) if len(teats) else views
    return teats, _Scene((*near, thermal.view), thermal, ends, calibration, p)


def _answers(
    judged: _Judged, cameras: witness.Agreement, edges: Sharpness, scene: _Scene, trace: list[Stage]
) -> tuple[tuple[Teat, ...], list[str]]:
    """Accepted ends with covariances, the calibration's included, and their pixels; and what is
    said of unsure ones.
    """
    rows, calibration, p = judged.decision.accepted, scene.calibration, scene.p
    accepted, evidence = judged.fitted.take(rows), judged.evidence.take(rows)
    fitted, own = unaliased(accepted, p)
    teats, turned = fitted.teats, right_from_teats(calibration)
    mean, between = means(apexes(judged.fitted.teats), judged.decision.odds, rows)
    found = apexes(teats) + mean - apexes(accepted.teats)
    ends, down = turned.apply(found), axes(teats) @ turned.R.T
    world = calibration.world_from_right.apply(ends)
    own = own + end_covariances(fitted, p)
    unstated = witness.unstated_covariances(ends, calibration, p)
    px_a_mm = calibration.right.fc[0] / ends[:, 2]
    rest = witness.disagreement_covariances(cameras, ends, calibration, p)
    rest += blur_covariances(edges, down, ends, px_a_mm, calibration.baseline_mm)
    odds, fits = judged.decision.odds[rows], Fits(teats, evidence, p.prior)
    terms = variance_terms(own, between, odds, fits, calibration)
    shown = {"rows": np.array(rows), "teats": teats, "ends": found, "terms": terms}
    trace.append(Stage("answers", shown | {"rest": turned.R.T @ (unstated + rest) @ turned.R}))
    own = turned.R @ stated(terms, LEARNED) @ turned.R.T + rest
    covariances = world_covariances(own + unstated, ends, calibration)
    pixels = *calibration.project(world), scene.thermal.px(found)
    answers = tuple(Teat(*each) for each in zip(world, covariances, *pixels, strict=True))
    return answers, unsure_ends(pixels[0], own, p.prior)
