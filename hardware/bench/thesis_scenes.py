"""What the thesis's estimator and ours are shown side by side: short simulated recordings, or recorded sessions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from estimation.trajectory import Trajectory
from hardware.files.session import Session, open_session
from hardware.process.checks import Table
from hardware.simulator.bodies import Wound, with_wound
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look
from hardware.simulator.motion_table import motion_from_tables
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import flat
from hardware.simulator.scene_table import scene_from_table
from hardware.simulator.sensor import Sensor
from hardware.simulator.truth import Truth
from perception.frames import Frame, FrameSet, Roi

RATE = 30.0  # frame sets a second
SEED = 1
WHERE = "stillbed bench thesis"
PATCH = (80.0, 60.0)  # mm, flat and textured: what the thesis's method is best at
LIMB = {"body": "forearm", "wetness": 1.0}
CHEST = {"body": "chest"}
SLIDE: Table = {"kind": "sine", "rate_hz": 0.5, "mm_per_frame": 0.47, "direction": [1.0, 0.0, 0.0]}
CUBE: Table = {"kind": "constant", "unit_mm": 50.0}
TURNING: Table = {"kind": "breathing", "amplitude_mm": 4.0, "rate_hz": 0.25, "turn_deg": [4.0, 2.0, 0.0]}
CALM: Table = {"kind": "breathing", "amplitude_mm": 4.0, "rate_hz": 0.25, "turn_deg": [1.0, 0.4, 0.0]}
MADE: dict[str, tuple[Table | None, Table]] = {
    "flat patch, shaking table": (None, SLIDE),
    "flat patch, constant speed in six axes": (None, CUBE),
    "wet forearm, breathing": (LIMB, TURNING),
    "chest, breathing": (CHEST, CALM),
}  # body, None for the patch, and motion: thesis 4.6's two experiments, and two of the wounds it is meant for


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One recording. roi: where the surface is at the start. truth: None where nothing is known of it."""

    name: str
    rig: Rig
    roi: tuple[Roi, ...]
    truth: Trajectory | None
    source: Session | Made
    surface: Path | None = None

    def frame_sets(self) -> Iterator[FrameSet]:
        """Its frame sets in order of stamp."""
        return self.source.frame_sets()


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """Pictures rendered as they are asked for. stamps: (N,) s."""

    scene: Scene
    rig: Rig
    truth: Truth
    stamps: Array

    def frame_sets(self) -> Iterator[FrameSet]:
        """A frame set a stamp; the same ones each time."""
        rng, cameras = np.random.default_rng([SEED, 31]), self.rig.cameras
        for stamp in self.stamps.tolist():
            times = np.array([stamp])
            instant = Instant(stamp, 0.0, self.truth.base_from_surface(times)[0], self.truth.twist(times)[0])
            images = render(self.scene, cameras, [instant] * len(cameras), Sensor(), rng.spawn(len(cameras)))
            yield FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images)))


def made(name: str, seconds: float, rig: Rig | None = None) -> Shown:
    """The recording `name` of MADE; rig: three cameras as in the thesis, if no other."""
    table, motion = MADE[name]
    scene = _patch() if table is None else scene_from_table(WHERE, dict(table), Path(), SEED)
    rig, truth = rig or arc_rig(), Truth(REST, motion_from_tables(WHERE, [dict(motion)], Path(), SEED))
    stamps = np.arange(round(seconds * RATE)) / RATE
    poses = truth.base_from_surface(stamps)
    exact = Trajectory(stamps, poses, exact=True)
    return Shown(name, rig, rois(scene, rig, poses[0], 0.0), exact, Made(scene, rig, truth, stamps))


def recorded(path: Path) -> Shown:
    """A recorded session; InputError says what is wrong with it."""
    session = open_session(path)
    return Shown(path.name, session.rig, session.roi, session.truth, session, session.surface)


def _patch() -> Scene:
    shape = with_wound(flat(PATCH), Wound((26.0, 18.0)), SEED)
    return Scene(shape, Look(texel=0.2, wetness=0.3, drape=False), seed=SEED)
