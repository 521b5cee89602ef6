"""A scenario: one simulated print, everything that is true of it and everything the loop is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.motions import Motion
from hardware.arm.profile import ArmProfile
from hardware.methods import MAP
from hardware.process.checks import Table
from hardware.process.faults import Fault
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.camera_settings import CameraSettings
from hardware.simulator.run_limits import RunLimits
from hardware.simulator.sensor import Sensor
from planning.kinematics import SimpleArm


@dataclass(frozen=True, slots=True)
class Tracking:
    """How poses are made. pictures: by a tracking step from rendered pictures, else exact ones at their instants.

    tracks: without pictures, by the estimator from tracks that nobody has rendered, instead of exact ones.
    processing: s that a frame set takes, None for the time that was measured (then no two runs are alike).
    scan: whether the tracker has the scan and registers to it; else the path is registered by the skin's texture.
    method: of the tracking step, a key of METHODS.
    """

    pictures: bool = True
    tracks: bool = False
    processing: float | None = 0.02  # 15 ms of tracking and 5 ms of decoding, measured on two cores
    scan: bool = False
    method: str = MAP


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """One simulated print, as data/scenarios holds them.

    file: where it was read. path: the file of the checkpoints; clearance: mm above the true surface at which they are
    laid, None for a path as it is; bead: width, mm. scene: the table from which the scene is built when it is needed.
    rest: (4, 4) base_from_surface without motion. strain: amount of the deformation over time, None for none.
    rig: the cameras as they are, told_rig: as the tracker knows them. arm: the virtual controller. true_arm: where the
    arm stands. baud: bits/s of its line. profile: what the motion knows of it. limits: what the run must reach.
    nozzle, beads: whether the pictures show the nozzle, and what it has printed.
    """

    file: Path
    title: str
    seconds: float
    seed: int
    path: Path
    clearance: float | None
    bead: float
    scene: Table
    motion: Motion
    strain: Callable[[Array], Array] | None
    rest: Array
    rig: Rig
    told_rig: Rig
    cameras: CameraSettings
    sensor: Sensor
    jpeg_quality: int | None
    tracking: Tracking
    arm: ArmSettings
    faults: tuple[Fault, ...]
    true_arm: SimpleArm
    baud: float
    profile: ArmProfile
    limits: RunLimits
    nozzle: bool
    beads: bool
