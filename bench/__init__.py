"""The roof of teatbench: the only package that knows instruments, detectors and reports; and what
it promises to Python programs (docs/api.md). A name is loaded when it is first used.
"""
# ruff: noqa: I001
# fmt: off

from bench.version import __version__
from textfiles.lazy import lazily

TYPE_CHECKING = False  # `typing` takes 20 ms to import; checkers know the name
if TYPE_CHECKING:
    from bench.api.campaigns import CampaignResult, run_campaign
    from bench.api.records import check_record, compare_runs, control_run, export_record
    from bench.api.records import judge_together, pack_run, verdict_of
    from bench.api.rigs import OpenRig, open_rig
    from bench.api.runs import BathRow, DetectionRow, EventRow, FoundRow, TouchRow, TrialRow
    from bench.api.runs import TruthOfTeat, load_script, read_rows, read_run, read_table
    from bench.api.runs import resume_run, run_queue, run_script, score_recording, write_report
    from bench.api.shots import Shot, detect, draw, families, labels, load_rig, member
    from bench.api.shots import open_detector, score
    from bench.config import ConfigError
    from bench.record.check import CheckResult, checked_first
    from bench.record.reader import RunRecord
    from bench.record.recording import Recording, RecordingError, RecordingWriter, TruthRow
    from bench.report.comparison import write_comparison
    from bench.report.runs import list_runs, write_runs_page
    from bench.results.answers import Answer
    from bench.results.comparison import Comparison, Together
    from bench.results.status import Reported, RunStatus
    from bench.rig.leaving import NotSafeError
    from bench.rig.opening import BringUpError
    from bench.safety.interlocks import InterlockTrip
    from bench.scoring.decisions import Verdict
    from bench.scoring.scene import SceneScore

_PROMISED = {
    "bench.api.campaigns": ("CampaignResult", "run_campaign"),
    "bench.api.records": (
        "check_record", "compare_runs", "control_run", "export_record", "judge_together",
        "pack_run", "verdict_of",
    ),
    "bench.api.rigs": ("OpenRig", "open_rig"),
    "bench.api.runs": (
        "BathRow", "DetectionRow", "EventRow", "FoundRow", "TouchRow", "TrialRow", "TruthOfTeat",
        "load_script", "read_rows", "read_run", "read_table", "resume_run", "run_queue",
        "run_script", "score_recording", "write_report",
    ),
    "bench.api.shots": (
        "Shot", "detect", "draw", "families", "labels", "load_rig", "member", "open_detector",
        "score",
    ),
    "bench.config": ("ConfigError",),
    "bench.record.check": ("CheckResult", "checked_first"),
    "bench.record.reader": ("RunRecord",),
    "bench.record.recording": ("Recording", "RecordingError", "RecordingWriter", "TruthRow"),
    "bench.report.comparison": ("write_comparison",),
    "bench.report.runs": ("list_runs", "write_runs_page"),
    "bench.results.answers": ("Answer",),
    "bench.results.comparison": ("Comparison", "Together"),
    "bench.results.status": ("Reported", "RunStatus"),
    "bench.rig.leaving": ("NotSafeError",),
    "bench.rig.opening": ("BringUpError",),
    "bench.safety.interlocks": ("InterlockTrip",),
    "bench.scoring.decisions": ("Verdict",),
    "bench.scoring.scene": ("SceneScore",),
    "bench.version": ("__version__",),
}
__all__ = [
    "Answer", "BathRow", "BringUpError", "CampaignResult", "CheckResult", "Comparison",
    "ConfigError", "DetectionRow", "EventRow", "FoundRow", "InterlockTrip", "NotSafeError",
    "OpenRig", "Recording", "RecordingError", "RecordingWriter", "Reported", "RunRecord",
    "RunStatus", "SceneScore", "Shot", "Together", "TouchRow", "TrialRow", "TruthOfTeat",
    "TruthRow", "Verdict", "__version__", "check_record", "checked_first", "compare_runs",
    "control_run", "detect", "draw", "export_record", "families", "judge_together", "labels",
    "list_runs", "load_rig", "load_script", "member", "open_detector", "open_rig", "pack_run",
    "read_rows", "read_run", "read_table", "resume_run", "run_campaign", "run_queue", "run_script",
    "score", "score_recording", "verdict_of", "write_comparison", "write_report", "write_runs_page",
]
__getattr__ = lazily(__name__, _PROMISED)
