"""The motion process: what it loads, seen from a fresh interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
HEAVY = {"gtsam", "cv2", "onnxruntime", "scipy.ndimage"}
RUN = """
import sys
from hardware.motion.step import MotionStep
from planning.command import Move
from tests.moving import breathing, pose_at, raster

motion = MotionStep(raster())
for k in range(20):
    last = motion(pose_at(breathing, k * 0.02), k * 0.02)
assert isinstance(last, Move)
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


def test_a_command_line_without_a_command_loads_nothing_that_its_help_does_not_say() -> None:
    modules = loaded("import hardware.cli.main, sys; print(*sys.modules)")
    late = {"numpy", "importlib.metadata", "concurrent.futures", "statistics", "tomllib"}
    assert "hardware.cli.main" in modules and late.isdisjoint(modules)
