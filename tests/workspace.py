"""A folder that holds what the commands of the documents name: small, short, and made by stillbed's own commands."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import trustme

from estimation.scans.scan import scan_from_triangles
from hardware.cli.main import main
from hardware.files.path_file import read_path, write_progress_durably
from hardware.files.rig_file import ImageSource, write_board, write_rig
from hardware.live.prerender import prerender
from hardware.process.clock import WallClock
from planning.path import fingerprint
from tests.board_session import BOARD, rendered, small_rig
from tests.live_runs import ROOT, SCENARIO, Running
from tests.shown_commands import MADE
from tests.test_arm_calibration import touched, touched_file
from tests.test_mesh_file import write as write_mesh
from tests.test_training_data import labelled
from tests.test_training_data import write as write_labelled
from tests.wound_scans import scan_of

CLOCK = WallClock()
SECONDS = 6.0  # the faults that the documents name begin before
PRINTED = 2.0  # s of printing, before the run that is to be resumed is interrupted
PATH = """x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude
-6,-1,0,0,0,0,5,1,20,0,0
6,-1,0,0,0,0,5,1,20,0,1
6,1,0,0,0,0,5,1,20,0,1
-6,1,0,0,0,0,5,1,20,0,1
"""  # 26 mm: 5 s
DISPENSER = """[[dispenser]]
name = "syringe"
materials = [1]
preset = "arduino"
port = "./dispensing"
start_s = 0.0
kept_at_c = 20
"""
LEFT = re.compile(r"(?:-o|--record|--link|--picture|--log|--gcode) (\S+)")  # what a command says it leaves
MORE_LEFT = {
    "stillbed init monday": "monday/session.toml",
    "stillbed init sessions/monday": "sessions/monday/session.toml",
    "stillbed live --resume run.mcap": "run-2.mcap",
}
SESSION = """[cameras]
simulated = "../data/scenarios/breathing_calm.toml"
[record]
file = "run.mcap"
"""


def prepare(folder: Path, sources: Sequence[str]) -> None:
    """The folder, with all that is named; sources: what rig.toml takes the cameras' pictures from."""
    shutil.copytree(ROOT / "data", folder / "data")
    made_small(folder / "data")
    for name in ("out", "docs", "sessions", "traces", "monday"):
        (folder / name).mkdir()
    (folder / "path.csv").write_text(PATH, encoding="utf-8")
    write_progress_durably(folder / "progress.toml", fingerprint(read_path(folder / "path.csv")), 1.5)
    (folder / "dispenser.toml").write_text(DISPENSER, encoding="utf-8")
    (folder / "contour.csv").write_text("x_mm,y_mm\n0,0\n12,0\n12,8\n0,8\n", encoding="utf-8")
    (folder / "monday/session.toml").write_text(SESSION, encoding="utf-8")
    write_mesh(folder / "wound.stl", scan_from_triangles(*scan_of()))
    certify(folder)
    calibrated(folder, sources)
    for text in MADE:
        run(folder, text)
    simulated(folder)
    moved(folder)
    interrupted(folder)


def made_small(data: Path) -> None:
    """The scenarios that the documents show, in small pictures and short."""
    for name in ("scenarios/breathing_calm.toml", "live/calm.toml", "live/small.toml"):
        text = (
            SCENARIO.replace("seconds = 2.7", f"seconds = {SECONDS}")
            .replace("path.csv", "../../path.csv")
            .replace("fps = 20.0", "fps = 15.0")
        )
        (data / name).write_text(text, encoding="utf-8")


def certify(folder: Path) -> None:
    """page.pem and page.key."""
    made = trustme.CA().issue_cert("printer.local")
    made.cert_chain_pems[0].write_to_path(folder / "page.pem")
    made.private_key_pem.write_to_path(folder / "page.key")


def calibrated(folder: Path, sources: Sequence[str]) -> None:
    """A waved board, rigs, and points that an arm has touched."""
    rendered(folder / "waved", instants=12)
    write_board(folder / "board.toml", BOARD)
    for name in ("rig.toml", "live.toml"):
        write_rig(folder / name, small_rig(), [ImageSource("source", source) for source in sources])
    _, axes, points = touched(6, True, 0.0)
    (folder / "touched").mkdir()
    file, _ = touched_file(folder / "touched", axes, points, pixels=False)
    shutil.copy(file, folder / "points.toml")


def moved(folder: Path) -> None:
    """The recording of an arm that was moved, which is large and read alone, and an arm file."""
    (folder / "try").rename(folder.parent / "moved")
    (folder / "moved").symlink_to(folder.parent / "moved")
    shutil.copy(folder / "data/arms/s6h4d.toml", folder / "arm.toml")


def simulated(folder: Path) -> None:
    """Sessions, poses and pictures."""
    for name in ("monday", "tuesday"):
        shutil.copytree(folder / "out/calm/session", folder / "sessions" / name)
    for name in ("moved.tum", "traces/breathing.tum"):
        shutil.copy(folder / "out/calm/session/truth.tum", folder / name)
    (folder / "pictures").mkdir()
    for number in range(3):
        one = labelled(number)
        cv2.imwrite(str(folder / "pictures" / f"{number}.jpg"), one.picture)
        write_labelled(folder / "dataset", f"{number}", one.picture, 255 * one.wound.astype(np.uint8))


def interrupted(folder: Path) -> None:
    """run.mcap, of a live run that was interrupted while it printed."""
    words = (
        "--simulated",
        "data/scenarios/breathing_calm.toml",
        "--record",
        "run.mcap",
        "--yes",
        "--no-page",
        "--trace",
        "first.json",
    )
    cache = folder.parent / "cache"
    prerender(folder / words[1], cache / "stillbed", threads=1)
    live = Running(*words, "--trace", "first.json", cache=cache, cwd=folder)
    try:
        live.wait_for(r"\nprint\n")
        CLOCK.wait_until(CLOCK.now() + PRINTED)
        live.process.send_signal(signal.SIGINT)
        assert live.end() > 128, live.said
    finally:
        live.close()


def left_by(text: str) -> list[Path]:
    """What a command is to leave."""
    return [Path(name) for name in [*LEFT.findall(text), *filter(None, [MORE_LEFT.get(text)])]]


def run(folder: Path, text: str) -> None:
    """Run a command in that folder: it comes to its end, whatever its verdict, and leaves what it says."""
    here = Path.cwd()
    os.chdir(folder)
    try:
        assert main(shlex.split(text)[1:]) in (0, 1), text
        assert all(file.exists() for file in left_by(text)), text
    finally:
        os.chdir(here)
