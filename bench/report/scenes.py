"""Scenes of a campaign drawn and answered again: as trials that a page shows, and as a page of
their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from bench.campaign.chunk import Bench, SceneId, digest_of_frames, draw_scene
from bench.campaign.plan import CampaignPlan, differences, open_plan
from bench.campaign.run import plan_of
from bench.campaign.shards import Shards
from bench.config import ConfigError, several, writing
from bench.files import write_pictures
from bench.record.reader import RunRecord, TrialRecord
from bench.report.chapters import page_of
from bench.report.trials import trial_part
from bench.results.answers import close_detectors, examine, score_answers
from bench.run.rows import detection_tables
from bench.scoring.comparison import why_failed
from bench.truth.touching import truth_row
from detector.calibration import Calibration
from instruments.world.situations import SITUATIONS, member
from reports.page import Banner, Page, TrialPart
from reports.render import write_report
from textfiles.text import plural, range_text

SCENES = "scenes"  # in a campaign's folder: the frames of each scene that was drawn again
OF_A_RUN = ("repeat", "bath at capture", "teats' surface")  # which a scene has not
NOTHING = dict.fromkeys(("captured_s", "bath_c", "bath_state", "note", "invalid"))


def draw_again(
    bench: Bench, scenes: Sequence[SceneId], folder: Path, title: str
) -> tuple[RunRecord, Calibration]:
    """The scenes as the trials of a run, with their frames in ``folder``/scenes, and the
    calibration that detectors were given. Raises OSError.
    """
    trials, stated = [], bench.calibration
    for number, scene in enumerate(scenes, 1):
        drawn, stated = draw_scene(bench, scene, member(scene.family, scene.member)[0])
        taken = drawn.frames
        pictures = {"left": taken.left, "right": taken.right}
        pictures |= {} if taken.thermal is None else {"thermal": taken.thermal}
        at = {camera: folder / SCENES / scene.name / f"{camera}.png" for camera in pictures}
        write_pictures({path: pictures[camera] for camera, path in at.items()})
        answers = [examine(one, taken, stated, timeout_s=math.inf) for one in bench.detectors]
        scores = score_answers(answers, drawn.truth, limit_mm=bench.limit_mm, time_limit_s=math.inf)
        detections, found = detection_tables(scene.name, answers)
        head = {"id": scene.name, "name": scene.name, "number": number, "repeat": 1}
        head |= {**NOTHING, "situation": scene.family, "frames": digest_of_frames(taken)}
        frames = [
            {"camera": camera, "path": path.relative_to(folder / SCENES).as_posix()}
            for camera, path in at.items()
        ]
        truth = [{**truth_row(scene.name, row), "budget": None} for row in drawn.truth]
        trials.append(TrialRecord(head, frames, [], truth, detections, found, scores))
    names = [one.name for one in bench.detectors]
    facts = {"kind": "emulated", "title": title, "detectors": names, "ending": "finished"}
    return RunRecord(folder / SCENES, facts, tuple(trials)), stated


def scene_parts(run: RunRecord, stated: Calibration, folder: Path) -> Iterator[TrialPart]:
    """A part a scene for a page in ``folder``, which is in the campaign's or in its ``scenes``."""
    up = "../" if folder.parent == run.folder else f"../{run.folder.name}/"
    for trial in run.trials:
        part = trial_part(run, trial, stated, folder, up)
        about = ("what it is", SITUATIONS[str(trial.head["situation"])][0])
        summary = (about, *(entry for entry in part.summary if entry[0] not in OF_A_RUN))
        yield replace(part, summary=summary)


def show_scenes(
    folder: Path | str, names: Sequence[str]
) -> tuple[Path, list[tuple[str, str, str]]]:
    """Write a page of scenes of a campaign, named as ideal-0003; gives back its path, and scene,
    detector and outcome of each answer. Raises ConfigError, also where this version draws other
    pictures.
    """
    folder, names = Path(folder), several("names", names, 1)
    plan, scenes = plan_of(folder), []
    for name in dict.fromkeys(names):
        family, _, number = name.rpartition("-")
        last = plan.first + plan.most_scenes - 1
        inside = number.isdecimal() and plan.first <= int(number) <= last
        if family not in plan.families or not inside:
            example = SceneId(plan.families[0], plan.first).name
            raise ConfigError.plain(
                f"{folder} has no scene {name!r}; it has members {range_text(plan.first, last)} of"
                f" {', '.join(plan.families)}, named as {example}"
            )
        scenes.append(SceneId(family, int(number)))
    job, made_by = open_plan(plan)
    detectors = job.make_detectors()
    title = plan.title or "Campaign"
    try:
        with writing(folder):
            bench = job.bench(job.renderer(), detectors)
            run, stated = draw_again(bench, scenes, folder, title)
            _refuse_changed(folder, run, differences(plan, plan.made_by, plan, made_by))
            place = folder / SCENES / (names[0] if len(names) == 1 else "several")
            parts = tuple(scene_parts(run, stated, place))
            outcomes = [
                (trial.id, name, "success" if score.success else why_failed(score))
                for trial in run.trials
                for name, score in trial.scores.items()
            ]
            path = write_report(_page(plan, run, parts, outcomes), place)
    finally:
        close_detectors(detectors)
    return path, outcomes


def _refuse_changed(folder: Path, run: RunRecord, why: str) -> None:
    """Raises ConfigError for frames that differ from those that were scored."""
    with Shards(folder).connect() as db:
        for trial in run.trials:
            family, _, number = trial.id.rpartition("-")
            row = db.execute(
                "SELECT frames FROM scenes WHERE family = ? AND member = ?", [family, int(number)]
            ).fetchone()
            if row and row[0] and row[0] != trial.head["frames"]:
                raise ConfigError.plain(
                    f"{trial.id} is drawn differently now than when it was scored:\n{why}\nGo back"
                    f" to what made {folder}, or run the campaign again."
                )


def _page(
    plan: CampaignPlan,
    run: RunRecord,
    parts: tuple[TrialPart, ...],
    outcomes: Sequence[tuple[str, str, str]],
) -> Page:
    banner = Banner(
        kind="emulated",
        verdict="no verdict",
        tested=f"{', '.join(run.detectors)} on {plural(len(run.trials), 'scene')} of a campaign.",
        sentence="\n".join(f"{scene}, {name}: {outcome}." for scene, name, outcome in outcomes),
        confidence=(
            "Drawn again from family, member and seed; the same pixels as those that were scored."
        ),
        next_action="Switch layers off to see the frames; a click on one opens it whole.",
    )
    perturbed = ", ".join(f"{one.name} {one.amount:g}" for one in plan.perturbations)
    made = {"seed": plan.seed, "limit": f"{plan.limit_mm:g} mm"}
    made |= {"perturbations": perturbed} if perturbed else {}
    made |= plan.made_by
    return page_of(
        ", ".join(trial.id for trial in run.trials[:3]),
        f"{run.facts['title']}: frames, truth and answers",
        banner,
        {},
        {},
        glossary=(),
        trials=parts,
        detectors=tuple(run.detectors),
        trials_title="Frames",
        footer=("; ".join(f"{name} {value}" for name, value in made.items()),),
    )
