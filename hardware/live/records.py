"""What the processes of a live run tell each other, and what they give the recorder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path as File

import numpy as np
from numpy.typing import NDArray

from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmEvent
from hardware.live.arrived import Encoded
from hardware.motion.loop import Tick
from hardware.recorded_tick import RecordedTick
from perception.frames import Frame, PrintHead, Roi
from planning.path import Path
from planning.progress import Progress


@dataclass(frozen=True, slots=True, eq=False)
class Handed:
    """A pose on its way to the motion. handed: s, when the newest of its frames came; put: s, when the pose left."""

    pose: SurfacePose
    handed: float
    put: float


@dataclass(frozen=True, slots=True)
class Span:
    """A stage's times so far, s: how many, median, 99 % and largest."""

    name: str
    count: int
    median: float
    p99: float
    most: float


@dataclass(frozen=True, slots=True, eq=False)
class TrackingReport:
    """What the tracking process says after each frame set.

    stamp: s, when it said so. cameras: their names. seen: cameras in the last set. pose: the newest. surface_from_path:
    (4, 4), where the path lies on the tracker's surface; None until that is known. registered: stamp, s, of the pose
    that told. sets, dropped: taken, and left out as a newer one was there. interval: s between two sets, NaN until
    known. unrecorded: sets that found the recorder busy. spans: of its stages. used: tracks by camera. ended: why there
    will be no more, "" while there are. wrong: whether that was wrong input. truth: (4, 4) mm, base_from_surface at the
    pose's stamp where the world is simulated. surface: (V, 3) mm, landmarks in the surface frame.
    """

    stamp: float
    cameras: tuple[str, ...] = ()
    seen: tuple[int, ...] = ()
    pose: SurfacePose | None = None
    surface_from_path: Array | None = None
    registered: float = float("nan")
    sets: int = 0
    dropped: int = 0
    interval: float = float("nan")
    unrecorded: int = 0
    spans: tuple[Span, ...] = ()
    used: tuple[int, ...] = ()
    ended: str = ""
    wrong: bool = False
    truth: Array | None = None
    surface: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Begin:
    """The order to print. path: in the tracker's surface frame. profile: of the arm, its place and lag as they are
    now known. start: counted in checkpoints. fingerprint: of the path as its file has it.
    """

    path: Path
    profile: ArmProfile
    start: float
    fingerprint: str


class Pace(Enum):
    """Orders of a live run beside those that the arm follows."""

    PAUSE = "pause"
    RESUME = "resume"


@dataclass(frozen=True, slots=True, eq=False)
class LiveMotionReport:
    """What the motion process says after each tick.

    tick: the last one. progress: None before a path was begun. paused: whether it was told to. events: the last ones.
    late: ticks' lateness; spans: times from frames to the wire. skipped: ticks not made. stops: how many, and the last
    one's decision and its frame on the wire, s. unrecorded: what found the recorder busy. priority: as granted.
    """

    tick: Tick
    progress: Progress | None
    paused: bool
    events: tuple[ArmEvent, ...]
    spans: tuple[Span, ...]
    skipped: int
    stops: int
    stop: tuple[float, float] | None
    unrecorded: int
    priority: str


@dataclass(frozen=True, slots=True, eq=False)
class RecorderReport:
    """What the recorder says. written: bytes. share: of one core that it takes. failed: why it stopped, "" if not."""

    stamp: float
    written: int
    share: float
    failed: str


# -- what is recorded


@dataclass(frozen=True, slots=True, eq=False)
class RigEntry:
    """The cameras; nothing is written before they are known."""

    rig: Rig


@dataclass(frozen=True, slots=True)
class ScanEntry:
    """The file of the scan that the tracker registers to."""

    file: File


@dataclass(frozen=True, slots=True, eq=False)
class RoiEntry:
    """Where the surface was looked for."""

    roi: Roi


@dataclass(frozen=True, slots=True, eq=False)
class SetEntry:
    """A frame set as the tracker took it. encoded: pictures by camera as the camera gave them; frames: the others."""

    stamps: Mapping[int, float]
    encoded: Mapping[int, Encoded]
    frames: tuple[Frame, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PoseEntry:
    """A pose, the tracks that it is made of, the head that was kept out, and the true pose (4, 4) where it is known."""

    pose: SurfacePose
    observations: Observations
    head: PrintHead | None = None
    truth: Array | None = None


@dataclass(frozen=True, slots=True)
class WireEntry:
    """Bytes that passed the arm's port at `stamp`, s."""

    stamp: float
    data: bytes
    sent: bool


@dataclass(frozen=True, slots=True)
class EventEntry:
    """Something that a person should be able to read afterwards."""

    stamp: float
    text: str
    level: int
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class LatencyEntry:
    """How long a stage took so far: counts (N,) of bins of `width` s, and the largest, s."""

    stamp: float
    stage: str
    width: float
    counts: NDArray[np.int64]
    most: float


@dataclass(frozen=True, slots=True)
class UsedEntry:
    """What the run used, as TOML; kept in the recording."""

    name: str
    text: str


Given = RigEntry | ScanEntry | RoiEntry | UsedEntry
Happened = SetEntry | PoseEntry | RecordedTick | WireEntry | EventEntry | LatencyEntry
Entry = Given | Happened
