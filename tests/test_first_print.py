"""docs/first_print.md on hardware, walked as printed there: every command, cameras, arm and dispenser is a process.

The cameras look at a rendered chest that breathes, and say where it truly was; the virtual arm says where its nozzle
was, and the virtual dispenser what flowed, each by the machine's monotonic clock. So it is known where each bead lies
on the surface, whatever the run believes.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from estimation import se3
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from hardware.arm.profile import placed
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.folder_tables import read_tum
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import read_path
from hardware.files.rig_file import read_rig, write_board
from hardware.simulator.deposit import PlannedLine, planned_line
from hardware.simulator.scene.scene import rois
from planning.kinematics import nozzle_from_axes
from tests.board_session import BOARD, small_rig
from tests.documents import QUOTED
from tests.live_runs import CLOCK, ROOT, Running, printed_once
from tests.outside_cameras import WOUND_FPS, outside, wound_rig, wound_scene

SCAN_FROM_TRUE = se3.make(se3.exp_rotation([0.1, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame
SMALL = "--tissue gel=rest:1:20 --layer-height 1.2 --bead 1.6 --speed 5 --travel 15"  # 47 mm of bead in 10 s
LIFT = 20.0  # mm
RISE = 2.0  # mm by which the skin comes nearer to a nozzle that is held: `outside_cameras.breath_at`
DELAYS = (0.08, 0.04, 0.08, 0.04)  # s
PROGRAM = (sys.executable, "-u", "-m", "hardware.cli.main")
STOPPED_AT = 45.0  # checkpoints of some 140
SWITCHING = 400  # rows, 0.4 s: delays, and what is left of the flow after ten time constants
HALF_FLOW = 0.5  # mm^3/s of the virtual dispenser's 1
DISPENSER = """[[dispenser]]
name = "valve"
materials = [1]
preset = "arduino"
port = "./dispenser"
start_s = 0.0
kept_at_c = 20
on_dead_time_s = {}
on_lag_s = {}
off_dead_time_s = {}
off_lag_s = {}
""".format(*DELAYS)


PAGE = (ROOT / "docs/first_print.md").read_text(encoding="utf-8").split("## On hardware")[1]
PRINTED = {" ".join(words.split()) for words in QUOTED.findall(PAGE)}
ELSEWHERE = {  # printed there and not run here
    "stillbed plan": "named in passing",
    "stillbed calibrate cameras CAMERAS... --board board.toml -o rig.toml": "tests/test_calibrate_live.py",
    "stillbed calibrate arm --device /dev/ttyUSB0 --cameras rig.toml --record try --yes -o arm.toml": (
        "tests/test_arm_console.py: cameras that see the needle"
    ),
    "stillbed calibrate dispenser dispenser.toml --device /dev/ttyUSB0 --arm arm.toml --cameras rig.toml "
    "--record lines --yes": "tests/test_calibrate_dispenser.py: cameras that see lines of material",
}


@dataclass(frozen=True)
class Done:
    """What a command said, and its exit code."""

    code: int
    said: str


class Table:
    """A folder in which a reader of the page works."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, printed: str, more: str = "") -> Done:
        """A command as the page prints it, to its end, and what more it is told; the devices are the table's."""
        assert printed in PRINTED, printed
        command = f"{printed} {more}".replace("/dev/ttyUSB0", "./arm").replace("wound.stl", "wound.ply")
        done = subprocess.run(
            [*PROGRAM, *command.split()[1:]],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert "Traceback" not in done.stderr, done.stderr
        return Done(done.returncode, done.stdout + done.stderr)

    @property
    def environment(self) -> dict[str, str]:
        more = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        return os.environ | {"PYTHONPATH": more, "XDG_CACHE_HOME": str(self.folder), "OPENBLAS_NUM_THREADS": "1"}

    @contextmanager
    def beside(self, command: str) -> Iterator[None]:
        """`stillbed` with these words, which serves a device meanwhile."""
        process = subprocess.Popen(
            [*PROGRAM, *command.split()],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        try:
            assert process.stdout.readline().startswith("/dev/")
            yield
        finally:
            process.terminate()
            process.communicate(timeout=60)

    @contextmanager
    def devices(self, name: str) -> Iterator[None]:
        """An arm at ./arm and a dispenser at ./dispenser; arm_NAME.csv and flow_NAME.csv say what they did."""
        delays = " ".join(map(str, DELAYS))
        with ExitStack() as stack:
            arm = f"arm --virtual --arm arm.toml --link ./arm --replies stream --log arm_{name}.csv"
            stack.enter_context(self.beside(arm))
            told = f"dispenser virtual --link ./dispenser --log flow_{name}.csv --delays {delays}"
            stack.enter_context(self.beside(told))
            yield

    def log(self, name: str, header: int = 1) -> Array:
        """The rows of a log."""
        return np.loadtxt(self.folder / name, delimiter=",", skiprows=header)

    def fraction(self, name: str) -> float:
        """How far a print is, in checkpoints."""
        file = self.folder / name
        return float(tomllib.loads(file.read_text())["fraction"]) if file.exists() else 0.0

    def live(self, printed: str, *more: str) -> Running:
        """The same of a live run, which goes on meanwhile."""
        assert printed in PRINTED, printed
        return Running(*printed.split()[2:], *more, "--no-page", cache=self.folder, cwd=self.folder)

    def describe(self, name: str, **values: object) -> None:
        """Fill in a session.toml that `stillbed init` wrote, as somebody does in an editor: key = value."""
        file = self.folder / name
        text = file.read_text()
        for key, value in values.items():
            shown = f'"{value}"' if isinstance(value, str) else repr(value)
            text, count = re.subn(rf"(?m)^(?:# )?{key} = .*?(?=  #|$)", f"{key} = {shown}", text)
            assert count == 1, key
        text += "".join(f"{camera} = {corners}\n" for camera, corners in region().items())
        file.write_text(text)


def region() -> dict[str, list[list[float]]]:
    """What somebody clicks round the skin in each camera's picture."""
    scene, rig = wound_scene(), wound_rig()
    polygons = {rig.cameras[roi.camera].name: roi.polygon for roi in rois(scene, rig, BASE_FROM_REST, 0.0)}
    return {name: each[:: len(each) // 12].round(1).tolist() for name, each in polygons.items()}


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Table:
    """With a scan of the wound, and files of arm and dispenser."""
    folder = tmp_path_factory.mktemp("table")
    vertices, triangles = wound_scene().shape.mesh(0.5)
    write_ply(folder / "wound.ply", vertices=se3.transform_points(SCAN_FROM_TRUE, vertices), triangles=triangles)
    write_arm(folder / "arm.toml", placed(read_arm(ROOT / "data/arms/s6h4d.toml"), BASE_FROM_REST))
    (folder / "dispenser.toml").write_text(DISPENSER)
    return Table(folder)


@pytest.fixture(scope="module")
def planned(table: Table) -> Table:
    """With a path on the scan."""
    done = table("stillbed plan wound.stl -o path.csv --arm arm.toml", SMALL)
    assert done.code == 0 and "1 layer" in done.said, done.said
    return table


@pytest.fixture(scope="module")
def watched(planned: Table) -> Iterator[Table]:
    """Before cameras, with a session.toml that says all of it."""
    with outside(planned.folder, "wound"):
        assert planned("stillbed init monday").code == 0
        planned.describe(
            "monday/session.toml",
            **{"rig": "../rig.toml", "path": "../path.csv", "scan": "../wound.ply", "device": "./arm"},
            **{"profile": "../arm.toml", "dispensers": "../dispenser.toml", "file": "run.mcap", "patience_s": 120.0},
        )
        yield planned


# -- steps that need no pictures of the wound


def test_each_command_that_is_printed_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8").replace('"\n    "', "")
    walked = {text for text in PRINTED if f'"{text}"' in here}
    assert set(ELSEWHERE) <= PRINTED == walked
    named = re.findall(r"tests/\w+\.py", " ".join(ELSEWHERE.values()))
    assert len(named) == 3 and all((ROOT / file).is_file() for file in named)


@pytest.mark.slow
def test_the_arm_and_the_dispenser_are_tried(table: Table) -> None:
    with table.devices("tried"):
        heard = table("stillbed arm /dev/ttyUSB0", "--seconds 1")
        assert heard.code == 0 and "answers X202.50 Y225.00 Z113.00" in heard.said, heard.said
        assert table("stillbed arm /dev/ttyUSB0 --home --yes").code == 0
        assert table("stillbed arm /dev/ttyUSB0 --jog X=+5 --yes").code == 0
        assert table("stillbed dispenser dispenser.toml", "--seconds 1").code == 0
        assert table("stillbed dispenser dispenser.toml --on 2 --yes").code == 0
    arm, flow = table.log("arm_tried.csv"), table.log("flow_tried.csv")
    home = read_arm(table.folder / "arm.toml").arm.home
    assert np.abs(arm[-1, 1:4] - home[:3] - [5, 0, 0]).max() < 0.05
    assert abs(0.001 * (flow[:, 1] > HALF_FLOW).sum() - 2.0) < 0.2  # s: on a busy machine it is told late


@pytest.mark.slow
def test_plan_and_reach(planned: Table) -> None:
    path = read_path(planned.folder / "path.csv")
    assert path.extrude.any() and (planned.folder / "path.html").exists() and "feasible" in path.extra
    assert planned("stillbed reach path.csv --arm arm.toml --amplitude-mm 10 -o out/reach").code == 0
    assert (planned.folder / "out/reach/reach.html").exists()


@pytest.mark.slow
def test_calibrate(tmp_path: Path) -> None:
    here = Table(tmp_path)
    assert here("stillbed calibrate board -o board.pdf").code == 0 and (tmp_path / "board.toml").exists()
    write_board(tmp_path / "board.toml", BOARD)  # the one that is waved
    with outside(tmp_path, "board") as rig_file:
        rig_file.rename(tmp_path / "live.toml")
        recorded = here("stillbed record live.toml -o waved.mcap", "--seconds 12 --no-page")
        assert recorded.code == 0, recorded.said
    done = subprocess.run(
        [*PROGRAM, "calibrate", "cameras", "waved.mcap", "--board", "board.toml", "-o", "rig.toml"],
        cwd=tmp_path, env=here.environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    print(done.returncode, done.stdout[-1500:], done.stderr[-500:])
    found = read_rig(tmp_path / "rig.toml").rig
    for camera, true in zip(found.cameras, small_rig().cameras, strict=True):
        assert abs(camera.matrix[0, 0] / true.matrix[0, 0] - 1) < 0.02


# -- steps before the cameras


@pytest.mark.slow
def test_cameras(watched: Table) -> None:
    assert watched("stillbed cameras").code in (0, 1)  # whether any is plugged in here
    done = watched("stillbed cameras rig.toml -o sheet.jpg")
    assert done.code == 0 and (watched.folder / "sheet.jpg").stat().st_size > 10_000, done.said
    rates = [float(rate) for rate in re.findall(r"px, ([\d.]+) Hz", done.said)]
    assert np.abs(np.array(rates) - WOUND_FPS).max() < 0.5 and len(rates) == 3


@pytest.mark.slow
def test_the_cameras_are_recorded_and_tracked(watched: Table) -> None:
    done = watched("stillbed record monday/session.toml -o try.mcap", "--seconds 12 --no-page")
    assert done.code == 0, done.said
    assert watched("stillbed track try.mcap -o out/tracked").code == 0
    off = strayed(watched, watched.folder / "out/tracked/poses.tum")
    print("tracked", np.percentile(off, [50, 95, 100]))
    assert len(off) > 60 and np.percentile(off, 95) < 0.15


# -- what truly happened


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What truly happened, a row a millisecond, N rows.

    stamps: (N,) s. tip: (N, 3) mm, the nozzle's tip in the true surface's frame. flow: (N,) mm^3/s.
    """

    stamps: Array
    tip: Array
    flow: Array

    @property
    def flows(self) -> Array:
        """(N,) whether the flow is above half."""
        return self.flow > HALF_FLOW


def edges(on: Array) -> tuple[Array, Array]:
    """Where stretches of `on` (N,) begin and end: their first rows, and their last."""
    change = np.diff(np.concatenate([[0], on.astype(int), [0]]))
    return np.flatnonzero(change > 0), np.flatnonzero(change < 0) - 1


def nearest(points: Array, places: Array) -> Array:
    """(K,) mm: from each of places (K, 3) to the nearest of points (N, 3)."""
    return np.asarray(cKDTree(points).query(places)[0])


def near(on: Array, rows: int) -> Array:
    """(N,) whether there is one of `on` (N,) within that many rows."""
    return np.convolve(on, np.ones(2 * rows + 1), "same") > 0.5


def along(line: PlannedLine) -> Array:
    """(N, 3) mm: places on all that is printed, at most 0.05 mm apart."""
    pieces = np.stack([line.points[:-1], line.points[1:]], 1)[line.printed]
    count = [int(length / 0.05) + 2 for length in np.linalg.norm(np.diff(pieces, axis=1)[:, 0], axis=1)]
    return np.concatenate([np.linspace(*piece, n) for piece, n in zip(pieces, count, strict=True)])


def shown_at(table: Table, stamps: Array) -> Array:
    """base_from_surface (N, 4, 4), mm, at stamps (N,), s, as the cameras' own program showed it."""
    rows = table.log("shown.csv", 0)
    ticks, first = np.unique(rows[:, 0], return_index=True)
    poses = np.tile(np.eye(4), (len(ticks), 1, 1))
    poses[:, :3] = rows[first, 2:].reshape(-1, 3, 4)
    after = np.clip(np.searchsorted(ticks, stamps), 1, len(ticks) - 1)
    share = (stamps - ticks[after - 1]) / (ticks[after] - ticks[after - 1])
    return se3.interpolate(poses[after - 1], poses[after], share)


def truth_of(table: Table, name: str) -> Truth:
    """From the logs of the arm, of the dispenser and of who shows the pictures."""
    arm, flow, shown = table.log(f"arm_{name}.csv"), table.log(f"flow_{name}.csv"), table.log("shown.csv", 0)
    arm = arm[(arm[:, 0] > shown[0, 0]) & (arm[:, 0] < shown[-1, 0])]
    axes = arm[:, 1:] * [1, 1, 1, *np.deg2rad([1.0, 1, 1])]
    base_from_nozzle = nozzle_from_axes(read_arm(table.folder / "arm.toml").arm, axes)
    surface_from_nozzle = se3.inverse(shown_at(table, arm[:, 0])) @ base_from_nozzle
    return Truth(arm[:, 0], surface_from_nozzle[:, :3, 3], np.interp(arm[:, 0], flow[:, 0], flow[:, 1]))


def strayed(table: Table, poses: Path) -> Array:
    """(N,) mm: how far the poses of a TUM file are from those shown, but for the frame that a tracker chooses."""
    found = read_tum(poses, exact=False)
    change = se3.inverse(shown_at(table, found.stamps)) @ found.base_from_surface
    wound = se3.transform_points(se3.inverse(change[len(change) // 2]), np.zeros((1, 3)))
    places = se3.transform_points(change, wound)[:, 0]
    return np.linalg.norm(places - np.median(places, axis=0), axis=1)


def true_line(table: Table) -> tuple[PlannedLine, Array]:
    """The planned path on the true surface: its pieces (K - 1), and the tool's direction (K, 3) at its checkpoints."""
    path = read_path(table.folder / "path.csv")
    poses = se3.inverse(SCAN_FROM_TRUE) @ path.surface_from_nozzle
    return planned_line(replace(path, surface_from_nozzle=poses)), poses[:, :3, 2]


@contextmanager
def ending(run: Running, *codes: int) -> Iterator[Running]:
    """A run that comes to its end within some minutes, with one of these exit codes; none is left behind."""
    try:
        yield run
        assert run.process.wait(240) in codes, run.said
    finally:
        run.close()
        print(run.said[-4000:])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_dry_run(watched: Table) -> None:
    """Measured: above each checkpoint to 0.21 mm (95 %), 0.30 at most; on a machine of load 10, 0.25 and 0.40."""
    run = "stillbed live monday/session.toml --dry-run --lift 20 --record monday/dry.mcap"
    with watched.devices("dry"), ending(watched.live(run), 0) as live:
        live.wait_for("now: .*\n")
        live.press("y")
        live.wait_for("ready")
        live.press("s")
        at = live.wait_for(r"\nprint\n")
        live.press(" ")
        at = live.wait_for("stopped", at)
        live.press("r")
        live.wait_for(r"\nprint\n", at)
        covered = CLOCK.now()
        (watched.folder / "hand").touch()
        CLOCK.wait_until(covered + 4.0)
        (watched.folder / "hand").unlink()
    truth, (line, up) = truth_of(watched, "dry"), true_line(watched)
    assert not truth.flow.any(), "nothing is extruded"
    arm = watched.log("arm_dry.csv")
    still = arm[(arm[:, 0] > covered + 1.5) & (arm[:, 0] < covered + 3.9), 1:4]
    assert np.ptp(still, axis=0).max() < 0.05, "it waits until the hand is gone"
    far = nearest(truth.tip, line.points + LIFT * up)
    low = line.distance(truth.tip).min()
    print(f"above each checkpoint {np.percentile(far, 95):.3f} mm (95 %), {far.max():.3f}; at {low:.2f} mm or more")
    assert low > LIFT - RISE - 0.3 and np.percentile(far, 95) < 0.6


@pytest.fixture(scope="module")
def printed(watched: Table) -> Table:
    """A print that was stopped under way and resumed: monday/run.mcap and monday/run-2.mcap."""
    with watched.devices("print"):
        with ending(watched.live("stillbed live monday/session.toml", "--yes"), 128 + signal.SIGTERM) as live:
            live.wait_for(r"\nprint\n")
            while watched.fraction("monday/run.progress.toml") < STOPPED_AT:
                assert live.process.poll() is None
                CLOCK.wait_until(CLOCK.now() + 0.02)
            live.process.send_signal(signal.SIGTERM)
        with ending(watched.live("stillbed live --resume monday/run.mcap", "--yes"), 0):
            pass
    return watched


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_print(printed: Table) -> None:
    """Measured: 0.16 mm from the path (95 %), 0.29 at most, begins 0.30 and ends 0.15 at most, 0.23 left open.

    On a machine of load 10: 0.43, 0.74, 0.21, 0.16, 0.37. Where the dispenser's delays are not told, begins are off by
    0.59 and ends by 0.42.
    """
    truth, (line, _) = truth_of(printed, "print"), true_line(printed)
    laid = truth.tip[truth.flows]
    off, open_ = line.distance(laid), nearest(laid, along(line))
    (first, last), (start, end) = edges(truth.flows), edges(line.printed)
    begins = nearest(truth.tip[first], line.points[start])
    ends = nearest(truth.tip[last], line.points[end + 1])
    print(f"from the path {np.percentile(off, 95):.3f} mm (95 %), {off.max():.3f}; left open {open_.max():.3f}")
    print(f"beads begin within {begins.max():.3f} mm, end within {ends.max():.3f}")
    assert np.percentile(off, 95) < 0.6 and off.max() < 1.2
    assert np.percentile(open_, 95) < 0.6 and open_.max() < 1.0
    assert begins.max() < 0.5 and ends.max() < 0.4
    stopped, resumed = printed.folder / "monday/run.mcap", printed.folder / "monday/run-2.mcap"
    printed_once(stopped, resumed)
    assert not (truth.flow[~near(truth.flows, SWITCHING)] > 0.01).any(), "no flow but with a bead"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_replay(printed: Table) -> None:
    done = printed("stillbed replay monday/run.mcap -o out/replay")
    assert done.code == 0, done.said  # each frame came again
    print(done.said[-600:])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_smooth(printed: Table) -> None:
    done = printed("stillbed smooth monday/run.mcap -o out/smoothed")
    assert done.code == 0 and (printed.folder / "out/smoothed/report.html").exists(), done.said
    off = strayed(printed, printed.folder / "out/smoothed/smoothed.tum")
    print("smoothed", np.percentile(off, [50, 95, 100]))
    assert len(off) > 60 and np.percentile(off, 95) < 0.15
