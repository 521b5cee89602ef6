"""Many small sessions smoothed by one worker and by two, and by two of which one is killed on the way."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
from pathlib import Path

import numpy as np

from estimation.errors import InputError
from estimation.synthetic.world import synthetic_world
from hardware.bench.figures import Figure, at_least
from hardware.offline.smooth import Cluster, run_smooth
from hardware.process.clock import WallClock
from hardware.recording.recorder import Recorder
from hardware.smoothing.cluster import local_cluster
from hardware.smoothing.run import Wishes
from perception.frames import Frame

SECONDS, RATE, COUNT = 5.0, 30.0, 60  # of a session
FASTER = 1.8


def many_figures(count: int) -> list[Figure]:
    """The gain of a second worker, and how many sessions are smoothed where one is killed."""
    names = f"{count} sessions: two workers by one", f"{count} sessions, a worker killed: smoothed"
    with tempfile.TemporaryDirectory() as folder:
        sessions = Path(folder) / "sessions"
        write_sessions(sessions, count)
        try:
            spent = [_smoothed(sessions, Path(folder) / f"by{workers}", workers)[0] for workers in (1, 2)]
        except InputError as missing:
            return [Figure(name, float("nan"), "", None, "", str(missing)) for name in names]
        _, done = _smoothed(sessions, Path(folder) / "killed", 2, kill=True)
    load = os.getloadavg()[0]
    note = f"{spent[0]:.1f} s and {spent[1]:.1f} s by the clock, at a load of {load:.1f}"
    return [
        Figure(names[0], spent[0] / spent[1], "", at_least(FASTER), "", note),
        Figure(names[1], float(done), "", at_least(count), "", "after the first session was done"),
    ]


def write_sessions(folder: Path, count: int) -> None:
    """So many recordings with tracks, all alike."""
    folder.mkdir()
    world, blank = synthetic_world("breathing", SECONDS, RATE, COUNT), np.full((720, 1280), 90, np.uint8)
    with Recorder(folder / "s000.mcap", world.rig) as recorder:
        for k, seen in enumerate(world):
            for camera in range(3 if k == 0 else 1):
                recorder.frame(Frame(camera, seen.stamp, blank))
            recorder.write(seen)
    for k in range(1, count):
        shutil.copy(folder / "s000.mcap", folder / f"s{k:03}.mcap")


def _smoothed(sessions: Path, out: Path, workers: int, kill: bool = False) -> tuple[float, int]:
    """Seconds by the clock, once the workers stand, and sessions done. kill: one worker, after the first session."""
    clock, done = WallClock(), 0
    with local_cluster(workers) as cluster:
        start = clock.now()
        for outcome in run_smooth([sessions], out, Wishes(), Cluster(cluster.scheduler_address)):
            done += not outcome.failed
            if kill:
                kill = False
                os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        return clock.now() - start, done
