# What a name of this package is, for type checkers: `PLACES` in __init__.py says it to Python.
from bench.api.calibration import makers_calibration, open_cameras_of, take_views, touch_points
from bench.api.campaigns import CampaignResult, run_campaign
from bench.api.instruments import (
    ArmView,
    BathView,
    acknowledge,
    describe_bath,
    open_arm,
    record_frames,
    watch_arm,
    watch_bath,
)
from bench.api.planning import ScriptPlan, check_script, plan_poses, plan_script
from bench.api.records import compare_runs, control_run, export_record, judge_together, pack_run
from bench.api.rigs import OpenRig, open_rig, rig_notes
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
    rig_of_run,
    run_queue,
    run_script,
    score_recording,
    scripts,
    write_report,
)
from bench.api.shots import (
    Shot,
    detect,
    detectors,
    draw,
    families,
    labels,
    load_rig,
    member,
    open_detector,
    rigs,
    score,
)
from bench.calibrate.board_print import board_pdf
from bench.calibrate.board_scenes import record_boards
from bench.calibrate.cameras import (
    CamerasResult,
    ThermalFormat,
    calibrate_pair,
    calibrate_thermal,
    check_pair,
    delivered_by,
    map_pairs,
)
from bench.calibrate.exchange import read_foreign, write_bouguet, write_opencv, write_ros
from bench.calibrate.merge import calibration_record, merge_parts, read_part, write_calibration
from bench.calibrate.stage import calibrate_stage
from bench.calibrate.views import BoardViews, ViewsRequest, find_pictures, find_views
from bench.calibrate.world import calibrate_world, check_points, read_points
from bench.campaign.comparison import compare_campaigns
from bench.campaign.plan import CampaignPlan, make_plan
from bench.campaign.pool import PoolError
from bench.campaign.run import run_chunk
from bench.campaign.shards import query_campaign
from bench.config import ConfigError
from bench.dry_run.pose_checks import ScriptCheck
from bench.record.check import CheckResult, check_record, checked_first, damage_text
from bench.record.reader import RunRecord
from bench.record.recording import Recording, RecordingError, RecordingWriter, TruthRow
from bench.report.comparison import write_comparison
from bench.report.runs import list_runs, write_queue_page, write_runs_page
from bench.report.scenes import show_scenes
from bench.results.answers import Answer
from bench.results.cameras_agree import CamerasCheck, check_ends
from bench.results.comparison import Comparison, PooledRuns, Together, verdict_of
from bench.results.status import Reported, RunStatus
from bench.results.verdicts import Judgement
from bench.rig.alone import (
    OpenCameras,
    bath_profile,
    check_rig,
    check_target,
    describe_stage,
    list_cameras,
    open_bath,
    open_cameras,
    open_stage,
    with_retries,
)
from bench.rig.leaving import NotSafeError
from bench.rig.loading import LoadedRig, find_board
from bench.rig.opening import BringUpError
from bench.rig.scenes import record_scenes, write_sheet
from bench.run.detections import detect_recording
from bench.run.lock import RigInUseError
from bench.safety.interlocks import InterlockTrip
from bench.safety.latch import LatchedError, latched
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.sample_size import SampleSizePlan
from bench.scoring.scene import SceneScore
from bench.script.model import LoadedScript
from bench.truth.registration import write_registration
from bench.truth.touching import NoTruthError
from bench.version import __version__
from instruments.camera.quality import edge_blur_px
from instruments.operators.operator import (
    OperatorAbort,
    OperatorEnough,
    OperatorRepeat,
    OperatorSkip,
)
from instruments.world.boards import NoPlaceError

__all__ = [
    "Answer",
    "ArmView",
    "BathRow",
    "BathView",
    "BoardViews",
    "BringUpError",
    "CamerasCheck",
    "CamerasResult",
    "CampaignPlan",
    "CampaignResult",
    "CheckResult",
    "Comparison",
    "ConfigError",
    "Decision",
    "DetectionRow",
    "EventRow",
    "FoundRow",
    "InterlockTrip",
    "Judgement",
    "LatchedError",
    "LoadedRig",
    "LoadedScript",
    "NoPlaceError",
    "NoTruthError",
    "NotSafeError",
    "OpenCameras",
    "OpenRig",
    "OperatorAbort",
    "OperatorEnough",
    "OperatorRepeat",
    "OperatorSkip",
    "PoolError",
    "PooledRuns",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "Reported",
    "RigInUseError",
    "RunRecord",
    "RunStatus",
    "SampleSizePlan",
    "SceneScore",
    "ScriptCheck",
    "ScriptPlan",
    "Shot",
    "ThermalFormat",
    "Together",
    "TouchRow",
    "TrialRow",
    "TruthOfTeat",
    "TruthRow",
    "Verdict",
    "ViewsRequest",
    "__version__",
    "acknowledge",
    "bath_profile",
    "board_pdf",
    "calibrate_pair",
    "calibrate_stage",
    "calibrate_thermal",
    "calibrate_world",
    "calibration_record",
    "check_ends",
    "check_pair",
    "check_points",
    "check_record",
    "check_rig",
    "check_script",
    "check_target",
    "checked_first",
    "compare_campaigns",
    "compare_runs",
    "control_run",
    "damage_text",
    "delivered_by",
    "describe_bath",
    "describe_stage",
    "detect",
    "detect_recording",
    "detectors",
    "draw",
    "edge_blur_px",
    "export_record",
    "families",
    "find_board",
    "find_pictures",
    "find_views",
    "judge_together",
    "labels",
    "latched",
    "list_cameras",
    "list_runs",
    "load_rig",
    "load_script",
    "make_plan",
    "makers_calibration",
    "map_pairs",
    "member",
    "merge_parts",
    "open_arm",
    "open_bath",
    "open_cameras",
    "open_cameras_of",
    "open_detector",
    "open_rig",
    "open_stage",
    "pack_run",
    "plan_poses",
    "plan_script",
    "query_campaign",
    "read_foreign",
    "read_part",
    "read_points",
    "read_rows",
    "read_run",
    "read_table",
    "record_boards",
    "record_frames",
    "record_scenes",
    "resume_run",
    "rig_notes",
    "rig_of_run",
    "rigs",
    "run_campaign",
    "run_chunk",
    "run_queue",
    "run_script",
    "score",
    "score_recording",
    "scripts",
    "show_scenes",
    "take_views",
    "touch_points",
    "verdict_of",
    "watch_arm",
    "watch_bath",
    "with_retries",
    "write_bouguet",
    "write_calibration",
    "write_comparison",
    "write_opencv",
    "write_queue_page",
    "write_registration",
    "write_report",
    "write_ros",
    "write_runs_page",
    "write_sheet",
]
