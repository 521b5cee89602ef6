"""How each command of the documents is run: as it stands there, in another size, or not, and then why not."""

from __future__ import annotations

import re

VALUES = {  # what a reader puts in; tests/workspace.py makes the files
    "SESSION_OR_CAMERAS": "waved",
    "CAMERAS": "live.toml",
    "SESSION": "sessions/monday",
    "SCENARIO.toml": "data/scenarios/breathing_calm.toml",
    "data/scenarios/NAME.toml": "data/scenarios/breathing_calm.toml",
    "PICTURES": "pictures",
    "SHEET.jpg": "sheet.jpg",
    "RIG.toml": "live.toml",
    "ARM.toml": "arm.toml",
    "DISPENSER.toml": "dispenser.toml",
    "PATH.csv": "path.csv",
    "B.toml": "board.toml",
    "X.mcap": "run.mcap",
    "X.json": "trace.json",
    "X.html": "trace.html",
    "X.dot": "window.dot",
    "FOLDER": "sessions/monday",
    "/dev/ttyUSB0": "./serving",
    "DEVICE": "./serving",
    "MASKS": "out/masks",
    "SCAN": "wound.stl",
    "RIG_OR_SESSION": "sessions/monday",
    "SCAN.ply": "scanned.ply",
    "FILE": "moved.tum",
    "OUT": "out/new",
    "DIR": "sessions",
    "A": "out/smoothed",
    "B": "out/calm/session/truth.tum",
    "P": "contour",
    "F": "kalibr",
}
NAMES = {  # named in passing, without what it needs; each is run as a part of a longer one
    *(
        "stillbed arm",
        "stillbed calibrate cameras",
        "stillbed calibrate dispenser",
        "stillbed dispenser",
        "stillbed live",
        "stillbed plan",
        "stillbed record",
        "stillbed reach",
    ),
    *("stillbed replay", "stillbed scan", "stillbed segment", "stillbed simulate", "stillbed track", "stillbed train"),
}
TRACKED = "stillbed track sessions/monday -o out/new --record new.mcap --arm arm.toml --prefilter bilateral --wound"
COMPLETED = {  # an option named in passing, and a command with it
    "stillbed replay --resume progress.toml": (
        "stillbed replay sessions/monday --path path.csv --resume progress.toml -o out/new"
    ),
    "stillbed track --arm ARM.toml": TRACKED,
    "stillbed track --prefilter bilateral": TRACKED,
    "stillbed track --wound": TRACKED,
    "stillbed bench SUBJECT": "python -m tests.campaigns planner --updates 20",
    "stillbed calibrate import FILE --format F -o rig.toml": (
        "stillbed calibrate import camchain.yaml --format kalibr -o rig.toml"
    ),
}
LONG = "takes minutes to hours as it stands"
STARTED = "a live run takes half a minute to begin"
LOOP = "stillbed bench loop --scenario breathing_deep -o out/new"
LIVE = "stillbed bench live --minutes 0.1 --stops 0 --scenario data/live/small.toml"
KILLED = "stillbed bench live --minutes 0 --stops 0 --kills 1 --seed 21 --scenario data/live/small.toml"
SIMULATED = "stillbed simulate data/scenarios/breathing_calm.toml -o out/calm"
SMOOTHING = "python -m tests.campaigns smoothing"
STILL = "python -m tests.campaigns estimator --only 'still, clean' --seeds 1 --seconds 0.5"
FAULTS = "python -m tests.campaigns faults --count 1 -o out/faults"
CLUSTER = "stillbed smooth sessions/ -o out/all --scheduler local --workers 4"
PAGE = (
    "stillbed live monday/session.toml --page-address 0.0.0.0 --page-port 8443 --page-cert page.pem "
    "--page-key page.key --page-name printer.local"
)
RECORDED = "stillbed record live.toml -o out/recorded.mcap --seconds 3 --jpeg-quality 0 --no-page"
MORE = "the same with more said"
WALKED = "tests/test_first_print.py runs it as it stands"
VIRTUAL = "stillbed calibrate arm --virtual --places 5 --swing-s 2 --record try -o arm.toml"
LINES = "stillbed calibrate dispenser dispenser.toml --virtual --lines 2 --record lines"
WAVED = "stillbed calibrate cameras live.toml --board board.toml -o rig.toml --seconds 8 --no-page"
INSTALLS = "makes an environment and runs what else is tested; that the target can be made is looked at"
INSTEAD = {  # (what is run in its place, why)
    "stillbed bench arm-calibration": ("stillbed bench arm-calibration --rendered 0 --runs 1", LONG),
    "stillbed bench beside": ("stillbed bench beside --seconds 1", LONG),
    "stillbed bench beside --seconds 6": ("stillbed bench beside --seconds 1", LONG),
    "python -m tests.campaigns bumps": ("python -m tests.campaigns bumps --count 1 --minutes 0.1", LONG),
    "stillbed bench calibration": ("stillbed bench calibration --instants 12 --runs 1", LONG),
    "python -m tests.campaigns cameras": ("python -m tests.campaigns cameras --minutes 0.05", LONG),
    "python -m tests.campaigns estimator": (STILL, LONG),
    "python -m tests.campaigns estimator --maps seen --only 'breathing, [cno]*' --seeds 6 --seconds 4": (STILL, LONG),
    "python -m tests.campaigns estimator --maps told seen --seeds 8 --seconds 10": (STILL, LONG),
    "python -m tests.campaigns estimator --only 'breathing, [cno]*' --maps seen --seeds 2 --seconds 6": (
        "python -m tests.campaigns estimator --only 'breathing, [c]*' --maps seen --seeds 1 --seconds 0.5",
        LONG,
    ),
    "python -m tests.campaigns estimator --only 'breathing, clean' --maps seen --seeds 6 --seconds 4": (
        "python -m tests.campaigns estimator --only 'breathing, [c]*' --maps seen --seeds 1 --seconds 0.5",
        LONG,
    ),
    "python -m tests.campaigns estimator --soak 3 --maps seen": (
        "python -m tests.campaigns estimator --soak 0.001 --maps seen",
        LONG,
    ),
    "python -m tests.campaigns fill": ("python -m tests.campaigns fill --count 2", LONG),
    "python -m tests.campaigns fill CSV ...": ("python -m tests.campaigns fill contour.csv --count 2", LONG),
    "python -m tests.campaigns wounds": ("python -m tests.campaigns wounds --count 1", LONG),
    "stillbed bench latency": ("stillbed bench latency sessions/monday", LONG),
    "stillbed bench link": ("stillbed bench link --minutes 0.1", LONG),
    "stillbed bench link --minutes 10 --busy 2": ("stillbed bench link --minutes 0.1", LONG),
    "stillbed bench live": (LIVE, STARTED),
    "stillbed bench live --minutes 0 --stops 0 --kills 6 --seed 21": (KILLED, STARTED),
    "stillbed bench live --minutes 0 --stops 0 --kills 6 --seed 21 --scenario data/live/small.toml": (KILLED, STARTED),
    "stillbed bench live --minutes 1 --stops 6": (LIVE, STARTED),
    "stillbed bench live --minutes 60 --stops 6": (LIVE, STARTED),
    "stillbed bench live --minutes 60 --stops 1 --scenario data/live/small.toml": (LIVE, STARTED),
    "stillbed bench loop": (LOOP, LONG),
    "stillbed bench loop --jobs 2": (LOOP, LONG),
    "stillbed bench loop -o OUT": (LOOP, LONG),
    "stillbed bench live --minutes 1 --busy 2 --scenario data/live/small.toml": (f"{LIVE} --busy 1", STARTED),
    "python -m tests.campaigns look": ("python -m tests.campaigns look --layers 1 --stacks 0", LONG),
    "python -m tests.campaigns map": ("python -m tests.campaigns map --seconds 2", LONG),
    "python -m tests.campaigns plan": ("python -m tests.campaigns plan --body foot", "on a smaller wound"),
    "python -m tests.campaigns planner": ("python -m tests.campaigns planner --updates 20", LONG),
    "python -m tests.campaigns planner --updates 40000 --seed 1": (
        "python -m tests.campaigns planner --updates 40 --seed 1",
        LONG,
    ),
    "stillbed bench prediction --traces DIR": ("stillbed bench prediction --traces traces --warm-up 2", LONG),
    "python -m tests.campaigns registration": ("python -m tests.campaigns registration --seeds 1", LONG),
    "python -m tests.campaigns scan": ("python -m tests.campaigns scan --bodies forearm --sets 2", LONG),
    "stillbed bench segmentation DATASET": (
        "stillbed bench segmentation dataset --rendered 1 --areas 1",
        "has a small one",
    ),
    "stillbed bench segmentation --areas 40": ("stillbed bench segmentation --areas 1", LONG),
    "stillbed bench segmentation --rendered 60 --areas 0": ("stillbed bench segmentation --areas 1", LONG),
    f"{SMOOTHING} --movements --minutes --landmarks --adjusted 0 --sessions 0 --scenarios still hand breathing_calm "
    "breathing_deep turns steps_300um camera_lost --rendered 6": (
        f"{SMOOTHING} --movements --minutes --landmarks --adjusted 0 --sessions 0 --scenarios --rendered 6",
        LONG,
    ),
    f"{SMOOTHING} --movements still sway --seeds 1 --seconds 4": (
        f"{SMOOTHING} --movements still --seeds 1 --seconds 1 --sessions 0 --minutes --landmarks --adjusted 0 "
        "--scenarios",
        LONG,
    ),
    SMOOTHING: (f"{SMOOTHING} --movements --minutes --landmarks --adjusted 0 --sessions 0 --scenarios", LONG),
    f"{SMOOTHING} --movements still breathing steps sway --seeds 4 --seconds 4 --sessions 0 --minutes 1 3": (
        f"{SMOOTHING} --movements still --seeds 1 --seconds 1 --sessions 0 --minutes --landmarks --adjusted 0 "
        "--scenarios",
        LONG,
    ),
    "python -m tests.campaigns steps": ("python -m tests.campaigns steps --steps 4 --hours 0.005", LONG),
    "stillbed bench thesis": ("stillbed bench thesis sessions/monday", LONG),
    "stillbed bench thesis [SESSION...]": ("stillbed bench thesis sessions/monday", LONG),
    "python -m tests.campaigns views --seconds 5": ("python -m tests.campaigns views --seconds 0.5", LONG),
    "stillbed calibrate arm --virtual --record try -o arm.toml": (VIRTUAL, LONG),
    "stillbed calibrate dispenser dispenser.toml --virtual --record lines": (LINES, "takes long as it stands"),
    "stillbed calibrate cameras SESSION --board board.toml -o rig.toml": (
        "stillbed calibrate cameras waved --board board.toml -o rig.toml",
        "a session in which a board is waved",
    ),
    "stillbed calibrate cameras CAMERAS... --board board.toml -o rig.toml": (WAVED, "nobody waves as long as it asks"),
    "stillbed cameras rtsp://192.168.0.20/stream": ("stillbed cameras http://CAMERA", "a camera that sends pictures"),
    "stillbed cameras usb:A1B2C3D4 --seconds 10 --json": (
        "stillbed cameras http://CAMERA --seconds 1 --json",
        "a camera that is not plugged in",
    ),
    "stillbed live --rig rig.toml --path path.csv --scan scan.ply --arm /dev/ttyUSB0 --record run.mcap": (
        "stillbed live --rig sessions/monday --path path.csv --arm virtual --record run.mcap",
        "cameras that see the arm's surface",
    ),
    "stillbed live session.toml": (PAGE, "the same in a folder, with more said"),
    "stillbed live monday/session.toml": (PAGE, MORE),
    "stillbed live --simulated data/scenarios/breathing_calm.toml --record run.mcap --yes": (
        "stillbed live --simulated data/live/small.toml --record out/run.mcap",
        "the same with an operator who says yes",
    ),
    "stillbed replay SESSION --path PATH.csv -o OUT": (
        'stillbed replay sessions/monday --path path.csv -o out/replay --fault "camera1 off at 3s for 1s"',
        MORE,
    ),
    "stillbed live --resume monday/run.mcap": ("stillbed live --resume run.mcap", WALKED),
    "stillbed record monday/session.toml -o try.mcap": (RECORDED, WALKED),
    "stillbed replay monday/run.mcap -o out/replay": ("stillbed replay run.mcap -o out/replay", WALKED),
    "stillbed smooth monday/run.mcap -o out/smoothed": ("stillbed smooth run.mcap -o out/smoothed", WALKED),
    "stillbed track try.mcap -o out/tracked": (TRACKED, WALKED),
    "stillbed replay run.mcap -o OUT": ("stillbed replay run.mcap -o out/replay", "the same to another folder"),
    "stillbed live session.toml --region region.toml": (PAGE, "tests/test_region_live.py runs it with regions"),
    "stillbed record RIG.toml -o X.mcap [--seconds S]": (RECORDED, "for some seconds"),
    "stillbed record rig.toml -o try.mcap": (RECORDED, "for some seconds"),
    "stillbed record rig.toml -o try.mcap --seconds 20 --jpeg-quality 0": (RECORDED, "the same with a page"),
    "stillbed record live.toml -o waved.mcap": (RECORDED, "for some seconds"),
    "stillbed simulate SCENARIO.toml -o OUT": (SIMULATED, "the same to another folder"),
    "stillbed simulate data/scenarios/NAME.toml -o OUT": (SIMULATED, "the same to another folder"),
    "stillbed smooth DIR -o OUT --scheduler local": (CLUSTER, MORE),
    "stillbed smooth SESSION... -o OUT [--rate HZ]": (
        "stillbed smooth out/calm/session.mcap -o out/smoothed --rate 1000",
        "the same of another session",
    ),
    "stillbed track SESSION -o OUT": (TRACKED, MORE),
    "stillbed track SESSION -o OUT [--record X.mcap]": (TRACKED, MORE),
    "stillbed track SESSION --method thesis -o OUT": (
        "stillbed track sessions/monday -o out/new --method thesis",
        "the same in another order",
    ),
    "stillbed live --resume out/run.mcap": ("stillbed live --resume run.mcap", "the same outside of a folder"),
    "stillbed smooth sessions/ -o out/all --scheduler tcp://cluster:8786": (CLUSTER, "a cluster of one's own"),
    **{
        f"python -m tests.campaigns faults{size}": (FAULTS, LONG)
        for size in (
            *("", " --count 147 --seed 1", " --count 42 --seed 1", " --count 5663 --seed 1", " --count 1600 --seed 6"),
            " --count 10000 --jobs 2 --log faults.csv",
            " --count 10000 --jobs 2 --log faults.csv -o out/faults",
        )
    },
    **{
        f"python -m tests.campaigns fuzz --count {count}": ("python -m tests.campaigns fuzz --count 60", LONG)
        for count in (20000, 1000000)
    },
    "python -m tests.campaigns guard --commands 1000000": ("python -m tests.campaigns guard --commands 2000", LONG),
    "python -m tests.campaigns link --hours 24": ("python -m tests.campaigns link --hours 0.01", LONG),
    "python -m tests.campaigns outages": ("python -m tests.campaigns outages --count 1", LONG),
    "python -m tests.campaigns outages --count 1000 --seed 1": ("python -m tests.campaigns outages --count 1", LONG),
    **{
        f"make {target}": (f"make --dry-run {target}", INSTALLS)
        for target in (
            *("audit", "bench", "check", "counterparts", "deceit", "demo", "docs", "fuzz", "hazards", "mutants"),
            *("outages", "references", "slow", "test", "test PYTHON=python3.12"),
        )
    },
}
LONG_KINDS = "make ", "pip ", "python -m tests.", "stillbed bench "  # these install or take long, unless said otherwise
SHORT = {  # of these kinds, and no longer than it may take as it stands
    "python -m tests.campaigns",
    "stillbed bench --list",
    "python -m tests.campaigns consistency --scenes 1 --seconds 4",
    "python -m tests.campaigns fill --count 0 --picture docs/patterns.svg",
}
MOVED = "tests/test_arm_console.py moves a virtual arm before cameras that see its needle, which takes a minute"
RECORDED = "--cameras rig.toml --record"
DRAWN = "tests/test_calibrate_dispenser.py draws lines with a virtual arm and measures the recording"
MADE = (  # by these tests/workspace.py makes what the others name
    "stillbed calibrate export rig.toml --format kalibr -o camchain.yaml",
    VIRTUAL,
    SIMULATED,
    "stillbed smooth out/calm/session.mcap -o out/smoothed --rate 1000",
)
TRAINED = "tests/test_training.py trains, where torch is installed"
ROBOT = "needs a robot; tests/test_arm_laws.py meets a simulated one"
CALM = "data/scenarios/breathing_calm.toml"
NOT_RUN = {  # and why not
    "pip install 'stillbed[franka]'": "installs from a network",
    "python -m tests.dependency_table": "tests/test_shipped.py asks whether what it would write is there",
    "stillbed arm franka://172.16.0.2": ROBOT,
    "stillbed live session.toml --arm franka://172.16.0.2 --profile fr3.toml": ROBOT,
    f"stillbed live --simulated {CALM} --arm franka://127.0.0.1 --record run.mcap": "tests/test_franka_live.py runs it",
    "stillbed reach path.csv --arm data/arms/fr3.toml --amplitude-mm 5": "needs pinocchio; see tests/test_urdf.py",
    "stillbed arm gcode:///dev/ttyACM0 --arm data/arms/gantry.toml": "needs a machine; see tests/test_gcode.py",
    "stillbed live session.toml --arm gcode:///dev/ttyACM0 --profile gantry.toml": "the same",
    "stillbed cameras genicam://Basler-21876543": "needs a camera; see tests/test_genicam.py",
    "stillbed live session.toml --foxglove 8765": "tests/test_foxglove.py runs it",
    "python -m tests.stop_latency": "needs a machine with little else to do for minutes",
    "pip install -c constraints.txt .": "installs what the tests run with, from a network",
    "stillbed bench --all": "tests/test_bench.py runs the whole with small parts; all of them take 20 minutes",
    "stillbed bench --quick": "the same of fewer",
    "python -m tests.campaigns --all": "the same of more",
    "stillbed calibrate arm --device /dev/ttyUSB0 --cameras rig.toml --record moved --yes -o arm.toml": MOVED,
    "stillbed calibrate arm --device /dev/ttyUSB0 --cameras rig.toml --record try --yes -o arm.toml": MOVED,
    "stillbed calibrate arm --device PORT --cameras rig.toml --record DIR --yes -o arm.toml": MOVED,
    "stillbed calibrate arm --virtual --terminal --record try -o arm.toml": MOVED,
    f"stillbed calibrate dispenser DISPENSER.toml --device PORT --arm ARM.toml {RECORDED} DIR --yes": DRAWN,
    f"stillbed calibrate dispenser dispenser.toml --device /dev/ttyUSB0 --arm arm.toml {RECORDED} lines --yes": DRAWN,
    "stillbed calibrate dispenser dispenser.toml --from lines": DRAWN,
    "stillbed train DATASET --network thesis": TRAINED,
    "stillbed train DATASET -o X.onnx": TRAINED,
    "stillbed train data/fuseg data/medetec -o wound.onnx": TRAINED,
}


def filled(text: str) -> str:
    """A command with a value for each of its placeholders, and with all that may be left out."""
    words = re.sub(r" or NAMES|\.\.\.|[][]", "", text).split(" ")
    return " ".join(VALUES.get(word, word) for word in words if word)


def to_run(text: str) -> str | None:
    """What is run for a command of the documents; None where nothing is."""
    if text in NAMES or text in NOT_RUN:
        return None
    if text in COMPLETED:
        return COMPLETED[text]
    return INSTEAD[text][0] if text in INSTEAD else filled(text)
