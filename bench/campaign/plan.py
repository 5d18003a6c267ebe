"""The plan of a campaign: its scenes, detectors and their calibration; its chunks; and what has to
be the same for a campaign to go on.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, field_validator, model_validator

import detector
import instruments.world
from bench.campaign.chunk import Bench, SceneId
from bench.campaign.perturbations import Applied
from bench.config import (
    ConfigError,
    FileTable,
    Positive,
    checked,
    read_calibration,
    read_config,
    read_text,
    toml_table,
)
from bench.results.answers import LIMIT_MM
from bench.rig.loading import find_rig, load_rig
from bench.rig.model import EmulatedDepth, EmulatedOptical, EmulatedThermal, make_renderer
from bench.rig.scenes import chosen
from bench.scoring.rates import Rate
from bench.scoring.sequential import confidence_sequence
from bench.script.detectors import EXEC, FILE, introduced, make_detectors
from bench.toml import toml_text
from bench.version import __version__, versions
from detector.calibration import Calibration
from detector.protocol import Detector
from instruments.world.scene import Renderer

SCENES = 100  # of a family, where no width is to be reached
MOST_SCENES = 20_000  # of a family, where one is
CHUNK_SCENES = 50  # some 9 s of fused
LEAST_CHUNKS = 4  # of a small plan
DETECTORS = ("fused",)
LIBRARIES = ("numba", "numpy", "opencv-python-headless", "scipy")
# what makes a scene's rows, beside the libraries
MAKES_ROWS = (
    *(Path(detector.__file__).parent, Path(instruments.world.__file__).parent),
    *(
        Path(__file__).parents[1] / name
        for name in (
            *("campaign/chunk.py", "campaign/perturbations.py"),
            *("rig/scenes.py", "results/answers.py", "scoring/scene.py"),
            *("scoring/matching.py", "scoring/errors.py"),
        )
    ),
)


class CampaignPlan(FileTable):
    """A file of a campaign. ``scenes`` are of each family, with ``half_width`` at most so many.
    Files are named from the plan's folder; 0 ``chunk_scenes`` suit the number of scenes.
    """

    title: str = ""
    families: Annotated[tuple[str, ...], Field(validate_default=True)] = ()
    scenes: Annotated[int, Field(ge=1, le=10_000_000)] | None = None
    half_width: Annotated[float, Field(gt=0, lt=0.5)] | None = None
    first: Annotated[int, Field(ge=0, le=1_000_000_000)] = 0
    seed: Annotated[int, Field(ge=0, le=2**62)] = 1
    detectors: Annotated[tuple[str, ...], Field(min_length=1)] = DETECTORS
    rig: str = "emulated"
    calibration: str = ""
    limit_mm: Positive = LIMIT_MM
    optical: EmulatedOptical = EmulatedOptical()
    thermal: EmulatedThermal = EmulatedThermal()
    depth: EmulatedDepth = EmulatedDepth()
    perturbations: tuple[Applied, ...] = ()
    chunk_scenes: Annotated[int, Field(ge=0, le=10_000)] = 0
    chunk_limit_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    made_by: dict[str, str] = Field(default_factory=dict)

    @field_validator("families")
    @classmethod
    def _families(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return chosen(names)
        except ConfigError as error:
            raise ValueError(str(error)) from None

    @field_validator("detectors")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(names))

    @model_validator(mode="after")
    def _chunks_that_suit(self) -> Self:
        if not self.chunk_scenes:
            every = len(self.families) * self.most_scenes
            most = min(self.most_scenes, CHUNK_SCENES, every // LEAST_CHUNKS)
            object.__setattr__(self, "chunk_scenes", max(most, 1))
        return self

    @property
    def most_scenes(self) -> int:
        """Scenes of a family, at most."""
        return self.scenes or (SCENES if self.half_width is None else MOST_SCENES)

    @property
    def chunks_a_family(self) -> int:
        return -(-self.most_scenes // self.chunk_scenes)

    @property
    def chunk_count(self) -> int:
        return len(self.families) * self.chunks_a_family

    def interval(self, failures: int, scenes: int) -> tuple[float, float] | None:
        """The 95 % interval of a failure rate, with ``half_width`` one that holds at every look."""
        if self.half_width is not None and scenes:
            return confidence_sequence(failures, scenes)
        return Rate(failures, scenes).interval()

    def chunk(self, number: int) -> Chunk:
        """Chunk ``number`` of all, from 0; the families take turns."""
        part, family = divmod(number, len(self.families))
        start = self.first + part * self.chunk_scenes
        return Chunk(self.families[family], part, range(start, start + self.scenes_of(part)))

    def asked_of(self) -> dict[str, range]:
        """Family -> members."""
        these = range(self.first, self.first + self.most_scenes)
        return dict.fromkeys(self.families, these)

    def scenes_of(self, part: int) -> int:
        """Scenes of chunk ``part`` of a family: the last may have fewer."""
        return min(self.chunk_scenes, self.most_scenes - part * self.chunk_scenes)

    def chunks(self) -> Iterator[Chunk]:
        """All chunks, in order."""
        return map(self.chunk, range(self.chunk_count))


@dataclass(frozen=True, slots=True)
class Chunk:
    """Members of one family that are worked on together; ``number`` counts in the family."""

    family: str
    number: int
    members: range

    @property
    def scenes(self) -> tuple[SceneId, ...]:
        return tuple(SceneId(self.family, member) for member in self.members)

    @property
    def name(self) -> str:
        return f"{self.family}-{self.number:06d}"


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A plan opened, without a file: ``cameras`` is the table that frames are drawn by, ``stated``
    the detectors' calibration (``exact``: the same); the plan's sensors are whole.
    """

    plan: CampaignPlan
    cameras: Mapping[str, Any]
    stated: Calibration
    detector_names: tuple[str, ...]
    exact: bool = False

    def renderer(self) -> Renderer:
        plan = self.plan
        return make_renderer(self.cameras, plan.seed, plan.optical, plan.thermal, plan.depth)

    def make_detectors(self) -> list[Detector]:
        """New ones: what a program did in one chunk changes nothing in another."""
        return make_detectors(self.plan.detectors, gives_up=False)

    def bench(self, renderer: Renderer, detectors: list[Detector]) -> Bench:
        plan, changes = self.plan, self.plan.perturbations
        return Bench(
            renderer, self.stated, detectors, plan.seed, plan.limit_mm, changes, self.exact
        )


