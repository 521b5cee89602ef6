"""The body of a virtual arm's process: serves a pseudo-terminal, and leaves what was executed for whoever judges it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from hardware.arm.profile import ArmProfile
from hardware.priority import ask_for_real_time
from hardware.process.clock import RememberingClock, WallClock
from hardware.process.faults import Fault
from hardware.process.system import settle
from hardware.simulator.arm.settings import ArmSettings, Replies
from hardware.simulator.port import run_virtual_arm
from hardware.simulator.virtual_arm_file import read_virtual_arm

AFTERWARDS = 2.0  # s that the arm goes on without whoever conducted the run: it has to come to rest by itself
STEP = 0.002  # s between rows of what was executed


@dataclass(frozen=True, slots=True, eq=False)
class VirtualArmPlan:
    """link: to the device. executed: file for the motion. kept: what the arm is like, as `prerender` keeps it.

    Without that it is one that answers.
    """

    link: Path
    executed: Path
    profile: ArmProfile
    kept: Path | None
    real_time: bool


def virtual_arm_process(plan: VirtualArmPlan, lifeline: Connection) -> None:
    """Serve until SIGTERM or the end of the lifeline, then write what was executed: stamps (N,) s and axes (N, 6)."""
    settle("arm")
    settings, faults = ArmSettings(replies=Replies.STREAM), tuple[Fault, ...]()
    if plan.kept is not None:
        settings, faults = read_virtual_arm(plan.kept)
    if plan.real_time:
        ask_for_real_time()  # a real controller shares no core with us
    clock, stop = RememberingClock(WallClock()), threading.Event()
    threading.Thread(target=_end_with, args=(lifeline, stop), daemon=True).start()
    arm = run_virtual_arm(settings, plan.profile, faults, plan.link, clock=clock, stop=stop, say=_nobody)
    assert clock.begun is not None
    stamps = np.arange(0.0, arm.now, STEP)
    axes = arm.axes_at(stamps) if len(stamps) else np.zeros((0, 6))
    with plan.executed.open("wb") as file:
        np.savez(file, stamps=stamps + clock.begun, axes=axes, deepest=arm.deepest, held_up=clock.longest)


def _nobody(words: str) -> None:
    """Tell nobody."""


def _end_with(lifeline: Connection, stop: threading.Event) -> None:
    """Set `stop` some time after the other end of a line, on which nothing is ever said, is gone."""
    lifeline.poll(None)
    stop.wait(AFTERWARDS)
    stop.set()
