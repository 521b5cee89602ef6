"""What all tests share: fixed examples, so that a run says the same thing twice, and the order of the files."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from hypothesis import Phase, settings

if TYPE_CHECKING:
    from tests.browser import Browser

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy, as the command line does
settings.register_profile("fixed", deadline=None, derandomize=True, max_examples=15)
settings.register_profile("many", settings.get_profile("fixed"), max_examples=250)  # `make slow`
settings.register_profile("unshrunk", settings.get_profile("fixed"), phases=[Phase.explicit, Phase.generate])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))  # mutants need no smallest example

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background: what tests start inherits it
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["estimation.synthetic.plugin"]  # by name, so that a checkout that is not installed has it too

LONGEST = (  # files that take longest, and long ones late in the alphabet: begun first, so that no worker waits long
    *("test_live_run", "test_looks", "test_estimator_suite", "test_calibrate_refused", "test_tracking"),
    *("test_wound_area", "test_world", "test_loop_replay", "test_plan_tool", "test_operator_stages"),
    *("test_record", "test_skin", "test_simulate", "test_local_error", "test_track", "test_growth"),
    *("test_estimator", "test_recording_damage", "test_arm_laws", "test_plan_layers"),
    *("test_wrong_input", "test_planner", "test_fill_laws", "test_operator_page", "test_deceit"),
    *("test_smooth_many", "test_clearance", "test_outages", "test_calibration_hint", "test_colours"),
    *("test_plan_command", "test_rig_formats", "test_calibrate_dispenser", "test_registration"),
    *("test_training_data", "test_verification", "test_thesis_step", "test_view", "test_warp"),
)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A real browser; what needs one is skipped where there is none."""
    from tests.browser import Browser, executable

    if (program := executable()) is None:
        pytest.skip("no Chromium: make browser")
    made = Browser(program)
    yield made
    made.close()


def pytest_collection_finish() -> None:
    """What was imported and collected stays to the end: the garbage collector need not walk it in every test."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)  # before those that are not asked for are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if hasattr(getattr(item, "obj", None), "hypothesis"):
            item.add_marker("law")
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))