def read_plan(path: Path) -> CampaignPlan:
    """The plan at ``path``, with whole paths. Raises ConfigError with all its faults."""
    return with_whole_paths(read_config(path, CampaignPlan), path.parent)


def with_whole_paths(plan: CampaignPlan, folder: Path) -> CampaignPlan:
    """The plan with every file named from the root, so that it may be stored elsewhere."""

    def whole(name: str) -> str:
        if not name.endswith(FILE) or name.startswith(EXEC):
            return name
        return (folder / name).resolve().as_posix()

    detectors = tuple(map(whole, plan.detectors))
    calibration, rig = whole(plan.calibration), whole(plan.rig)
    changed = {"detectors": detectors, "calibration": calibration, "rig": rig}
    return plan.model_copy(update=changed)


def make_plan(plan: CampaignPlan | Path | str | Mapping[str, Any]) -> CampaignPlan:
    """A plan of its file, or of its keys (docs/campaigns.md). Raises ConfigError."""
    if isinstance(plan, CampaignPlan):
        return plan
    if isinstance(plan, str | Path):
        return read_plan(Path(plan))
    return with_whole_paths(checked(CampaignPlan, plan), Path())


def open_plan(plan: CampaignPlan) -> tuple[Job, dict[str, str]]:
    """The plan's job, and the identity of the rows that it makes. Raises ConfigError, also for
    scenes that a detector was trained on.
    """
    rig = load_rig(find_rig(plan.rig))
    if plan.calibration and not plan.calibration.endswith(FILE):
        raise ConfigError.plain(f"calibration {plan.calibration!r}: name a .toml file")
    true = rig.calibration
    stated = read_calibration(Path(plan.calibration)) if plan.calibration else true
    detectors = make_detectors(plan.detectors)
    with introduced(detectors, plan.asked_of(), stated):
        devices = {one.name: getattr(one, "device", "") for one in detectors}
    sensors = {
        name: getattr(rig.rig.emulation, name).model_copy(
            update=getattr(plan, name).model_dump(exclude_none=True)
        )
        for name in ("optical", "thermal", "depth")
    }
    cameras = read_text(rig.calibration_path)
    stated_text = read_text(Path(plan.calibration)) if plan.calibration else cameras
    job = Job(
        plan.model_copy(update=sensors),
        toml_table(rig.calibration_path, cameras),
        stated,
        tuple(one.name for one in detectors),
        exact=not plan.calibration and true.covariance is None,
    )
    used = "".join(
        one.model_dump_json() for name, one in sensors.items() if name != "depth" or true.depth
    )
    same = {
        **of_program(),
        "rig": f"{Path(plan.rig).stem} {digest_of(cameras, used)}",
        "calibration": digest_of(stated_text),
        "detectors": ", ".join(
            f"{one.name} {one.version} {digest_of(repr(sorted(one.parameters.items())))}"
            + (f" on {devices[one.name]}" if devices[one.name] else "")
            for one in detectors
        ),
        "plan": digest_of(repr(_asked(plan))),
    }
    return job, same


