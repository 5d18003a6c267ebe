"""The roof of teatbench: the only package that knows instruments, detectors and reports; and what
it promises to Python programs (docs/api.md). A name is loaded when it is first used.
"""

from bench.version import __version__
from textfiles.lazy import lazily

TYPE_CHECKING = False  # `typing` takes 20 ms to import; checkers know the name
if TYPE_CHECKING:
    from bench.api.campaigns import CampaignResult, run_campaign
    from bench.api.rigs import OpenRig, open_rig
    from bench.api.runs import (
        BathRow,
        DetectionRow,
        EventRow,
        FoundRow,
        TouchRow,
        TrialRow,
        TruthOfTeat,
        load_script,
        read_rows,
        read_run,
        read_table,
        resume_run,
        run_queue,
        run_script,
        score_recording,
        write_report,
    )
    from bench.api.shots import (
        Shot,
        detect,
        draw,
        families,
        labels,
        load_rig,
        member,
        open_detector,
        score,
    )
    from bench.config import ConfigError
    from bench.record.reader import RunRecord
    from bench.record.recording import Recording, RecordingError, RecordingWriter, TruthRow
    from bench.results.answers import Answer
    from bench.results.status import Reported, RunStatus
    from bench.rig.leaving import NotSafeError
    from bench.rig.opening import BringUpError
    from bench.safety.interlocks import InterlockTrip
    from bench.scoring.scene import SceneScore

_PROMISED = {
    "bench.api.campaigns": ("CampaignResult", "run_campaign"),
    "bench.api.rigs": ("OpenRig", "open_rig"),
    "bench.api.runs": (
        *("BathRow", "DetectionRow", "EventRow", "FoundRow", "TouchRow", "TrialRow"),
        *("TruthOfTeat", "load_script", "read_rows", "read_run", "read_table", "resume_run"),
        *("run_queue", "run_script", "score_recording", "write_report"),
    ),
    "bench.api.shots": (
        *("Shot", "detect", "draw", "families", "labels", "load_rig", "member", "open_detector"),
        "score",
    ),
    "bench.config": ("ConfigError",),
    "bench.record.reader": ("RunRecord",),
    "bench.record.recording": ("Recording", "RecordingError", "RecordingWriter", "TruthRow"),
    "bench.results.answers": ("Answer",),
    "bench.results.status": ("Reported", "RunStatus"),
    "bench.rig.leaving": ("NotSafeError",),
    "bench.rig.opening": ("BringUpError",),
    "bench.safety.interlocks": ("InterlockTrip",),
    "bench.scoring.scene": ("SceneScore",),
    "bench.version": ("__version__",),
}
__all__ = [
    "Answer", "BathRow", "BringUpError", "CampaignResult", "ConfigError", "DetectionRow",
    "EventRow", "FoundRow", "InterlockTrip", "NotSafeError", "OpenRig", "Recording",
    "RecordingError", "RecordingWriter", "Reported", "RunRecord", "RunStatus", "SceneScore",
    "Shot", "TouchRow", "TrialRow", "TruthOfTeat", "TruthRow", "__version__", "detect", "draw",
    "families", "labels", "load_rig", "load_script", "member", "open_detector", "open_rig",
    "read_rows", "read_run", "read_table", "resume_run", "run_campaign", "run_queue", "run_script",
    "score", "score_recording", "write_report",
]  # fmt: skip
__getattr__ = lazily(__name__, _PROMISED)
