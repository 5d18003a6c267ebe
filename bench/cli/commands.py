"""The whole command line as a table: commands by task, each with what it is for, an example and its
arguments. It imports nothing heavy, so that ``--help`` answers at once.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from bench.cli.arguments import (
    Argument,
    a_run,
    flag,
    number,
    one_of,
    option,
    parsed,
    point,
    size,
    whole,
)
from textfiles.bounds import SPEED

BAUDS = (9600, 14400, 19200, 28800, 38400, 57600, 115200)
# of detector.calibration.cameras, which is heavy to import
MODELS = ("k1", "k1 k2", "k1 k2 p1 p2", "k1 k2 p1 p2 k3")
CAMERAS = ("left", "right", "thermal")
KINDS = ("arm", "bath", "camera", "stage")  # of drivers
LANGUAGES = ("python", "javascript", "cpp")

SECONDS = number("a number of seconds above 0", above=0.0)
ABOVE_0 = number("a number above 0", above=0.0)
LENGTH = number("a length in mm above 0", above=0.0)
SD = number("a number of 0 or more", least=0.0)
SHARE = number(
    "a number between 0 and 1, such as 0.95: no number of poses shows 100 %", above=0.0, below=1.0
)

RIG_HELP = "a shipped rig by name, or a .toml file (default: emulated)"
SCRIPT_HELP = "a shipped script by name ('teatbench trials' lists them), or a .toml file"

CAPTURE = option("--capture FILE", "record the bytes of every link in a new file (help record)")
JSON = flag("--json", "one JSON object, units in its keys")
LISTED = flag("--json", "one JSON object instead of lines")
TABLES_JSON = flag("--json", "print JSON instead of tables")
RIG = option("rig RIG", RIG_HELP, nargs="?")
RIG_OPTION = option("--rig RIG", RIG_HELP)
CAMERAS_OF = option("--rig RIG", f"whose cameras: {RIG_HELP}")
WORKERS = option("--workers N", "how many processes (default: one a processor)", whole(1, 1024))
RUN = option("run RUN", "the run's folder, its name in runs/, or 'latest', the newest there", a_run)
SUMMARY = option("--summary FILE", "append what was found to this file as Markdown, for CI", Path)
RECORDING = option("recording RECORDING", "a recording's folder, or a run's", a_run)
OUT_RUNS = option("--out DIR", "the folder for run folders", default=Path("runs"))
DETECTOR_HELP = "a detector by name, a file DETECTOR.toml, or exec:COMMAND (help detectors)"
DETECTORS = option("--detector NAME", f"{DETECTOR_HELP}; may be given several times", many=True)
NOTIFY = option(
    "--notify URL",
    "send word to this address, such as ntfy://ntfy.sh/TOPIC: asked, tripped, not safe, ended; may"
    " be given several times (default: the rig's [notify])",
    many=True,
)
EVENTS = option("--events FILE", "also write each event as a JSON line, for other programs")
DESPITE_DAMAGE = flag(
    "--despite-damage", "use a record that was altered or damaged; it then gives no verdict"
)
ADDED_TO = "the recording; one that is there is added to"
LISTEN = option("--listen HOST", "address to listen on", default="127.0.0.1")
REPLACE = flag("--replace", "write over a file that is there")

COMPARED = (
    option("--detector NAME", "compare only this detector; may be given several times", many=True),
    option(
        "--margin-mm MM",
        "how much larger an error may be (default: 5 %% of the limit)",
        number("a length in mm of 0 or more", least=0.0),
    ),
    option(
        "--confidence P",
        "confidence of the intervals",
        number("a number from 0.5 to below 1, such as 0.95", least=0.5, below=1.0),
        0.95,
    ),
    flag("--gate", "exit code 1 when the new one is worse, 4 when that is undecided"),
    SUMMARY,
)
COMPARED_PAGE = option("--out DIR", "also write a page and comparison.json there")

ALL = "which; may be given several times (default: all)"
PERTURB = option(
    "--perturb NAME=AMOUNT",
    "change every scene, such as vergence=0.1 (help campaigns); may be given several times",
    parsed("bench.campaign.perturbations:Applied.parse"),
    many=True,
)
SITUATIONS = (CAMERAS_OF, option("--situation NAME", ALL, many=True))
FIRST_SEEDS = (
    option("--first N", "number of the first member of each family", whole(0), 0),
    option("--seed N", "seed of noise and of the cameras' fixed patterns", whole(0), 1),
)
CAMPAIGN = option("folder DIR", "the campaign's folder")
FIRST_MEMBER = option(
    "--first N", "number of the first member of each family (default: 0)", whole(0)
)

ARM_LINK = (
    CAPTURE,
    option(
        "--port URL",
        '"/dev/ttyUSB0", "COM5", "socket://host:port", or "emulator:" for an emulated arm to try'
        " it on",
        required=True,
    ),
    option("--baud RATE", "baud rate of a serial port", int, 115200, choices=BAUDS),
    option("--answer-s S", "seconds to wait for an answer", ABOVE_0, 0.12),
)
HOMED = (
    *ARM_LINK,
    flag("--homed", "the stylus was on its peg when the arm was last switched on: don't ask"),
)
ARM_FILE = (
    option("--out FILE", "the file to write, which the rig file names", required=True),
    REPLACE,
)

BATH_LINK = (
    CAPTURE,
    option(
        "--port URL",
        "where the controller is, as in a rig file's [bath] url",
        required=True,
    ),
    option(
        "--profile NAME",
        "a shipped profile by name, or a .toml file (help add-a-bath); none for a plug-in",
    ),
)
UNTIL = option("--seconds S", "end after so many seconds (default: Ctrl-C ends it)", SECONDS)

STAGE_LINK = (
    CAPTURE,
    one_of(
        option(
            "--port URL",
            "where the controller is, as in a rig file's [stage] url",
        ),
        option("--rig RIG", "the stage of this rig"),
        required=True,
    ),
    option(
        "--axes",
        "with --port: the axes that it has (default: XY)",
        choices=("XY", "XYZ", "XYA", "XYZA"),
    ),
    option(
        "--dialect",
        "with --port: what it speaks (default: grbl, which is Grbl, grblHAL or FluidNC)",
        choices=("grbl", "marlin"),
    ),
)
FEED = option("--feed MM_MIN", "speed, mm/min (default: as fast as the slowest axis can)", number())
RESETS = "opening the port resets most controllers, so that the stage has to be homed again"

SOURCES = option(
    "sources SOURCE",
    "a rig by name or .toml file (default: emulated), or one to three cameras: opencv:0,"
    " opencv:http://…, genicam:NAME, plugin:NAME",
    nargs="*",
)

BOARD_HELP = (
    "a shipped board by name (charuco-11x7-25, chessboard-9x6-40, heated-circles-7x5-18),"
    " checkerboard:5x7:30mm (inner corners, and their distance), or a .toml file"
)
RIG_SEED = option("--seed N", "seed of the emulators' noise (default: the rig's)", whole(0))
LIVE = (
    option("--rig RIG", "live, with the cameras of this rig: by name, or a .toml file"),
    RIG_SEED,
)
OTHER_TOOL = option(
    "--format", "of which tool", choices=("opencv", "bouguet", "ros"), required=True
)
FROM_TOOL = option(
    "--format",
    "of which tool; for matlab the structure that toStruct(stereoParams) gives",
    choices=("opencv", "bouguet", "ros", "kalibr", "matlab"),
)
TOUCH_NOISE = (
    option("--pixel-sd PX", "standard deviation of a pixel coordinate, px", SD, 0.1),
    option("--touch-sd MM", "standard deviation of a touch along each axis, mm", SD, 0.25),
)
FRAMES = option("frames FRAMES", "folders of pictures (help calibration)", nargs="*")
BOARD = option("board BOARD", BOARD_HELP)
BOARD_SHOWN = (
    option("--board BOARD", BOARD_HELP),
    option("--max-views N", "take at most so many views, spread over the set", whole(1)),
    option(
        "--window PX",
        "half of the corner window, px (default: as large as reaches no other corner)",
        whole(1),
    ),
)


def _part(name: str) -> tuple[Argument, Argument, Argument, Argument]:
    """Where a step writes its file, in a folder that it makes, and who says so."""
    return (
        option(
            "--out FILE",
            f"the file to write, such as {name}; its page stands beside it",
            required=True,
        ),
        REPLACE,
        option("--by NAME", "who calibrated, for the record", default=""),
        lambda to: to.set_defaults(makes_folder=True),
    )


# what a command is for, an example of it, and its arguments
COMMANDS: Mapping[str, tuple[str, str, *tuple[Argument, ...]]] = {
    "run": (
        "run a trial script on a rig and write the scored report",
        "run six-situations --detector fused --detector thesis",
        CAPTURE,
        option(
            "script SCRIPT",
            "a shipped script by name, or a .toml file (default: six-situations); several run one"
            " after the other on an open, warm rig",
            nargs="*",
        ),
        RIG_OPTION,
        option("--seed N", "seed of all random numbers (default: the rig file's)", whole(0)),
        option("--record DIR", "also write a recording, which 'teatbench score' reads"),
        flag("--realtime", "emulated rig only: waits take their real time"),
        option(
            "--speed N",
            "emulated rig only: --realtime, N times as fast, to practise",
            number(SPEED),
        ),
        flag("--dry-run", "move nothing: check each pose, then try all trials on emulators"),
        flag("--json", "with --dry-run: one JSON object with each finding by its trial"),
        OUT_RUNS,
        DETECTORS,
        EVENTS,
        NOTIFY,
        SUMMARY,
        flag("--open", "open the report in the browser at the end, where there is a desktop"),
        flag("--console", "open the console beside it; an emulated rig then takes its real time"),
    ),
    "resume": (
        "go on with a run that stopped, at its first trial without a result",
        "resume runs/20260601-120000-six-situations",
        CAPTURE,
        RUN,
        EVENTS,
        NOTIFY,
        SUMMARY,
        DESPITE_DAMAGE,
    ),
    "control": (
        "pause a run that is under way, let it go on, skip or repeat a trial, or abort it",
        "control runs/20260601-120000-six-situations pause",
        RUN,
        option("words WORD", "pause, go on, skip REASON, repeat REASON or abort", nargs="+"),
    ),
    "report": (
        "write the report of a run again",
        "report latest --open",
        RUN,
        option("--baseline RUN", "also compare it with this older run of the same scenes", a_run),
        DESPITE_DAMAGE,
        one_of(
            flag("--pdf", "fail where no Chromium, Chrome or Edge prints report.pdf"),
            flag("--no-pdf", "print no report.pdf, though a browser is installed"),
        ),
        SUMMARY,
        flag("--open", "open it in the browser, where there is a desktop"),
        flag("--appendix", "print the folded sections too: report.pdf is the whole report"),
    ),
    "console": (
        "watch, answer, start and end runs on a page in the browser",
        "console --runs runs",
        option("--runs DIR", "where run folders are", default=Path("runs")),
        option("--port N", "TCP port of this machine (default: a free one)", whole(0, 65535), 0),
        option(
            "--listen ADDRESS",
            "an address of this machine that others reach (default: 127.0.0.1, this machine alone)",
            default="127.0.0.1",
        ),
        flag("--no-open", "don't open the page in the browser"),
    ),
    "runs": (
        "list all runs with each detector's verdicts, and write a page over them",
        "runs runs",
        option("folder DIR", "the folder of runs (default: runs)", Path, Path("runs"), nargs="?"),
        flag("--json", "print JSON instead of a table"),
    ),
    "score": (
        "score detectors on recorded frames, and write a run folder with a report",
        "score recordings/six --detector fused --detector thesis",
        RECORDING,
        OUT_RUNS,
        DETECTORS,
        SUMMARY,
    ),
    "compare": (
        "compare runs, or the detectors of one run, trial by trial",
        "compare runs/old runs/new --gate",
        option(
            "run RUN", "folders, names, or 'latest'; the first is the old one", a_run, nargs="+"
        ),
        *COMPARED,
        flag(
            "--together", "judge all runs as one, by their counts and errors, instead of comparing"
        ),
        flag("--across-scripts", "with --together: pool runs of different scripts too"),
        COMPARED_PAGE,
        DESPITE_DAMAGE,
        TABLES_JSON,
    ),
    "plan": (
        "how many poses a claim needs, and what so many poses can show",
        "plan --rate 0.95 --script plane-map",
        option("--rate R", "rate to be shown (default: 0.95, 0.99 and 0.999)", SHARE, many=True),
        option("--confidence P", "confidence of the claim", SHARE, 0.95),
        option("--failures N", "plan for up to so many failures", whole(0, 1_000_000), 3),
        option("--trials N", "number of poses: what do they show?", whole(0, 1_000_000)),
        option("--script SCRIPT", "take the poses of a script, shipped by name or a .toml file"),
        option("--true-rate R", "the detector's true success rate: how likely is it shown?", SHARE),
        option("--sd-mm MM", "standard deviation of two detectors' difference over poses", LENGTH),
        option("--shift-mm MM", "difference of two detectors: how many poses show it?", LENGTH),
        option("--power P", "chance to show a difference that is there", SHARE, 0.8),
        option("--limit-mm MM", "limit of the error; --u-mm: how near may errors lie?", LENGTH),
        option(
            "--u-mm MM", "the truth's standard uncertainty along an axis, as a report says", LENGTH
        ),
        TABLES_JSON,
    ),
    "store check": (
        "check that a run's database, frames and files are as they were written",
        "store check runs/20260601-120000-six-situations",
        RUN,
        option(
            "--digest HEX", "a digest that a report of this run printed: it has to be in the record"
        ),
    ),
    "store export": (
        "write a run's record as CSV or Parquet tables, or as one MCAP file",
        "store export runs/20260601-120000-six-situations --format csv --out tables",
        RUN,
        option(
            "--format",
            "csv and parquet: a file a table; mcap: one file for Foxglove and rerun",
            required=True,
            choices=("csv", "parquet", "mcap"),
        ),
        DESPITE_DAMAGE,
        option(
            "--out DIR",
            "the folder to write to; files of the same names are replaced",
            required=True,
        ),
    ),
    "recording pack": (
        "make a recording of a run to publish: frames, truth, data card, digests",
        "recording pack runs/20260601-120000-six-situations --out six --licence CC-BY-4.0",
        RUN,
        option("--out DIR", "the new folder", Path, required=True),
        option("--title TEXT", "title of the data card (default: the script's and the rig's)"),
        option("--licence SPDX", "licence for those who use it, such as CC-BY-4.0"),
        DESPITE_DAMAGE,
    ),
    "detect": (
        "print what each detector finds in recorded frames, unscored",
        "detect recordings/six --detector fused",
        RECORDING,
        flag("--json", "one JSON line a frame"),
        DETECTORS,
    ),
    "scene sheet": (
        "draw situations as one picture",
        "scene sheet --situation overlapping --seeds 4 --out scene.png",
        *SITUATIONS,
        option("--seeds N", "members of each family", whole(1), 1),
        *FIRST_SEEDS,
        option("--out FILE", "the PNG file to write", default=Path("scene.png")),
    ),
    "scene record": (
        "write a recording of situations with exact truth, for 'teatbench score'",
        "scene record --situation overlapping --seeds 3 --out recordings/overlapping",
        *SITUATIONS,
        option("--seeds N", "members of each family", whole(1), 20),
        *FIRST_SEEDS,
        PERTURB,
        option("--out DIR", ADDED_TO, default=Path("recordings/situations")),
    ),
    "scene boards": (
        "draw a calibration board all over the view, for 'teatbench calibrate'",
        "scene boards chessboard-9x6-40 --out recordings/boards",
        BOARD,
        CAMERAS_OF,
        option(
            "--camera NAME",
            "sees the whole board; may be given several times (default: left and right)",
            choices=CAMERAS,
            many=True,
        ),
        option("--poses N", "how many poses", whole(0), 24),
        option(
            "--warmer-k K", "how much warmer than the room the dark parts are, K", number(), 0.0
        ),
        option("--seed N", "seed of poses, noise and the cameras' fixed patterns", whole(0), 1),
        option(
            "--out DIR",
            "the folder to write to; one that is there is added to",
            default=Path("recordings/boards"),
        ),
    ),
    "campaign run": (
        "score detectors on many simulated scenes; given again, it goes on where it stopped",
        "campaign run --family ideal --scenes 40 --detector fused --seed 7 --out campaigns/ideal",
        option(
            "plan PLAN", "a .toml file in place of the options (help campaigns)", Path, nargs="?"
        ),
        option("--family NAME", ALL, many=True),
        option("--scenes N", "scenes of each family (default: 100)", whole(1, 10_000_000)),
        option(
            "--half-width W",
            "go on until each family's failure rate is known to +/- so much (95 %%), such as 0.01",
            number("a number above 0 and below 0.5", above=0.0, below=0.5),
        ),
        DETECTORS,
        FIRST_MEMBER,
        option(
            "--seed N", "seed of noise and of the cameras' fixed patterns (default: 1)", whole(0)
        ),
        CAMERAS_OF,
        option(
            "--calibration FILE",
            "the calibration that detectors get (default: the cameras' own)",
            str,
        ),
        PERTURB,
        option("--limit-mm MM", "largest error that a teat end may have (default: 5)", LENGTH),
        option("--chunk-scenes N", "scenes of a chunk (default: up to 50)", whole(1, 10_000)),
        one_of(
            WORKERS,
            option(
                "--dask ADDRESS", "work on a Dask cluster: its scheduler, such as tcp://lab-pc:8786"
            ),
        ),
        option("--out DIR", "the campaign's folder", required=True),
        JSON,
    ),
    "campaign chunk": (
        "do one chunk of a plan, for job arrays; without N, print how many there are",
        "campaign chunk night.toml 0 --out campaigns/night",
        option("plan PLAN", "the plan's .toml file", Path),
        option("number N", "the chunk's number, from 0", whole(0), nargs="?"),
        option("--out DIR", "the campaign's folder (default: the plan's, where that is one)"),
    ),
    "campaign keep": (
        "add the scene that a test found to a recording, to score later versions on",
        "campaign keep found/test_mine --into recordings/kept --name grey-on-grey",
        option("folder DIR", "the folder that the failing test wrote", Path),
        option("--into DIR", ADDED_TO, Path, required=True),
        option("--name NAME", "name of the frame (default: the folder's)", str),
    ),
    "campaign show": (
        "draw scenes of a campaign again, with truth and answers, as a page",
        "campaign show campaigns/ideal ideal-0012",
        CAMPAIGN,
        option("scene SCENE", "by name: family and member, as in ideal-0012", str, nargs="+"),
    ),
    "campaign compare": (
        "compare campaigns, or the detectors of one, scene by scene",
        "campaign compare campaigns/old campaigns/new --gate",
        option("folder DIR", "the campaigns' folders; the first is the old one", nargs="+"),
        *COMPARED,
        option(
            "--margin-rate R",
            "by how much the share of right scenes may fall",
            number("a number of 0 or more, below 1", least=0.0, below=1.0),
            0.01,
        ),
        COMPARED_PAGE,
        TABLES_JSON,
    ),
    "campaign query": (
        "ask a campaign's rows in SQL (DuckDB): views scenes, teats, parameters",
        'campaign query campaigns/ideal "SELECT failure, count() FROM scenes GROUP BY ALL"',
        CAMPAIGN,
        option("sql SQL", "a SELECT; 'DESCRIBE scenes' lists the columns of a view"),
        flag("--json", "a JSON list with an object a row"),
    ),
    "check": (
        "connect to every instrument of a rig, print who it is and one reading",
        "check my-rig.toml",
        CAPTURE,
        RIG,
    ),
    "emulate": (
        "run a rig's emulators alone, in real time, until Ctrl-C, with a page to practise faults",
        "emulate --port-base 9100 --write-rig practice.toml",
        RIG,
        LISTEN,
        flag("--pty", "serial instruments on pseudo-terminals (Linux and macOS)"),
        option(
            "--write-rig FILE",
            "write a rig file with their addresses, for 'teatbench run --rig FILE'",
        ),
        REPLACE,
        flag("--paced", "serial instruments at the rig's baud rate, 10 bits a byte"),
        option(
            "--port-base N",
            "TCP ports from N on, always the same ones, so that a written rig file stays good"
            " (default: free ones)",
            whole(1024, 65530),
            0,
        ),
    ),
    "init": (
        "find instruments and cameras, ask for the rest, write a rig file; nothing moves or heats",
        "init --out my-rig.toml",
        option("--out FILE", "the rig file", Path, Path("my-rig.toml")),
        REPLACE,
        option(
            "--port URL",
            "look here only, as in a rig file's url; may be given several times (default: every"
            " serial port)",
            many=True,
        ),
        flag("--yes", "ask nothing: what isn't found is marked in the file"),
    ),
    "arm read": (
        "print one position of the tip",
        "arm read --port /dev/ttyUSB0 --json",
        *HOMED,
        option("--packets N", "packets that make one reading", whole(1, 1000), 8),
        option("--frame FILE", "the table frame's file: gives the position in the world too"),
        JSON,
    ),
    "arm watch": (
        "show tip, pedals and rate until Ctrl-C",
        "arm watch --port /dev/ttyUSB0",
        *HOMED,
        UNTIL,
    ),
    "arm home": (
        "home the arm, with the stylus on its peg",
        "arm home --port /dev/ttyUSB0",
        *ARM_LINK,
        flag("--on-peg", "the stylus is on its peg: don't ask"),
    ),
    "arm frame": (
        "set the table frame: three touches and check points (help rig)",
        "arm frame --port /dev/ttyUSB0 --out frame.toml",
        *HOMED,
        option("--plane-checks N", "further touches anywhere in the plane", whole(0, 20), 1),
        option(
            "--check X,Y,Z",
            "also touch this known point, world mm; may be given several times (--check=-60,80,0)",
            point(3, 10_000.0),
            many=True,
        ),
        option("--residual-limit-mm MM", "how far off a check point may be, mm", ABOVE_0, 1.5),
        *ARM_FILE,
    ),
    "arm verify": (
        "verify the arm: one divot at up to three distances, a calibrated length (help rig)",
        "arm verify --port /dev/ttyUSB0 --out verification.toml",
        *HOMED,
        option("--distances N", "divots: 1 (middle), 2 (near and far) or 3 (all)", whole(1, 3), 3),
        option("--touches N", "touches in each divot", whole(5, 100), 10),
        option(
            "--length-mm L", "also measure a calibrated length with cones at its ends, mm", ABOVE_0
        ),
        flag("--spheres", "the length is a ball bar's, between the centres of its spheres"),
        option("--length-u-mm U", "its standard uncertainty, mm, as its certificate says", SD, 0.0),
        option(
            "--gauge TEXT", "which length it is, and its certificate, for the record", default=""
        ),
        option(
            "--accuracy-mm U",
            "the arm's stated standard uncertainty, mm, to hold the touches against"
            " (default: a MicroScribe's, 0.23)",
            ABOVE_0,
        ),
        option("--directions N", "directions to measure it in", whole(1, 7), 7),
        option("--script SCRIPT", "whose limits to hold it against (default: six-situations)"),
        *ARM_FILE,
    ),
    "bath read": (
        "print one reading, and who answered; changes nothing",
        "bath read --port tcp://192.168.0.40:502 --profile julabo-presto",
        *BATH_LINK,
        JSON,
    ),
    "bath learn": (
        "try each row of a profile, read-only, and say what answered",
        "bath learn --port tcp://192.168.0.40:502 --profile my-bath.toml",
        *BATH_LINK,
        JSON,
    ),
    "bath set": (
        "change the set point; starts and stops nothing",
        "bath set --port tcp://192.168.0.40:502 --profile julabo-presto 33",
        *BATH_LINK,
        option("set_point DEGC", "the new set point in degC", number("a temperature in degC")),
        flag("--allow-inferred", "also write to rows whose evidence is INFERRED"),
        option(
            "--display DEGC",
            "what the controller's display shows now, in degC: for a family that doesn't tell the"
            " unit of its numbers",
            number("a temperature in degC"),
        ),
    ),
    "bath watch": (
        "plot the temperature until Ctrl-C; changes nothing",
        "bath watch --port tcp://192.168.0.40:502 --profile julabo-presto",
        *BATH_LINK,
        UNTIL,
    ),
    "bath standby": (
        "switch the heater off now, whatever the bath is doing",
        "bath standby --port tcp://192.168.0.40:502 --profile julabo-presto",
        *BATH_LINK,
    ),
    "bath acknowledge": (
        "let a rig run again after an interlock tripped and its cause is gone",
        "bath acknowledge my-rig.toml",
        CAPTURE,
        RIG,
    ),
    "stage status": (
        f"print who answered, state, input pins, position and travel; moves nothing, but {RESETS}",
        "stage status --rig my-rig.toml",
        *STAGE_LINK,
        JSON,
    ),
    "stage home": (
        "run to the switches and set the position",
        "stage home --rig my-rig.toml",
        *STAGE_LINK,
    ),
    "stage move": (
        f"home, then move to a place in machine coordinates ({RESETS})",
        "stage move --rig my-rig.toml -- -200 -150",
        *STAGE_LINK,
        option("x_mm X", "mm, as it counts (Grbl: 0 at the switch, negative elsewhere)", number()),
        option("y_mm Y", "mm, the same", number()),
        option("--z MM", "height, mm, on a stage declared with Z", number(), dest="z_mm"),
        option("--a DEG", "rotation, degrees, on a stage declared with A", number(), dest="a_deg"),
        FEED,
    ),
    "stage jog": (
        f"home, then go by so much, step by step; Ctrl-C ends a step at once ({RESETS})",
        "stage jog --rig my-rig.toml X-5 X-5Y2.5",
        *STAGE_LINK,
        option(
            "steps STEP",
            "X-5, or X-5Y2.5 for both at once: mm, degrees for A",
            parsed("bench.cli.alone:step"),
            nargs="+",
        ),
        FEED,
    ),
    "stage recover": (
        "leave an alarm or a hold by restarting the controller; home it afterwards",
        "stage recover --rig my-rig.toml",
        *STAGE_LINK,
    ),
    "camera list": (
        "list the cameras that this machine can see, or those of a rig",
        "camera list",
        option("rig", "a shipped rig by name, or a .toml file (default: this machine)", nargs="?"),
    ),
    "camera show": (
        "say who each camera is, what it sees, and what is wrong with it",
        "camera show my-rig.toml",
        SOURCES,
        JSON,
    ),
    "camera focus": (
        "live sharpness and pictures, to place cameras and set lenses, until Ctrl-C",
        "camera focus my-rig.toml --page",
        SOURCES,
        flag("--page", "show the pictures in the browser, with cross, blur and exposure"),
        UNTIL,
        option("--every S", "seconds between two figures", SECONDS, 0.2),
    ),
    "camera grab": (
        "save frame sets as a recording",
        "camera grab my-rig.toml --out recordings/mine --count 5",
        SOURCES,
        option("--out DIR", ADDED_TO, required=True),
        option("--count N", "how many frame sets", whole(1), 1),
    ),
    "calibrate cameras": (
        "calibrate the stereo pair from pictures of a board, or live with a rig",
        "calibrate cameras --rig my-rig.toml --board chessboard-9x6-40 --out parts/cameras.toml",
        CAPTURE,
        FRAMES,
        *BOARD_SHOWN,
        *LIVE,
        option("--model", "distortion that is fitted", default="k1 k2 p1 p2", choices=MODELS),
        flag("--square-pixels", "fit one focal length for both directions (fx = fy)"),
        option(
            "--identity CAMERA=SERIAL",
            "a camera's serial number, for the record; may be given several times",
            many=True,
        ),
        option(
            "--distance MM",
            "where teats will stand: there the calibration is judged (default: 1200)",
            LENGTH,
            1200.0,
        ),
        *_part("cameras.toml"),
    ),
    "calibrate thermal": (
        "calibrate the thermal camera from a heated board, live with a rig, or from point pairs",
        "calibrate thermal --pairs pairs.csv --image-size 640x480 --out thermal.toml",
        CAPTURE,
        FRAMES,
        *BOARD_SHOWN,
        *LIVE,
        option("--cameras FILE", "what 'calibrate cameras' wrote; needed with pictures"),
        option(
            "--pairs CSV",
            "point pairs instead of pictures: thermal_x,thermal_y,left_x,left_y,right_x,right_y",
        ),
        option(
            "--image-size COLUMNSxROWS",
            "size of the delivered thermal picture, px; needed with --pairs",
            size,
        ),
        option(
            "--sensor-size COLUMNSxROWS",
            "px (default: 160x120, or as the rig's calibration says)",
            size,
        ),
        flag("--mirrored", "the pictures come mirrored"),
        option(
            "--polarity",
            "which way grey levels run (default: hot_is_white, or as the rig's calibration says)",
            choices=("hot_is_black", "hot_is_white"),
        ),
        option("--model", "distortion that is fitted", default="k1", choices=MODELS),
        option(
            "--plane MM",
            "distance of the plane that the homographies are right at, mm (default: 1076.3)",
            ABOVE_0,
        ),
        *_part("thermal.toml"),
    ),
    "calibrate world": (
        "place the cameras in the table's axes, by points that arm and cameras measured",
        "calibrate world points.csv --cameras cameras.toml --out world.toml",
        CAPTURE,
        option(
            "points CSV",
            "a table: left_x,left_y,right_x,right_y,x_mm,y_mm,z_mm, a point a line",
            nargs="?",
        ),
        *LIVE,
        option("--board BOARD", f"with --rig: {BOARD_HELP}"),
        option("--cameras FILE", "what 'calibrate cameras' wrote", required=True),
        *TOUCH_NOISE,
        *_part("world.toml"),
    ),
    "calibrate merge": (
        "put the steps' files together into one calibration.toml",
        "calibrate merge cameras.toml thermal.toml world.toml --out calibration.toml",
        option("parts PART", "the files that the steps wrote", nargs="+"),
        *_part("calibration.toml"),
    ),
    "calibrate check": (
        "test whether a calibration still holds, by a board, touched points or touched teat ends",
        "calibrate check calibration.toml --rig my-rig.toml --board chessboard-9x6-40",
        CAPTURE,
        option("calibration CAL", "the calibration, or the cameras' file where a board is shown"),
        FRAMES,
        *BOARD_SHOWN,
        *LIVE,
        option("--points CSV", "touched points in the place of a board, as for 'calibrate world'"),
        option(
            "--ends DIR",
            "a run or recording with touched teat ends, in place of a board; with --rig the phantom"
            " is seen anew, standing as in its last trial",
            a_run,
        ),
        *TOUCH_NOISE,
        option("--page DIR", "also write a page there"),
    ),
    "calibrate board": (
        "print a calibration board as a PDF in true size",
        "calibrate board chessboard-9x6-40 --pdf board.pdf",
        BOARD,
        option("--pdf FILE", "the file to write", required=True),
        option(
            "--paper",
            "the sheet (default: the smallest that holds it)",
            choices=("A4", "A3", "A2", "A1", "A0"),
        ),
    ),
    "calibrate export": (
        "write a calibration for another tool",
        "calibrate export calibration.toml --format opencv --out calibration.yaml",
        option("calibration CAL", "the calibration file"),
        OTHER_TOOL,
        option("--camera", "for ros, which has one camera a file", default="left", choices=CAMERAS),
        option("--out FILE", "the file to write", required=True),
        REPLACE,
    ),
    "calibrate import": (
        "take over the cameras that another tool or their maker calibrated, as a part for 'merge'",
        "calibrate import left.yaml right.yaml --format ros --out cameras.toml",
        option("file FILE", "the other tool's file; for ros two: left, right", nargs="*"),
        FROM_TOOL,
        option("--rig RIG", "whose cameras' maker is asked, by their driver (help drivers)"),
        option("--image-size COLUMNSxROWS", "px; for opencv, whose files may leave it out", size),
        *_part("cameras.toml"),
    ),
    "calibrate stage": (
        "register the stage in the world by touching one end at several positions (help trials)",
        "calibrate stage --rig my-rig.toml --out registration.toml",
        CAPTURE,
        RIG_OPTION,
        option("--out FILE", "the file to write, which a script's [truth] names", required=True),
        REPLACE,
        option("--layout NAME", "how the phantom's teats stand", default="table-5-1"),
        option("--teat N", "the teat to touch", whole(1, 20), 1),
        option("--readings N", "touches at each position (default: as the rig says)", whole(1, 20)),
        RIG_SEED,
        option(
            "--at X,Y",
            "touch there, mm from the reference place (--at=-60,80); three or more (default:"
            " the corners and the middle of 200 x 200 mm)",
            point(2, 2000.0),
            many=True,
        ),
    ),
    "replay-wire": (
        "play the instruments' end of a capture back, for drivers to talk to",
        "replay-wire capture.jsonl --link bath",
        option("file FILE", "what a command wrote with --capture", Path),
        LISTEN,
        option("--link NAME", "only this link; may be given several times", many=True),
        flag("--fast", "answer at once, not after the recorded time"),
        flag("--once", "end when all has been played, instead of beginning again"),
    ),
    "trials": (
        "list the trial scripts that ship ('trials show' lists a script's poses)",
        "trials",
        LISTED,
    ),
    "trials show": (
        "list the poses of a script, and estimate its time",
        "trials show plane-map",
        option("script SCRIPT", SCRIPT_HELP),
        RIG_OPTION,
        flag("--json", "one JSON object instead of a table"),
    ),
    "rigs": ("list the rig files that ship, and the one to copy for a real rig", "rigs", LISTED),
    "detectors": (
        "list the detectors: shipped, of other packages, declared in ./detectors",
        "detectors",
        LISTED,
    ),
    "detectors new": (
        "write a program that answers, and its file, to make your own detector from",
        "detectors new python --name mine",
        option("language LANGUAGE", "python, javascript or cpp", choices=LANGUAGES),
        option("--name NAME", "what it is called", default="my_detector"),
        option(
            "--out DIR",
            "the folder to write to (default: detectors, whose files are known by name)",
            default=Path("detectors"),
        ),
    ),
    "detectors try": (
        "ask a detector about one frame, and say what is wrong",
        "detectors try my_detector",
        option("word WORD", DETECTOR_HELP),
        option(
            "recording RECORDING",
            "whose first frame is shown (default: a simulated one)",
            a_run,
            nargs="?",
        ),
    ),
    "help": (
        "show a page of the documentation here, without a network; without TOPIC, list them",
        "help record",
        option("topic TOPIC", "a page, or a command that a page explains", nargs="*"),
    ),
    "plugin": ("list the drivers of other packages (help drivers)", "plugin"),
    "plugin check": (
        "run the conformance suite on a driver, on its emulator where its package has one",
        "plugin check tank",
        option("name NAME", "the driver, or plugin:NAME?key=value for a device"),
        option("--kind", "of which kind, where several have this name", choices=KINDS),
        flag("--works", "a real device may be made to heat or to move"),
        LISTED,
    ),
}
# where a command is done, "module:function", or all of a group; else the module has the name of the
# command's first word, the function that of its last
WORK = {
    **dict.fromkeys(("arm home", "arm watch", "bath *", "camera *", "stage *"), "alone:verb"),
    "bath acknowledge": "alone:acknowledge",
    "camera list": "alone:attached",
    "calibrate import": "calibrate:take_over",
    "detect": "detectors",
    "detectors": "detectors:listed",
    "detectors try": "detectors:try_out",
    "help": "manual:shown",
    "plan": "trials",
    "plugin": "plugin:listed",
    "replay-wire": "rig:replay_wire",
    "trials": "trials:listed",
    **dict.fromkeys(("check", "emulate", "rigs", "scene *"), "rig"),
    **dict.fromkeys(("report", "resume", "score"), "run"),
    **dict.fromkeys(("compare", "control", "recording *", "runs", "store *"), "store"),
}
ONCE = {"control": ("tell",)}  # names of earlier releases, which work for one more


@cache
def table(name: str) -> Mapping[str, Any]:
    """A table beside this file. ``tasks``: what a user wants to do, and the commands and groups for
    it; ``following``: two commands that mostly come next; ``removed``: words that went, and what
    to use; ``endings``: exit codes, and what stands after Ctrl-C.
    """
    return tomllib.loads(Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8"))


def exit_codes(name: str) -> Mapping[str, str]:
    """When the command ends with which exit code, in their order."""
    found = table("endings")
    own: Mapping[str, Any] = next((row for row in found["codes"] if name in row["of"]), {})
    codes = found["every"] | {key: text for key, text in own.items() if key != "of"}
    return dict(sorted(codes.items()))


def interrupted(name: str) -> str:
    """What stands once Ctrl-C has ended the command, and what to do; of one without a row, that
    nothing is known.
    """
    rows = table("endings")["interrupted"]
    return next((str(row["text"]) for row in rows if name in row["of"]), "it may be half done")
