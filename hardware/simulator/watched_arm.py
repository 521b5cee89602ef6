"""A virtual arm before simulated cameras, all of it known exactly: what a calibration of the arm is held against.

The arm is served on a pseudo-terminal in real time, or in virtual time; either way it is known afterwards where it was
at each instant, and the pictures that the cameras took meanwhile are rendered then.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.arm.profile import ArmProfile, placed
from hardware.files.images import encode
from hardware.process.clock import Clock, RememberingClock
from hardware.process.progress import Report, silent
from hardware.session_folder import SessionFolder
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.camera_settings import CameraSettings
from hardware.simulator.cameras import Shot, SimulatedCameras
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look
from hardware.simulator.pictures import NOISE
from hardware.simulator.port import run_virtual_arm
from hardware.simulator.render import StillScene
from hardware.simulator.scene.scene import Scene
from hardware.simulator.scene.shape import cylinder
from hardware.simulator.sensor import Sensor
from planning.kinematics import SimpleArm, nozzle_from_axes

DEAD, LAG = (0.005, 0.025), (0.012, 0.03)  # s between which the virtual arm's own are drawn
AWRY = np.array([0.02] * 3 + [4.0] * 3)  # rad and mm, one sigma by which it stands beside where its file says
TOOL = 1.5  # mm, likewise of the tip
FPS = 12.0  # pictures a second, of which one in EVERY is kept but where the arm is LIVELY: rendering takes long
EVERY, LIVELY = 3, 300.0  # mm/s^2: what tells dead time from lag
AROUND = 0.02  # s on both sides between which that is measured
OPENS = 5.0  # s that a pseudo-terminal may take to appear
QUALITY = None  # no JPEG: a needle two pixels wide is seen by its colour, which JPEG stores at half the resolution


@dataclass(frozen=True, slots=True, eq=False)
class WatchedArm:
    """A virtual arm and its cameras. rig: as it is. told: the arm as its file says; true: as it is. settings: of the
    controller. begin: (6,) where it stands first."""

    rig: Rig
    told: ArmProfile
    true: SimpleArm
    settings: ArmSettings
    cameras: CameraSettings
    begin: Array
    seed: int


def watched_arm(seed: int, fps: float = FPS) -> WatchedArm:
    """One, with errors of its own for each seed; it stands where the cameras look."""
    rng = np.random.default_rng([seed, 89])
    rig, told = arc_rig(), placed(ArmProfile(), REST)
    awry = se3.exp(rng.normal(size=6) * AWRY)
    tool = rng.normal(size=3) * TOOL
    true = replace(told.arm, arm_from_base=told.arm.arm_from_base @ awry, tool_offset=tool)
    settings = ArmSettings(dead_time=float(rng.uniform(*DEAD)), servo_lag=float(rng.uniform(*LAG)))
    phases = tuple(float(v) for v in rng.uniform(0, 0.01, len(rig)))
    cameras = CameraSettings(phases, (0.0,) * len(rig), fps=fps)
    return WatchedArm(rig, told, true, settings, cameras, told.arm.home - [0, 0, 3.0, 0, 0, 0], seed)


@dataclass(slots=True)
class Served:
    """A virtual arm on a pseudo-terminal. device: its name. Afterwards, arm, and begun: its time 0 by the clock."""

    device: str
    arm: VirtualArm | None = None
    begun: float = 0.0


@contextmanager
def served(watched: WatchedArm, link: Path, clock: Clock) -> Iterator[Served]:
    """Serve the arm on a pseudo-terminal at `link`, in a thread, until the context ends."""
    stop, since, result = threading.Event(), RememberingClock(clock), Served(str(link))
    standing = replace(watched.told, arm=replace(watched.told.arm, home=watched.begin))

    def serve() -> None:
        result.arm = run_virtual_arm(watched.settings, standing, (), link, clock=since, stop=stop, say=_nobody)

    thread = threading.Thread(target=serve, name="virtual arm", daemon=True)
    thread.start()
    end = clock.now() + OPENS
    while not link.exists() and clock.now() < end and thread.is_alive():
        clock.wait_until(clock.now() + 0.01)
    try:
        yield result
    finally:
        stop.set()
        thread.join()
        result.begun = since.begun or 0.0


def _nobody(words: str) -> None:
    """Tell nobody."""


def _lively(arm: VirtualArm, instants: Array) -> NDArray[np.bool_]:
    """Whether (N,) the arm changes its speed quickly at instants (N,), s."""
    around = [arm.axes_at(np.clip(instants + h, 0.0, arm.now))[:, :3] for h in (-AROUND, 0.0, AROUND)]
    return np.asarray(np.linalg.norm(around[2] - 2 * around[1] + around[0], axis=1) > LIVELY * AROUND**2)


def take_pictures(
    watched: WatchedArm, arm: VirtualArm, begun: float, span: tuple[float, float], folder: Path, report: Report = silent
) -> None:
    """Write the session folder of what the cameras saw of the arm from one instant to another, s, by the clock.

    begun: the arm's time 0 by the clock.
    """
    scene = Scene(cylinder((80.0, 60.0), 80.0), Look(texel=0.3, drape=False), seed=watched.seed)
    exposure, sensor = watched.cameras.exposure, Sensor()
    before = StillScene(scene, watched.rig.cameras, Instant(0.0, exposure, REST, np.zeros(6)))
    cameras = SimulatedCameras(watched.cameras, watched.seed)
    until = min(span[1] - begun, arm.now)
    streams = [cameras.shots(c, until) for c in range(len(watched.rig))]
    rounds = [shots for shots in zip(*streams, strict=False) if shots[0].exposed + begun >= span[0]]
    lively = _lively(arm, np.array([shots[0].exposed for shots in rounds]))
    rounds = [shots for number, shots in enumerate(rounds) if lively[number] or number % EVERY == 0]

    def taken(shot: Shot) -> tuple[str, bytes]:
        axes = arm.axes_at(np.array([min(shot.exposed, arm.now)]))[0]
        nozzle = nozzle_from_axes(watched.true, axes)
        instant = Instant(shot.exposed, exposure, REST, np.zeros(6), 0.0, nozzle, shot.gain)
        rng = np.random.default_rng([watched.seed, NOISE, shot.camera, shot.picture])
        return encode(before(shot.camera, instant, sensor, rng), QUALITY)

    with SessionFolder(folder, watched.rig, ()) as session, ThreadPoolExecutor(2) as pool:
        for number, shots in enumerate(rounds):
            for shot, picture in zip(shots, pool.map(taken, shots), strict=True):
                session.picture(shot.camera, shot.stamp + begun, *picture)
            report(number + 1, len(rounds))
