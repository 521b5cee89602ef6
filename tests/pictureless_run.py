"""A live run for tests that needs no pictures: `python -m tests.pictureless_run FOLDER RECORD [FLAG ...]`."""

from __future__ import annotations

import struct
import sys
import zlib
from functools import partial
from pathlib import Path
from typing import Any

RATE = 30.0  # frame sets a second
AGE = 0.03  # s of a pose when it comes
TILT = 0.005  # rad by which the surface turns as it breathes
HOME = 65.0  # mm of Z: the surface lies at 50
SIZE = (16, 12)  # px
BURST_AFTER, BURST_SETS = 30, 100  # frame sets before a burst, and of a megabyte each in it
RIG = """[[camera]]
name = "{name}"
source = "usb:{name}"
size = [16, 12]
matrix = [[20, 0, 8], [0, 20, 6], [0, 0, 1]]
distortion = [0, 0, 0, 0, 0]
base_from_camera = [[1, 0, 0, {x}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def prepare_files(folder: Path, lines: int = 40, speed: float = 5.0) -> None:
    """rig.toml, path.csv and arm.toml of a run over a surface that breathes a little, 15 mm below the arm's home."""
    from dataclasses import replace

    from hardware.arm.profile import ArmProfile
    from hardware.files.arm_file import write_arm
    from hardware.files.path_file import write_path
    from tests.moving_surfaces import raster

    (folder / "rig.toml").write_text("".join(RIG.format(name=name, x=x) for name, x in (("a", 0), ("b", 100))))
    write_path(folder / "path.csv", raster(lines=lines, speed=speed))
    profile = ArmProfile()
    home = profile.arm.home.copy()
    home[2] = HOME
    write_arm(folder / "arm.toml", replace(profile, arm=replace(profile.arm, home=home)), "near the surface")


def track_nothing(
    prepared: Any, channels: Any, last: str = "", height: float = 1.0, deaf: bool = False, burst: bool = False
) -> None:
    """The body of a tracking process that knows where the surface is, which breathes by `height` mm up and down.

    last: phase of the print that it sees no more of, "" to see all of it. deaf: whether it ends by SIGKILL alone.
    burst: whether it once gives the recorder more pictures at a time than wait for it.
    """
    import signal
    from dataclasses import replace

    import numpy as np

    from estimation.observations import no_observations
    from hardware.live.recorder_process import RecorderSender
    from hardware.live.records import PoseEntry, SetEntry, SurfaceEntry, TrackingReport
    from hardware.motion.step import PoseHandover
    from hardware.process.clock import WallClock
    from hardware.process.system import pipe_closed, set_up_process
    from planning.placement import PathPlacement, PlacedBy
    from tests.moving_surfaces import breathing, pose_at

    set_up_process("tracking")
    if deaf:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    clock, outbox, picture = WallClock(), RecorderSender(channels.recorder), png()
    outbox.put(prepared.rig)
    outbox.put(SurfaceEntry(clock.now(), np.eye(3), ()))
    names = tuple(camera.name for camera in prepared.rig.cameras)
    begin = due = clock.now()
    earlier = prepared.placement
    lies, by = (np.eye(4), PlacedBy.SCAN) if earlier is None else (earlier.surface_from_path, PlacedBy.EARLIER)
    known = PathPlacement(lies, by, "known", earlier is None or earlier.certain, True), begin
    side = np.linspace(-70, 70, 15)
    ground = np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3)
    while deaf or not pipe_closed(channels.lifeline):
        due += 1 / RATE
        clock.wait_until(due)
        stamp, sets = due - AGE, round((due - begin) * RATE)
        pose = pose_at(lambda t: breathing(t, height=height, tilt=TILT), stamp)
        channels.shared.poses.put(PoseHandover(pose, due - AGE / 2, clock.now()))
        order = channels.shared.search.get()
        looks = 0 if order is None else order.looks
        seen = {"used": (50, 50), "looks": looks, "surface": ground, "since": begin}
        seen["unrecorded"] = outbox.dropped
        report = TrackingReport(clock.now(), names, (0, 1), pose, *known, sets, 0, 1 / RATE, **seen)
        channels.shared.tracking.put(report)
        outbox.put(SetEntry({0: stamp, 1: stamp}, {0: ("png", picture), 1: ("png", picture)}))
        outbox.put(PoseEntry(pose, no_observations(stamp)))
        for k in range(BURST_SETS if burst and sets == BURST_AFTER else 0):
            outbox.put(SetEntry({0: stamp + 1e-4 * (k + 1)}, {0: ("png", picture + bytes(2**20))}))
        moved = channels.shared.motion.get()
        if moved is not None and moved.progress is not None and moved.progress.phase.value == last:
            channels.shared.tracking.put(replace(report, ended="session is over"))
            break
    outbox.close()


def png() -> bytes:
    """A grey picture."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + b"\x80" * SIZE[0]) * SIZE[1]
    head = struct.pack(">IIBBBBB", *SIZE, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def unkept(*_: Any) -> Any:
    """A path that, carried to where it lies, is refused by the reader of paths."""
    from estimation.errors import InputError

    raise InputError("kept", "line 6: position", [1.0, 2.0, 3.0], "0.001 mm or more from line 5")


def main(folder: Path, record: Path, *flags: str) -> int:
    """Run; the exit code is the run's."""
    from dataclasses import replace

    from hardware.live.prepared import prepare, prepare_resumed
    from hardware.live.run import LiveRun
    from hardware.live.settings import LiveSettings
    from hardware.live.view import Console
    from hardware.process.faults import faults_from_texts

    if "--resume" in flags:
        prepared = prepare_resumed(record, {"unattended": "--yes" in flags})
    else:
        rig, path, profile = (folder / name for name in ("rig.toml", "path.csv", "arm.toml"))
        device = next((flag for flag in flags if not flag.startswith("--")), "virtual")
        more = {
            "unattended": "--yes" in flags,
            "page": "--page" in flags,
            "stands_home": not device.startswith("franka"),
        }
        ports = [int(flag.partition("=")[2]) for flag in flags if flag.startswith("--foxglove=")]
        more |= {"foxglove_port": sum(ports), "operator": "Ada" if ports else ""}
        files = [Path(flag.partition("=")[2]) for flag in flags if flag.startswith("--dispensers=")]
        more |= {"dispensers": next(iter(files), None)}
        given = LiveSettings(rig=rig, path=path, arm=device, profile=profile, record=record, **more)
        texts = [flag.partition("=")[2] for flag in flags if flag.startswith("--fault=")]
        faults = faults_from_texts("command line", "--fault", texts)  # allowed, as what is tracked is simulated
        prepared = replace(prepare(given, "the test", False), faults=faults)
    if "--unkept" in flags:
        from hardware.live import run

        run.recorded_begin = unkept
    heights = [float(flag.partition("=")[2]) for flag in flags if flag.startswith("--height=")]
    last = "leaving" if "--until-printed" in flags else ""
    more = {"deaf": "--deaf" in flags, "burst": "--burst" in flags}
    with Console() as console:
        tracker = partial(track_nothing, last=last, height=sum(heights) or 1.0, **more)
        outcome = LiveRun(prepared, console, tracker)()
        console.say(outcome.words)
    return outcome.code


if __name__ == "__main__":
    import tests.pictureless_run as itself  # its processes import it by this name

    sys.exit(itself.main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:]))
