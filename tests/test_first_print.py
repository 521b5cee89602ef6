"""docs/first_print.md on hardware, walked as printed there: every command, cameras, arm and dispenser is a process.

The cameras look at a rendered chest that breathes, and say where it truly was; the virtual arm says where its nozzle
was, and the virtual dispenser what flowed, each by the machine's monotonic clock. So it is known where each bead lies
on the surface, whatever the run believes.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST
from hardware.arm.profile import placed
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.path_file import read_path
from hardware.files.ply_file import write_ply
from hardware.files.rig_file import read_rig, write_board
from hardware.recording.session_reader import open_session
from hardware.simulator.deposit import PlannedLine, planned_line
from hardware.simulator.scene.scene import rois
from planning.kinematics import nozzle_from_axes
from tests.board_session import BOARD, small_rig
from tests.live_runs import CLOCK, ROOT, Running, printed_once
from tests.outside_cameras import BREATH, outside, wound_rig, wound_scene

SCAN_FROM_TRUE = se3.make(se3.exp_rotation([0.1, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame
STL = "plan wound.ply -o path.csv --arm arm.toml --tissue gel=rest:1:20 --layer-height 1.2 --bead 1.6 --speed 5"
PLAN = f"{STL} --travel 15"
LIFT = 20.0  # mm
DELAYS = (0.08, 0.04, 0.08, 0.04)  # s
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


@dataclass(frozen=True)
class Done:
    """What a command said, and its exit code."""

    code: int
    said: str


class Table:
    """A folder in which a reader of the page works."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, command: str) -> Done:
        """`stillbed` with these words, to its end."""
        done = subprocess.run(
            [sys.executable, "-m", "hardware.cli.main", *command.split()],
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
            [sys.executable, "-u", "-m", "hardware.cli.main", *command.split()],
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

    def live(self, *words: str) -> Running:
        """`stillbed live`."""
        return Running(*words, "--no-page", cache=self.folder, cwd=self.folder)

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
    done = table(PLAN)
    assert done.code == 0 and "1 layer" in done.said, done.said
    return table


@pytest.fixture(scope="module")
def watched(planned: Table) -> Iterator[Table]:
    """Before cameras, with a session.toml that says all of it."""
    with outside(planned.folder, "wound"):
        assert planned("init monday").code == 0
        planned.describe(
            "monday/session.toml",
            **{"rig": "../rig.toml", "path": "../path.csv", "scan": "../wound.ply", "device": "./arm"},
            **{"profile": "../arm.toml", "dispensers": "../dispenser.toml", "file": "run.mcap", "patience_s": 120.0},
        )
        yield planned


# -- steps that need no pictures of the wound


def test_plan_and_reach(planned: Table) -> None:
    path = read_path(planned.folder / "path.csv")
    assert path.extrude.any() and (planned.folder / "path.html").exists() and "feasible" in path.extra
    assert planned("reach path.csv --arm arm.toml --amplitude-mm 10 -o out/reach").code == 0
    assert (planned.folder / "out/reach/reach.html").exists()


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

    def beads(self) -> list[slice]:
        """Rows of each stretch in which material flows."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], self.flows.astype(int), [0]])))
        return [slice(a, b) for a, b in edges.reshape(-1, 2)]


def truth_of(table: Table, name: str) -> Truth:
    """From the logs of the arm, of the dispenser and of who shows the pictures."""
    arm, flow, shown = (
        np.loadtxt(table.folder / file, delimiter=",", skiprows=skip)
        for file, skip in ((f"arm_{name}.csv", 1), (f"flow_{name}.csv", 1), ("shown.csv", 0))
    )
    profile = read_arm(table.folder / "arm.toml").arm
    inside = (arm[:, 0] > shown[0, 0]) & (arm[:, 0] < shown[-1, 0])
    stamps, axes = arm[inside, 0], arm[inside, 1:] * [1, 1, 1, *np.deg2rad([1.0, 1, 1])]
    _, first = np.unique(shown[:, 0], return_index=True)
    poses = np.zeros((len(first), 4, 4))
    poses[:, :3], poses[:, 3, 3] = shown[first, 2:].reshape(-1, 3, 4), 1.0
    ticks = shown[first, 0]
    after = np.clip(np.searchsorted(ticks, stamps), 1, len(ticks) - 1)
    share = (stamps - ticks[after - 1]) / (ticks[after] - ticks[after - 1])
    base_from_surface = se3.interpolate(poses[after - 1], poses[after], share)
    surface_from_nozzle = se3.inverse(base_from_surface) @ nozzle_from_axes(profile, axes)
    return Truth(stamps, surface_from_nozzle[:, :3, 3], np.interp(stamps, flow[:, 0], flow[:, 1]))


def true_line(table: Table) -> tuple[PlannedLine, Array]:
    """The planned path on the true surface: its pieces (K - 1), and the tool's direction (K, 3) at its checkpoints."""
    path = read_path(table.folder / "path.csv")
    poses = se3.inverse(SCAN_FROM_TRUE) @ path.surface_from_nozzle
    line = planned_line(path)
    return PlannedLine(line.knots, poses[:, :3, 3], line.printed, line.layer), poses[:, :3, 2]


def ended(run: Running) -> int:
    """Its exit code, once it has ended within some minutes."""
    try:
        return run.process.wait(240)
    finally:
        run.close()
        print(run.said[-3000:])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_dry_run(watched: Table) -> None:
    with watched.devices("dry"):
        assert ended(watched.live("monday/session.toml", "--dry-run", "--lift", "20", "--yes")) == 0
    truth, (line, up) = truth_of(watched, "dry"), true_line(watched)
    assert not truth.flow.any(), "nothing is extruded"
    lifted = line.points + LIFT * up
    far = np.array([np.linalg.norm(truth.tip - point, axis=1).min() for point in lifted])
    near = np.array([np.linalg.norm(truth.tip - point, axis=1).min() for point in line.points])
    print("lifted path passed at", np.percentile(far, [50, 95, 100]), "lowest above path", near.min())
    assert near.min() > LIFT - 1.0 and np.percentile(far, 95) < 0.6


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_print(watched: Table) -> None:
    with watched.devices("print"):
        run = watched.live("monday/session.toml", "--yes")
        try:
            run.wait_for(r"\nprint\n")
            CLOCK.wait_until(CLOCK.now() + 5.0)
            run.process.send_signal(signal.SIGTERM)
        finally:
            assert ended(run) > 128
        assert ended(watched.live("--resume", "monday/run.mcap", "--yes")) == 0
    truth, (line, _) = truth_of(watched, "print"), true_line(watched)
    across = line.distance(truth.tip[truth.flows])
    print("across", np.percentile(across, [50, 95, 99, 100]), truth.flows.sum())
    for bead in truth.beads():
        print(bead, truth.stamps[bead.stop - 1] - truth.stamps[bead.start], truth.tip[bead.start], truth.tip[bead.stop - 1])
    np.savez("/tmp/w/try/print.npz", stamps=truth.stamps, tip=truth.tip, flow=truth.flow, points=line.points, printed=line.printed)
    assert np.percentile(across, 95) < 0.6