def _asked(plan: CampaignPlan) -> list[tuple[str, Any]]:
    """What a plan asks for, beyond what is in its files and how it is worked on."""
    left_out = {"title", "rig", "calibration", "optical", "thermal", "depth", "chunk_limit_s"}
    left_out |= {"made_by"}
    asked = plan.model_dump(mode="json", exclude=left_out)
    return sorted({**asked, "scenes": plan.most_scenes}.items())


@cache
def of_program() -> dict[str, str]:
    """Versions of all that makes rows: release and source files of the program, and libraries."""
    files = [
        path
        for place in MAKES_ROWS
        for path in (
            sorted([*place.rglob("*.py"), *place.rglob("*.json")]) if place.is_dir() else [place]
        )
    ]
    source = digest_of(*(path.read_text(encoding="utf-8") for path in files))
    libraries = ", ".join(f"{name} {one}" for name, one in versions(LIBRARIES).items())
    return {"teatbench": f"{__version__} {source}", "libraries": libraries}


def digest_of(*texts: str) -> str:
    """The start of the SHA-256 of all texts, 16 characters."""
    whole = hashlib.sha256()
    for text in texts:
        whole.update(hashlib.sha256(text.encode("utf-8")).digest())
    return whole.hexdigest()[:16]


def plan_text(plan: CampaignPlan, made_by: Mapping[str, str]) -> str:
    """The plan as a file, with what makes its rows."""
    usual = CampaignPlan().model_dump(mode="json", exclude={"families", "seed", "detectors"})
    table = plan.model_dump(mode="json", exclude={"made_by"}, exclude_none=True)
    del usual["chunk_scenes"]  # chosen by other keys
    kept = {key: value for key, value in table.items() if value != usual.get(key)}
    heading = (
        "A campaign of teatbench. [made_by] has to be the same for the campaign to go on; a new"
        " campaign\nmay be made of this file: it is left out then."
    )
    kept = {key: value for key, value in kept.items() if value != {}}
    return toml_text({**kept, "scenes": plan.most_scenes, "made_by": dict(made_by)}, heading)


def differences(
    kept: CampaignPlan, kept_by: Mapping[str, str], plan: CampaignPlan, by: Mapping[str, str]
) -> str:
    """What differs between a stored plan and one, a line each; empty where rows go together."""
    lines = []
    if kept_by.get("plan") != by["plan"]:
        old, new = dict(_asked(kept)), dict(_asked(plan))
        lines += [
            f"{key}: {old[key]} there, {new[key]} here" for key in new if old[key] != new[key]
        ]
    lines += [
        f"{key}: {kept_by.get(key, 'not known')} there, {by[key]} here"
        for key in by
        if key != "plan" and kept_by.get(key) != by[key]
    ]
    return "\n".join(f"  {line}" for line in lines)
