"""What processes load, above all the motion's, seen from a fresh interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HEAVY = {"gtsam", "cv2", "onnxruntime", "scipy", "numba"}
SLOW_PARTS = {"scipy.interpolate", "scipy.optimize", "scipy.signal", "scipy.stats", "matplotlib", "pandas"}  # s each
SLOW_PARTS |= {"numpy.f2py", "numpy.testing"}
RUN = """
import sys
import numpy as np
from dataclasses import replace
from estimation.pose import Forecast
from hardware.motion.step import MotionStep
from perception.frames import SYRINGE
from planning.clearance import TissueGuard, envelope_over, tool_body
from planning.command import Move
from tests.moving_surfaces import breathing, pose_at, raster

body = tool_body(SYRINGE, (), margin=0.0, touch=1.0)
tissue = TissueGuard(body, envelope_over(np.eye(4), np.array([-40.0, -40]), 1.0, np.full((81, 81), -3.0), 15.0))
motion = MotionStep(raster(), tissue=tissue)
begun = set(sys.modules)
horizons = np.array([0.1, 0.3, 0.5])
forecast = Forecast(horizons, np.zeros((3, 6)), np.tile(1e-6 * np.eye(6), (3, 1, 1)))
for k in range(20):
    last = motion(replace(pose_at(breathing, k * 0.02), forecast=forecast), k * 0.02)
assert isinstance(last, Move)
assert 0.0 < tissue.room(np.eye(4))[0] < 15.0
assert set(sys.modules) == begun, set(sys.modules) - begun
print(*sys.modules)
"""


def loaded(code: str) -> set[str]:
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_a_running_motion_step_has_loaded_nothing_that_would_stall_it() -> None:
    modules = loaded(RUN)
    assert {"hardware", "planning", "toppra", "ruckig"} <= modules
    assert HEAVY.isdisjoint(modules)


def test_the_check_can_fail() -> None:
    assert "cv2" in loaded("import cv2, sys; print(*sys.modules)")


def test_replay_loads_no_images_before_it_has_a_session() -> None:
    assert HEAVY.isdisjoint(loaded("import hardware.offline.replay, sys; print(*sys.modules)"))


def test_the_motion_process_loads_no_scipy() -> None:
    modules = loaded("import hardware.live.motion_process, sys; print(*sys.modules)")
    assert {"toppra", "ruckig", "numpy"} <= modules
    assert HEAVY.isdisjoint(modules)


@pytest.mark.parametrize(
    "module", ["hardware.live.tracking_process", "hardware.simulator.simulate", "estimation.mapping.refiner"]
)
def test_of_scipy_only_what_is_used_is_loaded(module: str) -> None:
    code = f"import sys; from estimation.runtime import load_scipy; load_scipy(); import {module}; print(*sys.modules)"
    modules = loaded(code)
    assert {"gtsam", "numba", "scipy.spatial"} <= modules
    assert SLOW_PARTS.isdisjoint(modules)


NOT_FOR_HELP = {
    "numpy", "importlib.metadata", "concurrent.futures", "statistics", "tomllib", "multiprocessing", "inspect",
    "dataclasses", "datetime", "json", "hashlib", "subprocess", "difflib", "socket", "pickle", "ctypes",
}  # fmt: skip


def test_a_command_line_loads_nothing_that_its_help_does_not_say() -> None:
    modules = loaded("from hardware.cli.main import parser; import sys; parser().format_help(); print(*sys.modules)")
    assert {"argparse", "hardware.cli.sessions", "hardware.cli.live"} <= modules
    assert NOT_FOR_HELP.isdisjoint(modules)


def test_a_command_loads_the_options_of_no_other() -> None:
    modules = loaded("from hardware.cli.main import parser; import sys; parser('track'); print(*sys.modules)")
    assert {name for name in modules if name.startswith("hardware.cli.")} == {
        "hardware.cli.main", "hardware.cli.parser", "hardware.cli.sessions",
    }  # fmt: skip
    assert NOT_FOR_HELP.isdisjoint(modules)
